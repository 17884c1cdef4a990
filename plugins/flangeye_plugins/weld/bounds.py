"""What the tip must keep to while the seam is followed, whatever the controller decides."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from flangeye.devices import DeviceError
from flangeye.models.finger import Finger
from flangeye.motion.seam_following import ToolPose
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following
from flangeye_plugins.weld.touch.tip_displacement import TipDisplacement


class Bounds:
    """Judges each cycle before its command is given."""

    def __init__(self, finger: Finger, plan: Path) -> None:
        self._finger, self._plan = finger, plan

    def check(self, pose: ToolPose, progress: float, felt: Iterable[TipDisplacement]) -> None:
        """Stop a tip that is astray, or that is pressed harder than it may be.

        Args:
            pose: Pose of the tool.
            progress: Arc length of the tip's progress on the plan [m].
            felt: What is new.

        Raises:
            DeviceError: Which bound was passed.
        """
        place = self._plan.at(progress)
        astray = abs(float((pose.position[:2] - place.point) @ place.normal))
        if astray > Following.astray:
            raise DeviceError(
                f"the tip is {astray * 1e3:.0f} mm away from the plan, "
                f"allowed are {Following.astray * 1e3:.0f} mm"
            )
        for feeling in felt:
            self._check_press(feeling)

    def _check_press(self, feeling: TipDisplacement) -> None:
        moved = float(np.linalg.norm(feeling.displacement))
        if moved > self._finger.travel:
            raise DeviceError(
                f"the tip is displaced by {moved * 1e3:.1f} mm, finger {self._finger.model} stands "
                f"{self._finger.travel * 1e3:.3g} mm"
            )
        force = self._finger.force(feeling.displacement)
        if force is not None and force > self._finger.largest_force:
            raise DeviceError(
                f"the tip presses with {force:.1f} N, "
                f"allowed are {self._finger.largest_force:.3g} N"
            )

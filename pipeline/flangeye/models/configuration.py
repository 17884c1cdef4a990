"""Mountings of camera and target, and the transforms that each leaves unknown.

All configurations are one loop of frames, read from the robot's base:

    base_T_camera_carrier · carrier_T_camera · camera_T_target
        = base_T_base2 · base_T_target_carrier · carrier_T_target

The carriers' poses follow from the controllers (the base's own is the identity),
``camera_T_target`` is measured. What is left is unknown: the camera's pose always; the target's
where its place is not known; ``base_T_base2`` where another arm carries the target, whose poses
are then in ``base2``. The paper's equations (1) to (5) and its Figs. 2, 3 and 14 are cases of it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flangeye.types import BASE, BASE2, CAMERA, FLANGE, FLANGE2, TARGET, Floats, Observation
from flangeye.types.geometry import each_applied, rigid, rotation_from_rpy

LINK = "link"

CARRIERS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "eye-on-base": ((BASE,), (FLANGE,)),
    "eye-in-hand": ((FLANGE,), (BASE,)),
    "eye-on-arm": ((LINK,), (FLANGE, BASE)),
    "two-arms": ((FLANGE,), (FLANGE2,)),
}
"""By name of the configuration: the frames that may carry the camera, and the target."""

EVERY = tuple(CARRIERS)
"""All configurations, for stages that serve every one: ``@stage("solve.x", serves=EVERY)``."""
CELL = "cell"
"""Declared by stages that serve cells of many cameras and targets: ``serves=(CELL,)``."""


Triple = tuple[float, float, float]
ORIGIN: tuple[Triple, Triple] = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
"""Pose of the flange's own circles in the frame that carries them: the identity."""


@dataclass(frozen=True, eq=False)
class Configuration:
    """One configuration of camera and target.

    Attributes:
        name: One of :data:`CARRIERS`.
        camera: Frame that carries the camera.
        target: Frame that carries the target.
        stands: The target's pose in its carrier: position [m], and roll, pitch and yaw [rad]; None
            if unknown.
    """

    name: str = "eye-on-base"
    camera: str = BASE
    target: str = FLANGE
    stands: tuple[Triple, Triple] | None = None

    @cached_property
    def place(self) -> Floats | None:
        """Pose (4, 4) of the target in the frame that carries it; None if it is to be estimated."""
        if self.stands is None or self.stands == ORIGIN:
            return None if self.stands is None else np.eye(4)
        position, rpy = self.stands
        return rigid(rotation_from_rpy(*rpy), np.asarray(position))

    @property
    def is_default(self) -> bool:
        """Whether this is a camera beside the robot that looks at the flange's own circle."""
        return self.name == "eye-on-base" and self.drawn_in_flange

    @property
    def drawn_in_flange(self) -> bool:
        """Whether the target's frame is the flange's own."""
        return self.target == FLANGE and self.stands == ORIGIN

    @property
    def other_base(self) -> str | None:
        """Name of the unknown transform to the second arm's base, if there is one."""
        return f"{BASE}_T_{BASE2}" if self.target == FLANGE2 else None

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Names of the transforms to find, the camera's first."""
        target = None if self.stands else f"{self.target}_T_{TARGET}"
        named = (f"{self.camera}_T_{CAMERA}", self.other_base, target)
        return tuple(name for name in named if name)

    @property
    def equation(self) -> str:
        """The calibration's loop equation as text, unknown transforms in brackets."""
        # Both sides end in the target: once as the camera measured it, once as the arm carries it.
        left = [_pose_of(self.camera), f"[{self.camera}_T_{CAMERA}]", f"{CAMERA}_T_{TARGET}"]
        placed = f"{self.target}_T_{TARGET}"
        right = [self.other_base and f"[{self.other_base}]", _pose_of(self.target)]
        right.append(placed if self.stands else f"[{placed}]")
        return " · ".join(filter(None, left)) + " = " + " · ".join(filter(None, right))

    def describe(self) -> str:
        """Return one line: the name, the loop and what is unknown in it."""
        return f"{self.name}: {self.equation}; to be found: {', '.join(self.unknowns)}"


DEFAULT = Configuration(stands=ORIGIN)
"""A camera beside the robot that looks at the flange's own circle."""


def _pose_of(carrier: str) -> str | None:
    bases = {BASE: None, FLANGE2: f"{BASE2}_T_{FLANGE2}"}
    return bases.get(carrier, f"{BASE}_T_{carrier}")


@dataclass(frozen=True, eq=False)
class Ends:
    """Poses of camera and target at N observations, from the controllers and the transforms.

    Attributes:
        camera: (N, 4, 4) poses of the camera in ``base``.
        target: (N, 4, 4) poses of the target in ``base``.
    """

    camera: Floats
    target: Floats


def mapped_and_expected(ends: Ends, observations: Sequence[Observation]) -> tuple[Floats, Floats]:
    """Return the targets as measured and as expected: (N, 3) each, in ``base``."""
    seen = np.array([o.feature.centre for o in observations]).reshape(-1, 3)
    offsets = np.array([o.centre_in_mount for o in observations]).reshape(-1, 3)
    return each_applied(ends.camera, seen), each_applied(ends.target, offsets)

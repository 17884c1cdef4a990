"""Converts the tag's pose to the tip's displacement, in the tool's axes or in the base's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.errors import StageError
from flangeye.models.finger import Finger
from flangeye.motion.seam_following import Touch
from flangeye.types import Array
from flangeye.types.geometry import nearest_rotation, rotation_exp, rotation_log
from flangeye_plugins.weld.touch.tag_observation import TagReading


@dataclass(frozen=True, eq=False)
class TipDisplacement:
    """Deformation of the finger in one image, in the tool's axes.

    Attributes:
        time_ns: Middle of the exposure, on the robot's clock.
        displacement: (3,) displacement of the tip from its rest position [m].
        rotation: (3,) rotation vector of the tag from its rest orientation [rad].
        covariance: (3, 3) covariance of the displacement [m^2].
        confidence: Confidence of the tag's detection, 0 to 1.
    """

    time_ns: int
    displacement: Array
    rotation: Array
    covariance: Array
    confidence: float

    @property
    def touch(self) -> Touch:
        """The displacement in the controller's input format."""
        return Touch(self.time_ns * 1e-9, self.displacement)


class Interpreter:
    """Converts the tag's pose to the tip's displacement, by the finger's calibration."""

    def __init__(self, finger: Finger) -> None:
        """Prepare the conversion for a calibrated finger.

        Raises:
            StageError: The finger is not calibrated.
        """
        if finger.calibration is None:
            raise StageError(
                f"finger {finger.model} is not calibrated: run 'flangeye tactile calibrate' first"
            )
        self._rest = np.array(finger.calibration.rest)
        self._gain = np.array(finger.calibration.gain)
        self._upright = rotation_exp(np.array(finger.calibration.rotation))
        # The gain is the camera's rotation with a little stretch and shear, which a rotation vector
        # must not get
        self._tool_R_camera = nearest_rotation(self._gain)

    def feel(self, reading: TagReading, time_ns: int) -> TipDisplacement:
        """Return the tip's displacement for a reading of the tag."""
        turn = rotation_log(rotation_exp(reading.rotation) @ self._upright.T)
        return TipDisplacement(
            time_ns,
            self._gain @ (reading.translation - self._rest),
            self._tool_R_camera @ turn,
            self._gain @ reading.covariance @ self._gain.T,
            reading.confidence,
        )

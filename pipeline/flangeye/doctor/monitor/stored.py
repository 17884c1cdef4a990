"""The calibration that is watched: its pose, what is known of it, and the cell it belongs to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.files.yaml_lines import parse_yaml
from flangeye.handeye.drift import Sightings, sightings_of
from flangeye.log.read import RunLog, read_run
from flangeye.maths.arm_correction import corrected_flange
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import corners_of, excess_variance
from flangeye.models.loading import load_model
from flangeye.models.workspace import workspace_of
from flangeye.types import Floats

FINEST_TILT = np.radians(0.01)
"""No flange's normal is better known than this [rad]."""


@dataclass(frozen=True, eq=False)
class StoredCalibration:
    """A calibration of an earlier run.

    Attributes:
        path: Its log.
        log: What that holds.
        calibration: What the solver gave.
    """

    path: Path
    log: RunLog
    calibration: t.HandEye

    @property
    def estimate(self) -> t.TransformEstimate:
        """base_T_camera, with its covariance."""
        return self.calibration.base_T_camera

    @property
    def key(self) -> str:
        """What tells this calibration from others."""
        return np.array2string(
            self.estimate.transform.matrix.ravel(), precision=9, max_line_width=999
        )

    @cached_property
    def recipe(self) -> str:
        """The recipe that found it, with every default written out."""
        return self.log.attachments.get("recipe.resolved.yaml", b"").decode()

    @cached_property
    def arm(self) -> Arm | None:
        """The arm's kinematics, where the recipe names a model that is known here."""
        header = parse_yaml(self.recipe, "recipe").data if self.recipe else {}
        model = (header.get("robot") or {}).get("model")
        return Arm(load_model("robots", model)) if model else None

    @cached_property
    def corners(self) -> Floats:
        """(8, 3) of the work, from the point at which the covariance holds [m]."""
        source = self.log.source or t.Source("")
        box = workspace_of(source, None, self.calibration.pairs)
        if box is None:
            return np.zeros((1, 3))
        return corners_of(box.centre, box.size) - self.estimate.about

    @cached_property
    def noise(self) -> tuple[float, float]:
        """Variances of arm and surface beyond the scans' own: of a place [m^2], a tilt [rad^2]."""
        used = [p for p in self.calibration.pairs if p.used]
        turn = self.estimate.transform.rotation
        own = np.array([turn @ p.observation.circle.covariance @ turn.T for p in used])
        beyond = excess_variance(np.array([p.residual for p in used]), own)
        measured = self.sightings(
            [p.observation for p in used], np.zeros(len(used), dtype=np.intp), (0.0, 0.0)
        )
        tilts, known = measured.residuals[:, 3:], measured.covariances[:, 3:, 3:]
        seen = known[:, 0, 0] < 0.5
        spare = (
            np.mean(tilts[seen] ** 2) - np.mean(known[seen][:, [0, 1], [0, 1]]) if seen.any() else 0
        )
        return beyond, max(float(spare), FINEST_TILT**2)

    def sightings(
        self,
        seen: Sequence[t.Observation],
        check: NDArray[np.intp],
        noise: tuple[float, float] | None = None,
    ) -> Sightings:
        """Return sightings of the flange, held against this calibration.

        Args:
            seen: The N sightings.
            check: (N,) which check each belongs to.
            noise: See :attr:`noise`; by default that.
        """
        correction = self.calibration.as_reported().correction
        expected = np.array(
            [corrected_flange(o.base_T_flange.matrix, o.joints, correction, self.arm) for o in seen]
        )
        levers = np.array(
            [e[:3, :3] @ o.centre_in_mount for e, o in zip(expected, seen, strict=True)]
        )
        expected[:, :3, 3] += levers
        circles = [o.circle for o in seen]
        normals = [np.full(3, np.nan) if c.normal is None else c.normal for c in circles]
        own = _covariances(self.estimate.transform.rotation, circles, expected, noise or self.noise)
        return sightings_of(
            self.estimate.transform.matrix, self.estimate.about,
            np.array([c.centre for c in circles]), np.array(normals), own, expected,
            self._jacobians(seen, levers), check,
        )  # fmt: skip

    def _jacobians(self, seen: Sequence[t.Observation], levers: Floats) -> Floats | None:
        """Return (N, 6, n) of the circles' centres, where every joint angle is known."""
        joints = [o.joints for o in seen if o.joints is not None]
        if self.arm is None or len(joints) < len(seen):
            return None
        found = self.arm.jacobian(np.array(joints))
        found[:, 3:] += np.cross(found[:, :3], levers[:, :, None], axis=1)
        return found


def stored_calibration(path: Path) -> StoredCalibration:
    """Return the calibration of a run, given as its folder or its ``run.mcap``.

    Raises:
        StageError: There is no log, or no calibration of a camera beside a robot in it.
    """
    log = read_run(path / "run.mcap" if path.is_dir() else path)
    calibration = log.calibration()
    if calibration is None:
        raise StageError(f"{log.path}: holds no calibration; name a run that found one")
    if calibration.camera.transform.name != "base_T_camera":
        raise StageError(
            f"{log.path}: is a calibration of {calibration.camera.transform.name}; only a camera "
            "beside the robot (base_T_camera) can be watched"
        )
    return StoredCalibration(log.path, log, calibration)


def _covariances(
    turn: Floats, circles: Sequence[t.CircleFeature], expected: Floats, noise: tuple[float, float]
) -> Floats:
    """Return (N, 5, 5) of centres and tilts in the base, arm included."""
    out = np.zeros((len(circles), 5, 5))
    for own, circle, frame in zip(out, circles, expected, strict=True):
        own[:3, :3] = turn @ circle.covariance @ turn.T + (noise[0] + 1e-12) * np.eye(3)
        if circle.normal_covariance is not None:
            across = frame[:3, :2].T @ turn
            own[3:, 3:] = across @ circle.normal_covariance @ across.T + (
                noise[1] + 1e-12
            ) * np.eye(2)
    return out

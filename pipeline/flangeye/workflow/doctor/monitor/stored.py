"""The calibration that is monitored: its pose, covariance, and cell."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.files.yaml_lines import parse_yaml
from flangeye.maths.arm_correction import corrected_flange
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import corners_of
from flangeye.maths.streams import mean_pose
from flangeye.models.loading import load_model
from flangeye.models.workspace import workspace_of
from flangeye.types import Floats
from flangeye.types.geometry import invert, rigid
from flangeye.workflow.doctor.monitor.drift import (
    CheckSightings,
    DriftTest,
    DriftVerdict,
    Prior,
    information_of,
    prior_of,
    sightings_of,
    verdict,
)
from flangeye.workflow.doctor.monitor.pose_error import ArmPoseErrors, pose_error_of
from flangeye.workflow.log.read import RunLog, read_run
from flangeye.workflow.recipe.own_models import carried_files


@dataclass(frozen=True, eq=False)
class StoredCalibration:
    """A calibration of an earlier run.

    Attributes:
        path: Path of the log.
        log: Content of the log.
        calibration: The solver's result.
    """

    path: Path
    log: RunLog
    calibration: t.HandEye

    @property
    def estimate(self) -> t.TransformEstimate:
        """base_T_camera, with its covariance."""
        return self.calibration.base_T_camera

    @property
    def simulated(self) -> bool:
        """Whether a simulator made the calibration's captures."""
        return bool((self.log.result or {}).get("simulated"))

    @property
    def key(self) -> str:
        """Key that is unique to this calibration."""
        return np.array2string(
            self.estimate.transform.matrix.ravel(), precision=9, max_line_width=sys.maxsize
        )

    @cached_property
    def recipe(self) -> str:
        """The recipe of that calibration, with every default written out."""
        return self.log.attachments.get("recipe.resolved.yaml", b"").decode()

    @cached_property
    def arm(self) -> Arm | None:
        """The arm's kinematics, where the recipe names a model that is known here."""
        return _arm_of(self.log)

    def refuse_another_arm(self, log: RunLog) -> None:
        """Refuse a run whose arm has other kinematics.

        Raises:
            StageError: Its flange has another pose with all joints at zero.
        """
        ours, theirs = self.arm, _arm_of(log)
        if ours and theirs and not _alike(ours, theirs):
            raise StageError(
                f"{log.path}: is a run of another robot than this calibration's; name runs of the "
                "same cell"
            )

    @cached_property
    def corners(self) -> Floats:
        """Corners (8, 3) of the work, relative to the covariance's point ``about`` [m]."""
        source = self.log.source or t.Source("")
        box = workspace_of(source, None, self.calibration.pairs)
        if box is None:
            return np.zeros((1, 3))
        return corners_of(box.centre, box.size) - self.estimate.about

    @cached_property
    def used(self) -> list[t.Observation]:
        """The sightings that the calibration was computed from."""
        return [pair.observation for pair in self.calibration.pairs if pair.used]

    @cached_property
    def pose_error(self) -> ArmPoseErrors:
        """The arm's pose error, estimated from this calibration's residuals."""
        bare, circles = self._bare(self.used, _one_check(self.used))
        return pose_error_of(bare.residuals, bare.effects, bare.covariances, circles)

    @cached_property
    def prior(self) -> Prior:
        """Prior of later sightings, from the calibration's own sightings."""
        sightings = self.sightings(self.used, _one_check(self.used))
        return prior_of(sightings, self.pose_error.with_camera)

    def drift(
        self, seen: Sequence[t.Observation], limit: float, false_alarms: float
    ) -> DriftVerdict:
        """Return the verdict on sightings taken as one check, with no prior but this calibration.

        The work may drift by ``limit`` [m]; a cell that did not move is refused with the
        probability ``false_alarms``.
        """
        test = DriftTest(false_alarms=false_alarms, limit=limit)
        told = information_of(self.sightings(seen, _one_check(seen)), test.daily)
        return verdict(told, self.prior, self.corners, test)

    def sightings(self, seen: Sequence[t.Observation], check: NDArray[np.intp]) -> CheckSightings:
        """Return sightings of the target with their deviation from this calibration.

        Args:
            seen: The N sightings.
            check: (N,) index of each sighting's check.
        """
        bare, circles = self._bare(seen, check)
        effects = np.concatenate([bare.effects, self.pose_error.effects(circles)], axis=2)
        covariances = bare.covariances + self.pose_error.beyond
        return replace(bare, effects=effects, covariances=covariances)

    def _bare(
        self, seen: Sequence[t.Observation], check: NDArray[np.intp]
    ) -> tuple[CheckSightings, Floats]:
        """Return sightings with the scans' noise alone, and (N, 4, 4) expected targets."""
        flanges = np.array([self._flange(o) for o in seen])
        expected = flanges @ np.array([self._carried(o) for o in seen])
        features = [o.feature for o in seen]
        normals = [np.full(3, np.nan) if f.normal is None else f.normal for f in features]
        bare = sightings_of(
            self.estimate.transform.matrix, self.estimate.about,
            np.array([f.centre for f in features]), np.array(normals),
            _covariances(self.estimate.transform.rotation, features, expected), expected,
            self._jacobians(seen, expected[:, :3, 3] - flanges[:, :3, 3]), check,
        )  # fmt: skip
        return bare, expected

    def _flange(self, seen: t.Observation) -> Floats:
        """Return the pose (4, 4) of the flange, or of the circle seen there."""
        correction = self.calibration.as_reported().correction
        return corrected_flange(seen.base_T_flange.matrix, seen.joints, correction, self.arm)

    def _carried(self, seen: t.Observation) -> Floats:
        """Return the target's pose in the flange (4, 4)."""
        if isinstance(seen.feature, t.PoseFeature):
            return self._mounted
        return rigid(np.eye(3), seen.centre_in_mount)

    @cached_property
    def _mounted(self) -> Floats:
        """Return the pose in the flange (4, 4) of a target with full poses, by the calibration."""
        base_T_camera = self.estimate.transform.matrix
        found = [
            invert(self._flange(o)) @ base_T_camera @ o.feature.camera_T_target.matrix
            for o in self.used
            if isinstance(o.feature, t.PoseFeature)
        ]
        return mean_pose(np.array(found))

    def _jacobians(self, seen: Sequence[t.Observation], levers: Floats) -> Floats | None:
        """Return Jacobians (N, 6, n) of the targets' origins, if every joint angle is known."""
        joints = [o.joints for o in seen if o.joints is not None]
        if self.arm is None or len(joints) < len(seen):
            return None
        # Rows are (w, v) of the flange's origin; a point at r from it moves by v + w x r
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


def _arm_of(log: RunLog) -> Arm | None:
    """Return the kinematics of a run's arm, if its model is available here."""
    recipe = log.text("recipe.resolved.yaml")
    header = parse_yaml(recipe, "recipe").data if recipe else {}
    model = (header.get("robot") or {}).get("model")
    with carried_files(log.models) as folder:
        return Arm(load_model("robots", model, folder)) if model else None


def _alike(one: Arm, other: Arm) -> bool:
    """Return whether two arms are of one model; either may be corrected."""
    if one.n != other.n:
        return False
    at_zero = np.zeros(one.n)
    between = one.flange(at_zero)[:3, 3] - other.flange(at_zero)[:3, 3]
    # A correction moves a flange by millimetres, another model has it centimetres away [m]
    return bool(np.linalg.norm(between) < 0.03)


def _covariances(turn: Floats, features: Sequence[t.Feature], expected: Floats) -> Floats:
    """Return covariances (N, 5, 5) of the scans' centres and tilts, in the base."""
    out = np.zeros((len(features), 5, 5))
    for own, feature, frame in zip(out, features, expected, strict=True):
        own[:3, :3] = turn @ feature.centre_covariance @ turn.T
        if feature.normal_covariance is not None:
            # (2, 3) from an error of the normal in the camera to its parts along the target's x
            # and y; along z a unit vector has none
            across = frame[:3, :2].T @ turn
            own[3:, 3:] = across @ feature.normal_covariance @ across.T
    return out


def _one_check(seen: Sequence[t.Observation]) -> NDArray[np.intp]:
    return np.zeros(len(seen), dtype=np.intp)

"""``solve``, ``refine`` and ``verify`` stages: from centres and poses to a calibration."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import numpy as np

from flangeye import types as t
from flangeye.testing.base import (
    Conformance,
    require,
    require_close,
    require_covariance,
    require_refusal,
    require_repeats,
    require_round_trip,
    require_type,
)
from flangeye.testing.percapture import FLANGE_POSE, flange_scene
from flangeye.types import Floats
from flangeye.types.geometry import kabsch, kabsch_covariance, rigid, rotation_exp

TRUE_CAMERA = rigid(rotation_exp(np.array([3.0, 0.2, -0.4])), np.array([0.6, -0.1, 1.2]))
"""``base_T_camera`` of the kit's cell."""

WORK = np.array([0.55, -0.05, 0.45])
"""Middle of the work, in ``base`` [m]."""

WORK_SIZE = np.array([0.3, 0.3, 0.2])
"""Extent of the work along each axis [m]."""

NOISE = 0.05e-3
"""Standard deviation of a centre [m]."""

POSES = 16

MOTION = rigid(rotation_exp(np.array([0.3, -0.2, 0.9])), np.array([0.2, 0.1, -0.3]))
"""Another place for the robot's base."""


HERE = np.eye(4)


def observed(
    points: Floats, base_T_camera: Floats = TRUE_CAMERA, noise: float = NOISE, normals: bool = True
) -> list[t.Observation]:
    """Return observations of flanges at (N, 3) points in ``base``."""
    rng = np.random.default_rng(1)
    true = t.Transform(t.BASE, t.CAMERA, base_T_camera)
    observations = []
    for index, point in enumerate(points):
        turn = rotation_exp(rng.uniform(-0.4, 0.4, 3))
        pose = t.Transform(t.BASE, t.FLANGE, rigid(turn, point))
        centre = true.inverse().apply(point) + rng.normal(0, noise, 3)
        normal = true.rotation.T @ turn[:, 2]
        scatter = 1e-6 * (np.eye(3) - np.outer(normal, normal))
        circle = t.CircleFeature(
            centre=centre,
            normal=normal * -np.sign(normal @ centre) if normals else None,
            radii={"rim": 0.0315},
            covariance=max(noise, 1e-6) ** 2 * np.eye(3),
            normal_covariance=scatter if normals else None,
            arc_coverage=1.0,
        )
        observations.append(t.Observation(f"{index:04d}", circle, t.by_frame(pose)))
    return observations


def work_points(count: int = POSES) -> Floats:
    """Return points spread over the work, in ``base`` [m]."""
    return np.asarray(WORK + np.random.default_rng(2).uniform(-0.5, 0.5, (count, 3)) * WORK_SIZE)


def reference_solution(observations: Sequence[t.Observation]) -> t.HandEye:
    """Return the plain least-squares calibration of some observations."""
    camera = np.array([o.feature.centre for o in observations])
    base = np.array([o.tcp_in_base for o in observations])
    pose = t.Transform(t.BASE, t.CAMERA, rigid(*kabsch(camera, base)))
    pairs = tuple(
        t.Pair(o, pose.apply(c) - b) for o, c, b in zip(observations, camera, base, strict=True)
    )
    estimate = t.TransformEstimate(pose, kabsch_covariance(base, NOISE), base.mean(axis=0))
    return t.HandEye(estimate, pairs, "solve.kit")


def elsewhere(observations: Sequence[t.Observation], motion: Floats) -> list[t.Observation]:
    """Return the same scans, taken by a robot whose base is at another place."""
    moved = t.Transform(t.BASE, t.BASE, motion)
    return [replace(o, poses={**o.poses, t.FLANGE: moved @ o.base_T_flange}) for o in observations]


class SolvingConformance(Conformance):
    """Base of the conformance classes of solve, refine and verify stages."""

    gives: ClassVar[type] = t.HandEye

    def given(self, observations: Sequence[t.Observation], motion: Floats) -> dict[Any, Any]:
        """Return the stage's input: the plain calibration, and the runner's values."""
        return {t.HandEye: reference_solution(observations), **self.known(observations, motion)}

    def answer(self, observations: Sequence[t.Observation], motion: Floats = HERE) -> Any:
        """Return the stage's result from some observations."""
        return require_type(self.call(self.given(observations, motion)), self.gives)

    def views(self, motion: Floats = HERE) -> t.Views:
        """Return a segmented scan that is kept for verifying, as the true camera sees it."""
        cloud = flange_scene(self.flange).flange_cloud()
        pose = t.Transform(t.BASE, t.FLANGE, motion @ TRUE_CAMERA @ FLANGE_POSE)
        return t.Views([t.VerificationView("view", cloud, pose)])

    def stream(self, observations: Sequence[t.Observation]) -> t.Observations:
        """Return observations as the earlier steps of a recipe would give them."""
        workspace = t.Box(WORK, WORK_SIZE)
        source = t.Source("kit", workspace=workspace)
        return t.Observations(observations, source, len(observations))

    def known(self, observations: Sequence[t.Observation], motion: Floats = HERE) -> dict[Any, Any]:
        """Return what the runner passes to the stage in addition to the calibration."""
        return {
            t.Observations: self.stream(observations),
            t.Solver: reference_solution,
            t.Views: self.views(motion),
            t.Box: t.Box(t.Transform(t.BASE, t.BASE, motion).apply(WORK), WORK_SIZE),
        }

    def _require_pose(self, answer: t.HandEye, expected: Floats, within: float, what: str) -> None:
        """Compare poses by their error at the work, which matters, not at the camera's origin."""
        found = answer.base_T_camera.transform
        true = t.Transform(t.BASE, t.CAMERA, expected)
        corners = true.inverse().apply(np.array([o.observation.tcp_in_base for o in answer.pairs]))
        require_close(found.apply(corners), true.apply(corners), within, f"{what}: the work [m]")

    def test_it_gives_the_same_twice(self) -> None:
        """Two calls with equal input and seed give equal output, to the last bit."""
        require_repeats(lambda: self.answer(observed(work_points())))

    def test_its_answer_survives_the_log(self) -> None:
        """The answer is unchanged after it is written to MCAP and read back."""
        require_round_trip(self.answer(observed(work_points())))


class SolveConformance(SolvingConformance):
    """A ``solve`` stage: takes observations, returns a HandEye.

    Attributes:
        tolerance: Largest error at the work with 0.05 mm of noise at 16 poses [m].
    """

    kind = "solve"
    tolerance: ClassVar[float] = 0.15e-3

    def given(self, observations: Sequence[t.Observation], motion: Floats) -> dict[Any, Any]:
        """Return the stage's input."""
        return self.known(observations, motion)

    def test_it_finds_the_camera_in_metres(self) -> None:
        """The camera's pose in a known cell with 0.05 mm of noise is found, in metres."""
        answer = self.answer(observed(work_points()))
        self._require_pose(answer, TRUE_CAMERA, self.tolerance, "a known cell")

    def test_it_accounts_for_every_observation(self) -> None:
        """The result has one pair for each used or unused observation, with its residual."""
        observations = observed(work_points())
        answer = self.answer(observations)
        ids = [pair.observation.id for pair in answer.pairs]
        require(len(ids) == len(set(ids)), "an observation has several pairs")
        require(
            set(ids) <= {o.id for o in observations},
            "a pair names an observation that was not given",
        )
        require(len(ids) >= 3, "fewer than three pairs")
        if answer.correction is None:
            pose = answer.base_T_camera.transform
            for pair in answer.pairs:
                seen = pose.apply(pair.observation.feature.centre)
                expected = seen - pair.observation.tcp_in_base
                require_close(pair.residual, expected, 1e-6, "a residual [m]")
        for pair in answer.pairs:
            require(pair.used or pair.reason, f"{pair.observation.id} is unused without a reason")

    def test_its_covariance_is_one(self) -> None:
        """The covariance is symmetric and has no negative variance."""
        answer = self.answer(observed(work_points()))
        require_covariance(answer.camera.covariance, "the pose's covariance")

    def test_it_moves_with_the_base(self) -> None:
        """If the robot's base is moved, the answer moves with it."""
        moved = elsewhere(observed(work_points()), MOTION)
        within = 2 * self.tolerance
        self._require_pose(self.answer(moved), MOTION @ TRUE_CAMERA, within, "a base elsewhere")

    def test_it_scales_with_the_cell(self) -> None:
        """The camera's pose in a cell that is a quarter larger is found."""
        camera = TRUE_CAMERA.copy()
        camera[:3, 3] *= 1.25
        answer = self.answer(observed(1.25 * work_points(), camera))
        self._require_pose(answer, camera, 1.25 * self.tolerance, "a larger cell")

    def test_it_never_gives_a_mirror_image(self) -> None:
        """Centres in one plane, which also fit their mirror image, give a proper rotation."""
        points = work_points()
        points[:, 2] = WORK[2]
        answer = self.answer(observed(points, noise=NOISE / 5))
        self._require_pose(answer, TRUE_CAMERA, self.tolerance, "centres in one plane")

    def test_too_little_is_refused(self) -> None:
        """Two poses, poses at one place and centres on a line are refused."""
        along = np.linspace(-0.5, 0.5, POSES)[:, None] * [0.3, 0.0, 0.0]
        for what, points in (
            ("two poses", work_points(2)),
            ("all poses at one place", np.repeat(WORK[None], POSES, axis=0)),
            ("centres on a line", WORK + along),
        ):
            few = observed(points, noise=NOISE / 5, normals=False)
            require_refusal(partial(self.answer, few), t.Rejected, what)


class RefineConformance(SolvingConformance):
    """A ``refine`` stage: takes a HandEye, returns a HandEye.

    Attributes:
        tolerance: Largest error at the work after refining a good calibration [m].
    """

    kind = "refine"
    tolerance: ClassVar[float] = 0.2e-3

    def test_it_leaves_a_good_calibration_good(self) -> None:
        """Refining the solution of a known cell with 0.05 mm of noise keeps it within tolerance."""
        answer = self.answer(observed(work_points()))
        self._require_pose(answer, TRUE_CAMERA, self.tolerance, "a good calibration")
        require_covariance(answer.camera.covariance, "the pose's covariance")

    def test_it_moves_with_the_base(self) -> None:
        """If the robot's base is moved, the answer moves with it."""
        answer = self.answer(elsewhere(observed(work_points()), MOTION), MOTION)
        self._require_pose(answer, MOTION @ TRUE_CAMERA, 2 * self.tolerance, "a base elsewhere")


class VerifyConformance(SolvingConformance):
    """A ``verify`` stage: takes a HandEye, returns a Verification."""

    kind = "verify"
    gives = t.Verification

    def test_it_passes_a_good_calibration(self) -> None:
        """The calibration of a known cell with 0.05 mm of noise passes."""
        answer = self.answer(observed(work_points()))
        require(answer.passed, f"a good calibration fails: {answer.reason}")

    def test_it_fails_a_bad_calibration(self) -> None:
        """A calibration from centres with 20 mm of noise fails."""
        answer = self.answer(observed(work_points(), noise=20e-3))
        require(not answer.passed, f"a calibration with 20 mm of noise passes: {answer.reason}")

    def test_it_says_what_it_measured(self) -> None:
        """The reason is one line with a figure; all figures and errors are finite numbers."""
        answer = self.answer(observed(work_points()))
        require(answer.reason and "\n" not in answer.reason, "the reason is one line")
        require(any(c.isdigit() for c in answer.reason), "the reason names no figure")
        for name, figure in {**answer.figures, **answer.errors}.items():
            require(np.isfinite(figure), f"'{name}' is {figure}")

    def test_it_moves_with_the_base(self) -> None:
        """If the robot's base is moved, the verdict is the same."""
        observations = observed(work_points())
        here = self.answer(observations)
        # The same without a turn: boxes stay boxes.
        shift = rigid(np.eye(3), np.array([0.2, 0.1, -0.3]))
        there = self.answer(elsewhere(observations, shift), shift)
        for name, figure in here.figures.items():
            require(
                np.isclose(there.figures.get(name, np.nan), figure, rtol=1e-3, atol=2e-6),
                f"figure '{name}' depends on the pose of the robot's base",
            )

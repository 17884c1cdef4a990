"""Errors of an arm are in what is stated, as large as the residuals show them."""

import numpy as np
import pytest

from flangeye.handeye.arm import MovedFlange
from flangeye.handeye.arm_errors import _kinds
from flangeye.maths.geometry import invert, rigid, rotation_from_rpy
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import chi2_quantile
from flangeye.models.configuration import Configuration
from flangeye.types import BASE, FLANGE, Floats, HandEye, Observation, Transform, by_frame
from flangeye_plugins.solve.robust import RobustParams, solve_poses
from tests.handeye.cells import CONFIGURATIONS, ROBOT, Noise, _feature, errors

ARM, HOME = Arm(ROBOT), np.array([0.2, -1.4, 1.3, -1.2, -1.4, 0.3])
NOISE = Noise(turn=5e-4, shift=1e-4)
NAMES = ["eye-in-hand, marker", "eye-on-base, marker"]


def drawn(
    configuration: Configuration, seed: int, zeros: float
) -> tuple[list[Observation], list[Floats]]:
    """Return what an arm's camera, or a camera beside it, saw, and the true transforms."""
    rng, n = np.random.default_rng(seed), 16
    joints = HOME + rng.uniform(-0.5, 0.5, (n, 6))
    off = zeros * rng.standard_normal(6)
    off[0] = 0.0  # by definition: it fixes the base's x axis
    reported, true = ARM.flange(joints), ARM.flange(joints + off)
    near = rigid(rotation_from_rpy(*rng.normal(0, 0.3, 3)), rng.normal(0, 0.05, 3))
    far = reported[0] @ near @ rigid(rotation_from_rpy(np.pi, 0, 0), np.array([0.0, 0.0, 0.6]))
    if configuration.camera == FLANGE:
        seen, truth = invert(true @ near) @ far, [near, far]
    else:
        seen, truth = invert(far) @ true @ near, [far, near]
    observations = [
        Observation(f"{i:02d}", _feature(pose, NOISE, "pose", rng), by_frame(flange))
        for i, (pose, flange) in enumerate(
            zip(seen, (Transform(BASE, FLANGE, r) for r in reported), strict=True)
        )
    ]
    return observations, truth


def solved(observations: list[Observation], configuration: Configuration, zeros: str) -> HandEye:
    params = RobustParams.model_validate({"joint_zeros": zeros, "joint_offsets": "off"})
    return solve_poses(observations, params, ROBOT, configuration)


def squares(answer: HandEye, truth: list[Floats]) -> list[float]:
    """Return the squared distances of the true transforms, in what is stated of them."""
    estimates = (answer.camera, *answer.others)
    off = [errors(found, true) for found, true in zip(estimates, truth, strict=True)]
    return [
        float(e @ np.linalg.solve(found.covariance, e))
        for e, found in zip(off, estimates, strict=True)
    ]


@pytest.mark.parametrize("name", NAMES)
def test_the_stated_regions_hold_for_an_arm_much_worse_than_its_file_says(name: str) -> None:
    """Ten times worse, and the file says it is as good as ever."""
    limit, held = chi2_quantile(0.95, 6), {"consider": 0, "ignore": 0}
    for seed in range(4):
        observations, truth = drawn(CONFIGURATIONS[name], seed, 10 * ROBOT.joint_accuracy)
        for zeros in held:
            answer = solved(observations, CONFIGURATIONS[name], zeros)
            held[zeros] += sum(square < limit for square in squares(answer, truth))
    assert held["consider"] >= 6 > 1 > held["ignore"]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("worse", "share"), [(1.0, 0.9), (10.0, 0.75)])
def test_the_stated_regions_hold(name: str, worse: float, share: float) -> None:
    limit, inside = chi2_quantile(0.95, 6), []
    for seed in range(100, 140):
        observations, truth = drawn(CONFIGURATIONS[name], seed, worse * ROBOT.joint_accuracy)
        answer = solved(observations, CONFIGURATIONS[name], "consider")
        inside += [square < limit for square in squares(answer, truth)]
    assert np.mean(inside) >= share


def test_what_is_in_the_covariance_is_said_with_the_size_that_was_found() -> None:
    configuration = CONFIGURATIONS["eye-in-hand, marker"]
    sizes = []
    for worse in (0.0, 10.0):
        observations, _ = drawn(configuration, 1, worse * ROBOT.joint_accuracy)
        note = next(n for n in solved(observations, configuration, "consider").notes if "sag" in n)
        before, after = note.split("joint zeros of about ")
        assert before == (
            "what the arm does wrong alike at all poses is in the covariance, as large as the "
            "residuals show it: "
        )
        size, rest = after.split(" mrad, ")
        assert rest == "and encoders, sag, lengths, twists and a smooth error beside them"
        sizes.append(float(size))
    assert sizes[0] < 0.6 < 0.8 < sizes[1] < 8.0


def test_the_answer_itself_does_not_depend_on_what_is_considered() -> None:
    configuration = CONFIGURATIONS["eye-on-base, marker"]
    observations, _ = drawn(configuration, 2, ROBOT.joint_accuracy)
    with_errors, without = (solved(observations, configuration, z) for z in ("consider", "ignore"))
    for one, other in zip(
        (with_errors.camera, *with_errors.others),
        (without.camera, *without.others),
        strict=True,
    ):
        np.testing.assert_array_equal(one.transform.matrix, other.transform.matrix)
        assert np.trace(one.covariance) > np.trace(other.covariance)


def test_an_arm_of_unknown_kinematics_has_no_kinds_of_error() -> None:
    with pytest.raises(ValueError, match="kinematics are not known"):
        _kinds(MovedFlange(np.tile(np.eye(4), (3, 1, 1)), None, False))


def test_an_arm_that_does_not_reach_its_poses_has_no_kinds_of_error() -> None:
    far = ARM.flange(np.tile(HOME, (4, 1)))
    far[:, 0, 3] += 5.0
    with pytest.raises(ValueError, match="do not reach"):
        _kinds(MovedFlange(far, None, True, ARM, 1e-4))

"""Errors of an arm are in what is stated, as large as the residuals show them."""

from collections.abc import Mapping

import numpy as np
import pytest

from flangeye.handeye.arm import MovedFlange
from flangeye.handeye.arm_errors import _kinds
from flangeye.handeye.observed import Cell
from flangeye.maths.geometry import invert, rigid, rotation_from_rpy
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import chi2_quantile
from flangeye.models.configuration import LINK, Configuration
from flangeye.types import (
    BASE,
    BASE2,
    FLANGE,
    FLANGE2,
    Floats,
    HandEye,
    Observation,
    Transform,
    by_frame,
)
from flangeye_plugins.solve.robust import RobustParams, solve_cell
from tests.handeye.cells import (
    CONFIGURATIONS,
    ROBOT,
    Noise,
    Session,
    _feature,
    errors,
    walking,
)

ARM, HOME = Arm(ROBOT), np.array([0.2, -1.4, 1.3, -1.2, -1.4, 0.3])
NOISE = Noise(turn=5e-4, shift=1e-4)
NAMES = ["eye-in-hand, marker", "eye-on-base, marker"]
MORE = ["eye-on-arm 1, marker", "eye-on-arm 2, marker", "two arms, marker"]
AHEAD = rigid(rotation_from_rpy(np.pi, 0, 0), np.array([0.0, 0.0, 0.6]))


def drawn(
    configuration: Configuration, seed: int, zeros: float, n: int = 16, smooth: bool = False
) -> tuple[list[Observation], list[Floats]]:
    """Return what is seen where arms' zeros are off, and the true transforms."""
    rng = np.random.default_rng(seed)
    arms = [_moved(rng, n, zeros, smooth) for _ in range(2 if configuration.other_base else 1)]
    x, z = near(rng), near(rng) if configuration.other_base else np.eye(4)
    camera, target = (
        carried(frame, arms) for frame in (configuration.camera, configuration.target)
    )
    others = []
    if configuration.other_base:
        others = [camera[0] @ x @ AHEAD @ invert(target[0] @ z)]
        target = others[0] @ target
    elif configuration.camera == BASE:
        x, z = target[0] @ x @ invert(AHEAD), x
    else:
        z = invert(target[0]) @ camera[0] @ x @ AHEAD
    seen = invert(camera @ x) @ target @ z
    reported = [ARM.flange(joints) for joints, _ in arms]
    joints = arms[0][0] if configuration.camera.startswith(LINK) else [None] * n
    observations = [
        Observation(f"{i:02d}", _feature(pose, NOISE, "pose", rng), poses(reported, i), angles)
        for i, (pose, angles) in enumerate(zip(seen, joints, strict=True))
    ]
    return observations, [x, *others, z]


def near(rng: np.random.Generator) -> Floats:
    """Return (4, 4) where something is mounted."""
    return rigid(rotation_from_rpy(*rng.normal(0, 0.3, 3)), rng.normal(0, 0.05, 3))


def _moved(rng: np.random.Generator, n: int, zeros: float, smooth: bool) -> tuple[Floats, Floats]:
    """Return (n, 6) joints of an arm as reported, and as they are: here and there, or on a path."""
    if smooth:
        along = np.linspace(0.0, 2 * np.pi, n)[:, None]
        joints = HOME + 0.5 * np.sin(along + rng.uniform(0.0, 2 * np.pi, 6))
    else:
        joints = HOME + rng.uniform(-0.5, 0.5, (n, 6))
    off = zeros * rng.standard_normal(6)
    off[0] = 0.0  # by definition: it fixes the base's x axis
    return joints, joints + off


def carried(frame: str, arms: list[tuple[Floats, Floats]]) -> Floats:
    """Return (n, 4, 4) where a frame of the arms truly is."""
    if frame == BASE:
        return np.tile(np.eye(4), (len(arms[0][0]), 1, 1))
    link = int(frame.removeprefix(LINK)) if frame.startswith(LINK) else None
    return ARM.pose(arms[frame == FLANGE2][1], link)


def poses(reported: list[Floats], i: int) -> Mapping[str, Transform]:
    """Return the flanges' poses at one moment, as the controllers have them."""
    names = ((BASE, FLANGE), (BASE2, FLANGE2))
    return by_frame(*(Transform(*n, r[i]) for n, r in zip(names, reported, strict=False)))


def solved(observations: list[Observation], configuration: Configuration, zeros: str) -> HandEye:
    params = RobustParams.model_validate({"joint_zeros": zeros, "joint_offsets": "off"})
    return solve_cell(Cell(observations, configuration, ROBOT, second_robot=ROBOT), params)


def squares(answer: HandEye, truth: list[Floats]) -> list[float]:
    """Return the squared distances of the true transforms, in what is stated of them."""
    estimates = (answer.camera, *answer.others)
    off = [errors(found, true) for found, true in zip(estimates, truth, strict=True)]
    return [
        float(e @ np.linalg.solve(found.covariance, e))
        for e, found in zip(off, estimates, strict=True)
    ]


def inside(name: str, seeds: range, worse: float, zeros: str) -> list[bool]:
    """Return of every transform of some sessions whether its 95 % region holds the truth."""
    limit, configuration = chi2_quantile(0.95, 6), CONFIGURATIONS[name]
    told = []
    for seed in seeds:
        observations, truth = drawn(configuration, seed, worse * ROBOT.joint_accuracy)
        told += [s < limit for s in squares(solved(observations, configuration, zeros), truth)]
    return told


@pytest.mark.parametrize("name", NAMES)
def test_the_stated_regions_hold_for_an_arm_much_worse_than_its_file_says(name: str) -> None:
    """Ten times worse, and the file says it is as good as ever."""
    assert sum(inside(name, range(4), 10, "consider")) >= 6
    assert sum(inside(name, range(4), 10, "ignore")) < 1


@pytest.mark.parametrize("name", MORE)
def test_they_hold_where_a_link_carries_the_camera_or_there_are_two_arms(name: str) -> None:
    """Of two links, less than the whole arm moves camera and target against each other."""
    assert np.mean(inside(name, range(4), 10, "consider")) >= 0.75
    assert np.mean(inside(name, range(4), 10, "ignore")) <= 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES + MORE)
def test_the_stated_regions_hold(name: str) -> None:
    assert np.mean(inside(name, range(100, 140), 1, "consider")) >= 0.9
    share = 0.75 if name in NAMES else 0.7
    assert np.mean(inside(name, range(100, 140), 10, "consider")) >= share


@pytest.mark.parametrize("name", NAMES)
def test_errors_of_an_arm_on_a_smooth_path_are_not_taken_for_a_walk(name: str) -> None:
    """Poses near in time are near in space: both are alike there, and only one is the arm's."""
    configuration, off = CONFIGURATIONS[name], {"consider": 0.0, "ignore": 0.0}
    for seed in range(4):
        observations, truth = drawn(
            configuration, seed, 10 * ROBOT.joint_accuracy, n=30, smooth=True
        )
        for zeros in off:
            answer = solved(observations, configuration, zeros)
            wandered = any("wandered" in note for note in answer.notes)
            assert wandered == (zeros == "ignore")
            off[zeros] += sum(squares(answer, truth)) / 8
    assert off["consider"] < off["ignore"] / 2
    assert off["consider"] < 25


@pytest.mark.parametrize("name", NAMES)
def test_what_walked_on_a_bad_arm_is_known_no_better_than_the_arm(name: str) -> None:
    configuration, off = CONFIGURATIONS[name], {"consider": 0.0, "ignore": 0.0}
    for seed in (1, 3):
        observations, truth = drawn(configuration, seed, 10 * ROBOT.joint_accuracy, n=40)
        made = Session(configuration, observations, dict(enumerate(truth)))
        walked = walking(made, np.random.default_rng(seed)).observations
        for zeros in off:
            answer = solved(walked, configuration, zeros)
            assert any("wandered" in note for note in answer.notes)
            off[zeros] += sum(squares(answer, truth)) / 4
    assert off["consider"] < 15 < 50 < off["ignore"]


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
        assert rest == (
            "and encoders, sag, lengths, twists and a smooth error beside them; at poses like these "
            "most of it cancels, and held-out errors show what does not"
        )
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
        _kinds([[MovedFlange(np.tile(np.eye(4), (3, 1, 1)), None, False)]])


def test_an_arm_that_does_not_reach_its_poses_has_no_kinds_of_error() -> None:
    far = ARM.flange(np.tile(HOME, (4, 1)))
    far[:, 0, 3] += 5.0
    with pytest.raises(ValueError, match="do not reach"):
        _kinds([[MovedFlange(far, None, True, ARM, 1e-4)]])

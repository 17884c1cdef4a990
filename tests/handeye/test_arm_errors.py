"""Errors of an arm are in what is stated, as large as the residuals show them."""

from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from flangeye.errors import CalibrationRefused
from flangeye.handeye.arm import MovedFlange
from flangeye.handeye.arm_errors import _kinds
from flangeye.maths.statistics import chi2_quantile
from flangeye_emulators.world.arm import ArmErrors
from tests.handeye.arms import ARM, HOME, REAL, drawn, solved, squares, worse
from tests.handeye.cells import CONFIGURATIONS, Session, walking

NAMES = ["eye-in-hand, marker", "eye-on-base, marker"]
MORE = ["eye-on-arm 1, marker", "eye-on-arm 2, marker", "two arms, marker"]


def inside(
    name: str, seeds: range, arm: ArmErrors, zeros: str = "consider", **more: Any
) -> list[bool]:
    """Return of every transform of some sessions whether its 95 % region holds the truth."""
    limit, configuration = chi2_quantile(0.95, 6), CONFIGURATIONS[name]
    told = []
    for seed in seeds:
        observations, truth = drawn(configuration, seed, arm, **more)
        with suppress(CalibrationRefused):  # a path along which the arm turned about one axis only
            answer = solved(observations, configuration, joint_zeros=zeros)
            told += [s < limit for s in squares(answer, truth)]
    return told


@pytest.mark.parametrize("name", NAMES)
def test_the_stated_regions_hold_for_an_arm_much_worse_than_its_file_says(name: str) -> None:
    """Ten times worse, and the file says it is as good as ever."""
    assert sum(inside(name, range(4), worse(10))) >= 6
    assert sum(inside(name, range(4), worse(10), "ignore")) < 1


@pytest.mark.parametrize("name", MORE)
def test_they_hold_where_a_link_carries_the_camera_or_there_are_two_arms(name: str) -> None:
    """Of two links, less than the whole arm moves camera and target against each other."""
    assert np.mean(inside(name, range(4), worse(10))) >= 0.75
    assert np.mean(inside(name, range(4), worse(10), "ignore")) <= 0.5


@pytest.mark.slow
@pytest.mark.parametrize("arm", [worse(1), worse(3), worse(10), REAL], ids=["1", "3", "10", "real"])
@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_the_stated_regions_hold(name: str, arm: ArmErrors) -> None:
    """Of poses here and there, and of a smooth path, along which neighbours are off alike.

    Where a link carries the camera few joints move it, and what is told of their zeros is little.
    """
    told = inside(name, range(100, 130), arm)
    told += inside(name, range(100, 130), arm, n=30, smooth=True)
    assert np.mean(told) >= (0.85 if name.startswith("eye-on-arm") else 0.9)


@pytest.mark.parametrize("name", NAMES)
def test_errors_of_an_arm_on_a_smooth_path_are_not_taken_for_a_walk(name: str) -> None:
    """Poses near in time are near in space: both are alike there, and only one is the arm's."""
    configuration, off = CONFIGURATIONS[name], {"consider": 0.0, "ignore": 0.0}
    for seed in range(4):
        observations, truth = drawn(configuration, seed, worse(10), n=30, smooth=True)
        for zeros in off:
            answer = solved(observations, configuration, joint_zeros=zeros)
            wandered = any("wandered" in note for note in answer.notes)
            assert wandered == (zeros == "ignore")
            off[zeros] += sum(squares(answer, truth)) / 8
    assert off["consider"] < off["ignore"] / 2
    assert off["consider"] < 25


@pytest.mark.parametrize("name", NAMES)
def test_what_walked_on_a_bad_arm_is_known_no_better_than_the_arm(name: str) -> None:
    configuration, off = CONFIGURATIONS[name], {"consider": 0.0, "ignore": 0.0}
    for seed in (1, 3):
        observations, truth = drawn(configuration, seed, worse(10), n=40)
        made = Session(configuration, observations, dict(enumerate(truth)))
        walked = walking(made, np.random.default_rng(seed)).observations
        for zeros in off:
            answer = solved(walked, configuration, joint_zeros=zeros)
            assert any("wandered" in note for note in answer.notes)
            off[zeros] += sum(squares(answer, truth)) / 4
    assert off["consider"] < 15 < 50 < off["ignore"]


def test_what_is_in_the_covariance_is_said_with_the_size_that_was_found() -> None:
    configuration = CONFIGURATIONS["eye-in-hand, marker"]
    sizes = []
    for times in (0.0, 10.0):
        observations, _ = drawn(configuration, 1, worse(times))
        note = next(n for n in solved(observations, configuration).notes if "sag" in n)
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


def test_a_corrected_arm_s_answer_has_what_else_is_wrong_with_the_arm() -> None:
    """Its lengths, encoders and sag stay where offsets of joints are found."""
    configuration = CONFIGURATIONS["eye-in-hand, marker"]
    far: dict[str, list[float]] = {"consider": [], "ignore": []}
    for seed in (300, 303, 307):
        observations, truth = drawn(configuration, seed, REAL)
        for zeros, told in far.items():
            answer = solved(observations, configuration, joint_zeros=zeros, joint_offsets="auto")
            corrected = answer.as_corrected()
            assert corrected is not None
            told += squares(corrected, truth)
    assert max(far["consider"]) < 15 < 100 < max(far["ignore"])


def test_the_answer_itself_does_not_depend_on_what_is_considered() -> None:
    configuration = CONFIGURATIONS["eye-on-base, marker"]
    observations, _ = drawn(configuration, 2, worse(1))
    with_errors, without = (
        solved(observations, configuration, joint_zeros=z) for z in ("consider", "ignore")
    )
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

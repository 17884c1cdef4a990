"""An arm that moved while it was seen, its poses recorded by a clock of their own."""

import re

import numpy as np
import pytest
from pydantic import TypeAdapter

from flangeye.maths.statistics import chi2_quantile
from flangeye.maths.streams import later, pose_at, rates_of
from flangeye.types import FLANGE2, Motion
from flangeye_plugins.solve.robust import RobustParams, solve_poses
from tests.handeye.cells import CONFIGURATIONS, ROBOT, errors, passing

TOLD = re.compile(r"([\d.]+) \+- ([\d.]+) ms (after|before)")
CELLS = [("eye-on-base, marker", "pose"), ("eye-in-hand, base circle", "normal"),
         ("two arms, marker", "pose"), ("eye-on-arm 1, marker", "pose"),
         ("eye-on-arm 2, base circle", "normal")]  # fmt: skip


def solved(name, kind, delay, seed, n=24):
    """Return the squared distance of the camera's pose, of six, and the notes on the clocks."""
    made = passing(CONFIGURATIONS[name], np.random.default_rng(seed), delay, n, feature=kind)
    robot = ROBOT if made.configuration.name == "eye-on-arm" else None
    found = solve_poses(made.observations, RobustParams(), robot, made.configuration)
    camera = next(iter(found.transforms))
    error = errors(found.transforms[camera], made.truth[camera])
    square = error @ np.linalg.solve(found.transforms[camera].covariance, error)
    return square, [note for note in found.notes if "the times they are paired by" in note]


def told(note):
    """Return the delay and its standard deviation [ms]."""
    delay, sigma, which = TOLD.search(note).groups()
    return float(delay) * (1 if which == "after" else -1), float(sigma)


@pytest.mark.parametrize(("name", "kind"), CELLS)
@pytest.mark.parametrize("delay", [0.08, -0.03])
def test_a_delay_is_found_with_its_deviation_and_the_pose_is_right(name, kind, delay) -> None:
    square, (note,) = solved(name, kind, delay, 0)
    found, sigma = told(note)
    assert found == pytest.approx(1e3 * delay, abs=4 * sigma + 0.1)
    assert sigma < 2
    assert square < chi2_quantile(0.999, 6)


@pytest.mark.parametrize(("name", "kind"), CELLS)
def test_where_there_is_no_delay_none_is_told(name, kind) -> None:
    square, notes = solved(name, kind, 0.0, 1)
    assert not notes
    assert square < chi2_quantile(0.999, 6)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), CELLS)
def test_regions_hold_their_share_with_a_delay_and_without(name, kind) -> None:
    for delay in (0.05, 0.0):
        each = [solved(name, kind, delay, seed) for seed in range(60)]
        assert np.mean([square < chi2_quantile(0.95, 6) for square, _ in each]) >= 0.88
        assert all(bool(notes) == bool(delay) for _, notes in each)


def test_a_motion_tells_other_moments_as_far_as_it_was_recorded() -> None:
    cell = CONFIGURATIONS["eye-on-base, marker"]
    made = passing(cell, np.random.default_rng(0), 0.0, 4)
    motion = made.observations[0].motion
    assert later(motion, 0.21) is None
    read = TypeAdapter(Motion).validate_json(TypeAdapter(Motion).dump_json(motion))
    np.testing.assert_array_equal(read.poses, motion.poses)
    moved = later(motion, 0.1)
    assert moved is not None
    np.testing.assert_array_equal(pose_at(moved, 0.0), pose_at(motion, 0.1))
    assert moved.times[-1] == pytest.approx(0.1)


def test_of_two_arms_the_motions_of_both_are_kept() -> None:
    made = passing(CONFIGURATIONS["two arms, marker"], np.random.default_rng(0), 0.0, 4)
    motion = made.observations[0].motion
    read = TypeAdapter(Motion).validate_json(TypeAdapter(Motion).dump_json(motion))
    np.testing.assert_array_equal(read.others[FLANGE2], motion.others[FLANGE2])
    moved = later(motion, 0.1)
    assert moved is not None
    np.testing.assert_array_equal(pose_at(moved, 0.0, FLANGE2), pose_at(motion, 0.1, FLANGE2))
    rates = rates_of([motion], FLANGE2)[0]
    assert 0.05 < np.linalg.norm(rates[3:]) < 1

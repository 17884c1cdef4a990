"""What poses can tell, and which motion would tell more."""

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye.estimation.observability import (
    _about_one_line,
    _fault_of,
    _stands_still,
    _turns,
    fewest_sightings,
    in_base,
    require_enough,
    spread_of,
    suggest,
    symmetry_moves,
    weak_moves,
)
from flangeye.types import Floats
from flangeye.types.geometry import rigid, rotation_exp
from tests.estimation.cells import problem_in


def test_as_few_motions_are_named_as_show_what_is_weak() -> None:
    known, limits = np.diag([4.0, 0.0, 0.0, 0.0]), np.ones(4)
    motions = {"first": np.diag([9.0, 0, 0, 0]), "second": np.diag([0, 9.0, 0, 0]),
               "third": np.diag([0, 9.0, 9.0, 0])}  # fmt: skip
    chosen, left = suggest(known, limits, motions)
    assert chosen == ["third"]
    assert np.abs(left.moves).argmax(axis=0).tolist() == [3]
    assert suggest(np.diag([4.0] * 4), limits, motions)[0] == []
    assert suggest(known, limits, {})[0] == []


def still(count: int = 6) -> Floats:
    return np.tile(rigid(rotation_exp([0.3, -0.2, 0.1]), np.array([0.5, 0.1, 0.3])), (count, 1, 1))


def moved(turns: Floats, shifts: Floats) -> Floats:
    """Return poses that turn and shift from one [rad, m]."""
    return np.array([
        rigid(rotation_exp(turn) @ pose[:3, :3], pose[:3, 3] + shift)
        for pose, turn, shift in zip(still(len(turns)), turns, shifts, strict=True)
    ])  # fmt: skip


RNG = np.random.default_rng(0)
NONE, SHIFTS = np.zeros((6, 3)), RNG.uniform(-0.2, 0.2, (6, 3))
ABOUT_Z = np.outer([0.0, 0.2, 0.5, -0.4, 0.3, -0.1], [0.0, 0.0, 1.0])
HARD = 0.9 * np.radians(0.5), 0.9e-3  # less than an arm is said to have moved


def test_a_weak_move_is_as_long_as_its_limit_and_tells_how_far_beyond_it_is() -> None:
    sigmas, limits = np.array([3e-3, 5e-4, 2e-2, 9e-4]), np.array([1e-3, 1e-3, 5e-3, 1e-3])
    weak = weak_moves(np.diag(1 / sigmas**2), limits)
    assert weak and weak.excess == pytest.approx([4.0, 3.0])
    assert np.abs(weak.moves) == pytest.approx(np.array([[0, 1e-3], [0, 0], [5e-3, 0], [0, 0]]))
    assert not weak_moves(np.diag(1 / sigmas**2), 2e-2 + limits)
    assert weak_moves(np.zeros((2, 2)), np.ones(2)).excess.tolist() == [1e6, 1e6]


def test_points_are_spread_along_their_longest_axis_and_about_it() -> None:
    axis, aside = np.array([-0.6, 0.0, 0.8]), np.array([0.0, 1.0, 0.0])
    points = np.outer([-3.0, -1.0, 1.0, 3.0], axis) + np.outer([0.5, -0.5, -0.5, 0.5], aside)
    found = spread_of(points + [7.0, 8.0, 9.0])
    assert found.axis == pytest.approx(axis)
    assert spread_of(-points).axis == pytest.approx(axis)
    sizes = found.length, found.width, found.farthest, found.radius
    assert sizes == pytest.approx((np.sqrt(20), 1.0, 0.5, np.sqrt(9.25)))


def test_a_vector_is_written_without_negative_zeros() -> None:
    assert in_base(np.array([-1e-9, 0.99, -0.0126])) == "(0.000, 0.990, -0.013)"
    assert in_base(np.array([-1e-9, 0.99, -0.0126]), 1) == "(0.0, 1.0, 0.0)"


@pytest.mark.parametrize(
    ("poses", "fault"),
    [
        (still(), "stood still; move it too"),
        (moved(np.outer(np.arange(6) / 5, [HARD[0], 0, 0]), NONE), "stood still; move it too"),
        (moved(NONE, np.outer(np.arange(6) / 5, [HARD[1], 0, 0])), "stood still; move it too"),
        (moved(NONE, SHIFTS), "moved without turning; turn it by 20 deg or more about two axes"),
        (moved(np.outer(np.arange(6) / 5, [HARD[0], 0, 0]), SHIFTS), "moved without turning; "),
        (moved(ABOUT_Z, NONE), "turned only its last joint, about (0.00, 0.00, 1.00); tilt it "),
        (moved(-ABOUT_Z, 4e-4 * np.sign(SHIFTS) / 2), "turned only its last joint, about (0.00, "),
        (moved(ABOUT_Z, SHIFTS), "turned about one axis only, (0.00, 0.00, 1.00), so that "),
        (moved(ABOUT_Z + 0.02 * ABOUT_Z[:, [2, 1, 0]], SHIFTS), "turned about one axis only, "),
        (moved(ABOUT_Z + 0.1 * ABOUT_Z[::-1][:, [2, 1, 0]], SHIFTS), None),
    ],
)
def test_what_an_arm_did_not_do_is_named(poses: Floats, fault: str | None) -> None:
    found = _fault_of(poses)
    assert found == fault if fault is None else "; ".join(found or ()).startswith(fault)
    assert _stands_still(poses) == (fault is not None and fault.startswith("stood"))
    assert _turns(poses) == (fault is None or fault.startswith("turned"))


def test_a_turn_about_a_line_far_away_is_about_one_line() -> None:
    """Of the first joint, say; not where the arm rises meanwhile."""
    line = np.array([0.3, -0.4, 0.0])
    poses = moved(ABOUT_Z, NONE)
    poses[:, :3, 3] = [line + rotation_exp(turn) @ (poses[0, :3, 3] - line) for turn in ABOUT_Z]
    assert _about_one_line(poses)
    poses[:, 2, 3] += [0, 0.01, 0, 0.02, 0, 0]
    assert not _about_one_line(poses)


def test_a_motion_is_named_that_makes_what_is_weak_known_twice_as_well() -> None:
    """Of what is known a thousand times worse than needed nothing is known."""
    for excess, after, named in ((10.0, 4.9, True), (10.0, 5.1, False), (9e3, 2e3, False),
                                 (9e3, 499.0, True), (9e3, 501.0, False)):  # fmt: skip
        known, better = np.diag([4.0, excess**-2]), np.diag([0.0, after**-2 - excess**-2])
        chosen, left = suggest(known, np.ones(2), {"it": better})
        assert chosen == (["it"] if named else [])
        assert left.excess[0] == pytest.approx(after if named else excess)


@pytest.mark.parametrize(
    ("name", "fewest"),
    [
        ("eye-on-base, flange", (3, 3, 3)),
        ("eye-on-base, marker", (3, 4, 6)),
        ("two arms, flange", (3, 5, 8)),
        ("two arms, marker", (6, 4, 6)),
    ],
)
def test_fewer_sightings_do_than_unknowns_for_what_tells_more(
    name: str, fewest: tuple[int, int, int]
) -> None:
    for feature, count in zip(("pose", "normal", "centre"), fewest, strict=True):
        problem = problem_in(name, feature, 8)
        assert fewest_sightings(problem) == count
        require_enough(problem, 8)
        with pytest.raises(StageError, match="9 poses needed for .* leaves unknown, 8 given"):
            require_enough(problem, 9)


def test_a_round_target_may_be_turned_about_its_axis_and_a_centre_about_all() -> None:
    for feature, turns in (("pose", []), ("normal", [8]), ("centre", [6, 7, 8])):
        placed = problem_in("eye-on-base, marker", feature, 8)
        places = {name: np.eye(4) for name in placed.unknown}
        np.testing.assert_array_equal(symmetry_moves(placed, places), np.eye(12)[:, turns])
        known = problem_in("eye-on-base, flange", feature, 8)
        assert symmetry_moves(known, places).shape == (6, 0)

"""What poses can tell: centres in a mirror are told from centres with noise."""

import re

import numpy as np
import pytest

from flangeye.errors import CalibrationRefused, StageError
from flangeye.estimation.observability import (
    _about_one_line,
    _fault_of,
    _fit_rms,
    _median_distance,
    _stands_still,
    _turns,
    fewest_sightings,
    in_base,
    information_of_centres,
    require_enough,
    require_observable,
    require_poses,
    require_right_handed,
    require_same_units,
    require_several_places,
    robust_sigma,
    spread_of,
    suggest,
    symmetry_moves,
    weak_moves,
)
from flangeye.types import Floats
from flangeye.types.geometry import kabsch, levers, rigid, rotation_exp
from tests.estimation.cells import problem_in


def test_centres_that_fit_in_a_mirror_only_are_refused() -> None:
    rng = np.random.default_rng(0)
    tcps = rng.uniform(-0.2, 0.2, (8, 3))
    centres = (tcps - [0.6, 0.0, 1.0]) @ rotation_exp(np.array([2.0, 0.3, -0.4]))
    noise = 1e-4 * rng.standard_normal((8, 3))
    require_right_handed(centres + noise, tcps)
    require_right_handed(centres + 100 * noise, tcps)  # noise alone is not a mirror
    for axis in range(3):
        mirrored = (centres + noise) * np.where(np.arange(3) == axis, -1.0, 1.0)
        with pytest.raises(CalibrationRefused, match=r"only when mirrored \(0.1 mm rms instead of"):
            require_right_handed(mirrored, tcps)


@pytest.mark.parametrize(
    ("rises", "noise", "refused"),
    [(0.1, 0.018, True), (0.1, 0.0184, False), (5.2e-4, 1e-5, True), (4.8e-4, 1e-5, False)],
)
def test_a_mirror_is_named_that_leaves_a_tenth_of_more_than_a_millimetre(
    rises: float, noise: float, refused: bool
) -> None:
    """A saddle: no turn takes it to its mirror, so it is off by twice its height, less noise."""
    low = np.array([[0.3, 0.3, 0], [-0.3, 0.3, 0], [-0.3, -0.3, 0], [0.3, -0.3, 0]])
    heights = np.array([1.0, -1.0, 1.0, -1.0])
    saddle = low + np.outer(heights, [0.0, 0.0, rises])
    bend = np.outer(heights, [0.0, 0.0, noise])
    centres = saddle * [1.0, 1.0, -1.0] + bend
    if not refused:
        require_right_handed(centres, saddle)
        return
    with pytest.raises(
        CalibrationRefused, match=f"mirrored \\({noise * 1e3:.1f} mm rms instead of "
    ):
        require_right_handed(centres, saddle)


def test_the_noise_that_residuals_show_is_the_noise_of_one_coordinate() -> None:
    rng, sigma, count = np.random.default_rng(1), 1e-3, 6
    found = []
    for _ in range(600):
        centres = rng.uniform(-0.2, 0.2, (count, 3))
        tcps = centres + sigma * rng.standard_normal((count, 3))
        rotation, shift = kabsch(centres, tcps)
        found.append(robust_sigma(tcps - centres @ rotation.T - shift))
    assert np.mean(found) == pytest.approx(sigma, rel=0.06)


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


def test_three_poses_are_needed_and_more_than_one_place() -> None:
    require_poses(3)
    with pytest.raises(StageError, match="4 poses needed, 3 given: "):
        require_poses(3, needed=4)
    with pytest.raises(StageError, match="3 poses needed, 2 given: "):
        require_poses(2)
    around = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    require_several_places(1.01e-3 * around + [0.4, -0.2, 0.3])
    said = r"all 4 poses are at one place, \(0.400, -0.200, 0.300\) m within 0.9 mm: move the arm"
    with pytest.raises(StageError, match=said):
        require_several_places(0.9e-3 * around + [0.4, -0.2, 0.3])


@pytest.mark.parametrize(
    ("ratio", "taken"), [(0.51, True), (1.99, True), (0.49, False), (2.01, False)]
)
def test_centres_are_about_as_far_apart_as_the_poses(ratio: float, taken: bool) -> None:
    tcps = RNG.uniform(-0.2, 0.2, (9, 3))
    if taken:
        require_same_units(ratio * tcps + 5.0, tcps)
        return
    with pytest.raises(
        CalibrationRefused, match=f"the circle centres are {ratio:.4g} times as far apart"
    ):
        require_same_units(ratio * tcps + 5.0, tcps)


def test_of_distances_the_middle_one_counts() -> None:
    line = np.outer([0.0, 1.0, 3.0, 30.0], [0.0, 0.6, 0.8])
    assert _median_distance(line) == pytest.approx(np.median([1, 2, 3, 27, 29, 30]))


def test_centres_inform_of_shifts_by_their_number_and_of_turns_by_their_levers() -> None:
    points = RNG.uniform(-0.3, 0.3, (7, 3)) + 2.0
    found = information_of_centres(points, 1e-3)
    levers = points - points.mean(axis=0)
    inertia = (levers**2).sum() * np.eye(3) - levers.T @ levers
    expected = 1e6 * np.block([[inertia, NONE[:3]], [NONE[:3], 7 * np.eye(3)]])
    assert found == pytest.approx(expected, abs=1e-6)


def test_a_vector_is_written_without_negative_zeros() -> None:
    assert in_base(np.array([-1e-9, 0.99, -0.0126])) == "(0.000, 0.990, -0.013)"
    assert in_base(np.array([-1e-9, 0.99, -0.0126]), 1) == "(0.0, 1.0, 0.0)"


def rotation_known(tcps: Floats, noise: float, limit: float) -> None:
    require_observable(tcps, np.zeros((0, 3)), information_of_centres(tcps, noise), noise, limit)


def test_a_rotation_that_stays_unknown_is_named_with_what_would_show_it() -> None:
    line = np.outer(np.linspace(-0.2, 0.2, 7), [0.0, 0.6, 0.8])
    aside = np.outer([1, -1, 1, 0, 1, -1, 1], [1e-3, 0.0, 0.0])
    with pytest.raises(CalibrationRefused) as on_a_line:
        rotation_known(line + aside, 1e-3, np.radians(1))
    assert str(on_a_line.value) == (
        "the 7 flange centres lie on a line along base (0.00, 0.60, 0.80) within 1.3 mm: rotation "
        "about that line is not observable; move the arm across it"
    )
    rotation_known(line + 100 * aside, 1e-3, np.radians(1))
    # 0.2 m of lever about z alone, and noise that it does not outweigh.
    flat = 0.1 * np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    sigma = 4e-3 / np.sqrt(2 * 0.1**2)  # about x and about y; about z by root 2 better
    rotation_known(flat, 4e-3, 1.01 * sigma)
    for noise, cure in ((4e-3, "spread the poses further, and check"), (6e-3, "no scanner or arm")):
        with pytest.raises(CalibrationRefused) as weak:
            rotation_known(flat, noise, 0.5 * sigma)
        told = f"{np.degrees(sigma * noise / 4e-3):.1f} deg only"
        assert told in str(weak.value) and f"{noise * 1e3:.1f} mm of noise per axis; {cure}" in str(
            weak.value
        )


def test_what_a_shift_would_explain_tells_nothing_of_a_rotation() -> None:
    """Turns about a point far away shift the centres as well: neither is known by it better."""
    flat = 0.1 * np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    limit = 4e-3 / np.sqrt(2 * 0.1**2)
    rows = levers(flat + [3.0, -2.0, 1.0])
    information = np.einsum("nai,naj->ij", rows, rows) / 4e-3**2
    require_observable(flat, np.zeros((0, 3)), information, 4e-3, 1.01 * limit)
    with pytest.raises(CalibrationRefused, match="is known to"):
        require_observable(flat, np.zeros((0, 3)), information, 4e-3, 0.99 * limit)


def test_of_two_rotations_that_are_weak_the_weaker_is_named() -> None:
    """Levers of 100 mm about y and of 50 mm about x, of both about z."""
    flat = np.array([[0.1, 0, 0], [-0.1, 0, 0], [0, 0.05, 0], [0, -0.05, 0]])
    with pytest.raises(CalibrationRefused) as weak:
        rotation_known(flat, 4e-3, 1e-3)
    named = re.match(r"rotation about base \((.*?)\) is known to ([\d.]+) deg", str(weak.value))
    assert named is not None
    axis = [float(x) for x in named[1].split(",")]
    assert np.abs(axis).tolist() == [1.0, 0.0, 0.0]
    assert float(named[2]) == pytest.approx(np.degrees(4e-3 / np.sqrt(2 * 0.05**2)), abs=0.05)


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


def test_a_fit_leaves_the_root_of_the_mean_square_distance() -> None:
    corners = np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])
    bent = corners + np.outer([0.3, -0.3, -0.3, 0.3], [0.0, 0.0, 1.0])
    assert _fit_rms(corners + 3.0, bent) == pytest.approx(0.3)


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
        found = symmetry_moves(problem_in("eye-on-base, marker", feature, 8))
        np.testing.assert_array_equal(found, np.eye(12)[:, turns])
        assert symmetry_moves(problem_in("eye-on-base, flange", feature, 8)).shape == (6, 0)

"""Camera and target that walk at random against each other."""

import numpy as np
import pytest

from flangeye.handeye.smoothing import size_told, smoothed, steps_told
from flangeye.handeye.unknowns import Linear
from flangeye.handeye.walk import Course, Of, StepSize, Walk
from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.maths.statistics import chi2_quantile
from flangeye.types import Floats
from flangeye_plugins.solve.robust import RobustParams, solve_poses
from tests.handeye.cells import CONFIGURATIONS, Noise, errors, given, session, walking

HAND, BASE = CONFIGURATIONS["eye-in-hand, marker"], CONFIGURATIONS["eye-on-base, marker"]


def drawn(grows: bool, n: int = 9, p: int = 4) -> tuple[Walk, StepSize, Linear, Course]:
    """Return a walk, what tells of it and of p other unknowns, and where it is thought to be."""
    rng = np.random.default_rng(0)
    walk, size = Walk(rng.normal(size=(n, 3)), grows), StepSize(0.1, 0.2, 0.3)
    drift, jacobian = rng.normal(size=(n, 6, 7)), rng.normal(size=(n, 6, p))
    linear = Linear(rng.normal(size=(n, 6)), jacobian, np.zeros((n, 6, 6)), drift)
    return walk, size, linear, Course.still(walk)


def led_by_steps(walk: Walk, size: StepSize, linear: Linear) -> Floats:
    """Return (6 N, s N) by how much steps of unit size move what is predicted."""
    n, s = len(walk.about), walk.states
    steps = np.linalg.inv(walk.local()) * np.sqrt(walk.variances(size))[:, None]
    led = np.zeros((n, 6, n, s))
    for k in range(n):
        for j in range(k + 1):
            led[k, :, j] = linear.drift[k, :, :s] @ steps[j]
    return led.reshape(6 * n, -1)


@pytest.mark.parametrize("grows", [False, True])
def test_what_a_walk_takes_is_what_the_dense_covariance_takes(grows: bool) -> None:
    walk, size, linear, course = drawn(grows)
    n, p = linear.jacobian.shape[0], linear.jacobian.shape[2]
    weights = np.tile(3.0 * np.eye(6), (n, 1, 1))
    found = smoothed(walk, size, course, linear, linear.jacobian, weights)
    dense = led_by_steps(walk, size, linear)
    weight = np.linalg.inv(np.eye(6 * n) / 3.0 + dense @ dense.T)
    rows, left = linear.jacobian.reshape(6 * n, p), linear.residuals.ravel()
    np.testing.assert_allclose(3 * rows.T @ rows - found.information, rows.T @ weight @ rows)
    np.testing.assert_allclose(3 * rows.T @ left - found.slope, rows.T @ weight @ left)
    logdet = np.linalg.slogdet(np.eye(6 * n) + 3.0 * dense @ dense.T)[1]
    assert found.logdet == pytest.approx(logdet)
    # What its own move would gain: the weighed squares now, less those that it leaves.
    assert found.gain == pytest.approx(3 * left @ left - left @ weight @ left)
    assert found.cost == 0.0


@pytest.mark.parametrize("grows", [False, True])
def test_steps_are_known_as_by_one_system_of_all_unknowns(grows: bool) -> None:
    """And it moves, with a step of the others, as that system has it."""
    walk, size, linear, course = drawn(grows)
    n, p, s = len(walk.about), 4, walk.states
    found = smoothed(walk, size, course, linear, linear.jacobian, np.tile(np.eye(6), (n, 1, 1)))
    both = np.hstack([linear.jacobian.reshape(6 * n, p), led_by_steps(walk, size, linear)])
    information = both.T @ both + np.diag(np.repeat([0.0, 1.0], [p, n * s]))
    covariance = np.linalg.inv(information)
    roots = np.sqrt(walk.variances(size)).ravel()
    known = (np.diag(covariance)[p:] * roots**2).reshape(n, s)
    assert found.spread(walk, covariance[:p, :p]) == pytest.approx(known[1:])
    answer = covariance @ both.T @ linear.residuals.ravel()
    steps = (answer[p:] * roots).reshape(n, s)
    moved = np.cumsum((np.linalg.inv(walk.local()) @ steps[..., None])[..., 0], axis=0)
    assert found.moved(answer[:p]) == pytest.approx(moved)


def walk_by(steps: Floats, walk: Walk) -> Course:
    """Return the course of (N, 7) steps, each a turn about its point, a shift and a growth."""
    motion, motions = np.eye(4), []
    for step, point in zip(steps, walk.about, strict=True):
        turn = rotation_exp(step[:3])
        motion = rigid(turn, point - turn @ point + step[3:6]) @ motion
        motions.append(motion)
    return Course(np.array(motions), np.cumsum(steps[:, 6]), walk.of)


@pytest.mark.parametrize("grows", [False, True])
def test_a_course_is_made_of_its_steps(grows: bool) -> None:
    rng = np.random.default_rng(1)
    walk = Walk(rng.normal(size=(8, 3)), grows)
    steps = 0.1 * rng.normal(size=(8, 7))
    course = walk_by(steps, walk)
    assert course.steps(walk) == pytest.approx(steps[:, : walk.states])
    size = StepSize(0.2, 0.3, 0.4)
    spread = 0.01 * rng.uniform(size=(7, walk.states))
    told = size_told(walk, size, course, spread)
    for k, at in enumerate((slice(0, 3), slice(3, 6), slice(6, 7))[: 3 if grows else 2]):
        squares = (steps[1:, at] ** 2).sum()
        numbers = steps[1:, at].size - spread[:, at].sum() / size[k] ** 2
        assert told[k] == pytest.approx(np.sqrt(squares / numbers))
    still = size_told(walk, size, Course.still(walk), spread)
    assert still[:2] == (1e-9, 1e-9) and (grows or told.growth == still.growth == 0.4)


def test_the_first_step_leads_from_the_place_and_is_as_large_as_a_third_of_all() -> None:
    for n, share in ((12, 4.0), (2, 1.0)):
        variances = Walk(np.zeros((n, 3)), True).variances(StepSize(0.1, 0.2, 0.3))
        expected = np.repeat([0.01, 0.04, 0.09], (3, 3, 1))
        assert variances[1:] == pytest.approx(np.tile(expected, (n - 1, 1)))
        assert variances[0] == pytest.approx(share * expected)
    assert Walk(np.zeros((3, 3))).variances(StepSize(0.0, 0.0))[1] == pytest.approx(1e-18)


@pytest.mark.parametrize("of", ["base", "camera", "target"])
def test_what_walks_carries_what_stands_on_it_and_a_camera_grows(of: Of) -> None:
    """Seen is what would be seen of poses at which nothing had walked."""
    rng = np.random.default_rng(2)
    s = given("eye-in-hand, marker", "pose", 6).measurements
    course = walk_by(0.1 * rng.normal(size=(6, 7)), Walk(rng.normal(size=(6, 3)), True, of))
    course = course.moved(np.tile([0, 0, 0, 0.1, 0.2, -0.1, 0.3], (6, 1)))
    found = course.applied(s)
    assert found.centres == pytest.approx(s.centres * np.exp(course.growth)[:, None])
    back = np.linalg.inv(course.motions)
    assert found.a == pytest.approx(s.a @ back if of == "camera" else s.a)
    wanted = {"base": course.motions @ s.b, "camera": s.b, "target": s.b @ back}
    assert found.b == pytest.approx(wanted[of])


def test_a_course_is_moved_by_turns_and_shifts_about_the_origin() -> None:
    rng = np.random.default_rng(3)
    course = walk_by(0.1 * rng.normal(size=(5, 7)), Walk(rng.normal(size=(5, 3)), True))
    by = 0.1 * rng.normal(size=(5, 7))
    moved = course.moved(by)
    for k in range(5):
        expected = rigid(rotation_exp(by[k, :3]), by[k, 3:6]) @ course.motions[k]
        assert moved.motions[k] == pytest.approx(expected)
    assert moved.growth == pytest.approx(course.growth + by[:, 6])
    assert course.moved(by[:, :6]).growth == pytest.approx(course.growth)


def test_steps_are_told_by_as_many_numbers_as_their_spread_leaves() -> None:
    walk, size, spread = Walk(np.zeros((9, 3))), StepSize(0.1, 0.2), np.zeros((8, 6))
    spread[:, :3] = 0.5 * 0.1**2
    assert steps_told(walk, size, spread) == pytest.approx([12.0, 24.0])


def distances(cell, draws, n=40, first=0):
    """Return (draws,) squared distances of what the arm's flange carries, of six, and the notes."""
    squares, notes = [], []
    for seed in range(first, first + draws):
        rng = np.random.default_rng(seed)
        made = session(cell, rng, n=n, tilt=0.4, noise=Noise(arm_turn=0.0, arm_shift=0.0))
        walked = walking(made, rng)
        found = solve_poses(walked.observations, RobustParams(), None, cell)
        name = next(name for name in found.transforms if name.startswith("flange"))
        error = errors(found.transforms[name], made.truth[name])
        squares.append(error @ np.linalg.solve(found.transforms[name].covariance, error))
        notes += [note for note in found.notes if "wandered" in note]
    return np.array(squares), notes


@pytest.mark.parametrize("cell", [HAND, BASE], ids=lambda cell: cell.name)
def test_a_random_walk_is_found_and_its_region_holds_the_truth(cell) -> None:
    squares, notes = distances(cell, 5)
    assert len(notes) == 5
    assert (squares <= chi2_quantile(0.95, 6)).sum() >= 4
    assert squares.mean() < 12  # six are expected


@pytest.mark.slow
@pytest.mark.parametrize("cell", [HAND, BASE], ids=lambda cell: cell.name)
def test_regions_under_a_random_walk_hold_their_share(cell) -> None:
    squares, _ = distances(cell, 300, first=100)
    assert 0.93 <= (squares <= chi2_quantile(0.95, 6)).mean() <= 0.99
    assert 5 < squares.mean() < 7  # six are expected


def test_what_rests_does_not_wander() -> None:
    """Noise as large as stated, or twice that: none wandered."""
    for seed in range(4):
        for cell in (HAND, BASE):
            rng = np.random.default_rng(seed)
            made = session(cell, rng, n=30, tilt=0.4, noise=Noise().scaled(1 + seed % 2))
            notes = solve_poses(made.observations, RobustParams(), None, cell).notes
            assert not any("wandered" in note for note in notes)

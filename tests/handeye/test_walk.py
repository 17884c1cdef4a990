"""Camera and target that walk at random against each other."""

import numpy as np
import pytest

from flangeye.handeye.loop import Linear
from flangeye.handeye.smoothing import smoothed, steps_told
from flangeye.handeye.walk import Course, StepSize, Walk
from flangeye.maths.statistics import chi2_quantile
from flangeye_plugins.solve.robust import RobustParams, solve_poses
from tests.handeye.cells import CONFIGURATIONS, Noise, errors, session, walking

HAND, BASE = CONFIGURATIONS["eye-in-hand, marker"], CONFIGURATIONS["eye-on-base, marker"]


def test_what_a_walk_takes_is_what_the_dense_covariance_takes() -> None:
    rng, n, p = np.random.default_rng(0), 9, 4
    walk, size = Walk(rng.normal(size=(n, 3))), StepSize(0.1, 0.2)
    drift, jacobian = rng.normal(size=(n, 6, 6)), rng.normal(size=(n, 6, p))
    residuals, weights = rng.normal(size=(n, 6)), np.tile(3.0 * np.eye(6), (n, 1, 1))
    linear = Linear(residuals, jacobian, np.zeros((n, 6, 6)), drift)
    found = smoothed(walk, size, Course.still(walk), linear, jacobian, weights)
    steps = np.linalg.inv(walk.local()) * np.sqrt(walk.variances(size))[:, None]
    led = np.zeros((n, 6, n, 6))
    for k in range(n):
        for j in range(k + 1):
            led[k, :, j] = drift[k] @ steps[j]
    dense = led.reshape(6 * n, -1)
    weight = np.linalg.inv(np.eye(6 * n) / 3.0 + dense @ dense.T)
    rows, errors_ = jacobian.reshape(6 * n, p), residuals.ravel()
    np.testing.assert_allclose(3 * rows.T @ rows - found.information, rows.T @ weight @ rows)
    np.testing.assert_allclose(3 * rows.T @ errors_ - found.slope, rows.T @ weight @ errors_)
    logdet = np.linalg.slogdet(np.eye(6 * n) + 3.0 * dense @ dense.T)[1]
    assert found.logdet == pytest.approx(logdet)


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

"""What a cell's sightings say of its arms' zeros: against least squares with all unknowns in it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.handeye import cell_arms as rooms
from flangeye.handeye.cell_arms import CorrectedArms, Linear, _explained, _known, _stepped, _told
from flangeye.maths.statistics import covariance_inflation

N, P, K = 12, 6, 5
RNG = np.random.default_rng(0)
ROWS, ZEROS = RNG.normal(size=(N, 6, P)), RNG.normal(size=(N, 6, K))
LEFT, KEPT = RNG.normal(size=(N, 6)), np.arange(N) != 4
WHITENERS = RNG.uniform(0.5, 2.0, (N, 1, 1)) * np.eye(6)
OFF = RNG.normal(size=(N, 6, 3))
TWO = [SimpleNamespace(others=[np.eye(6)[:, :2]]), SimpleNamespace(others=[np.eye(6)[:, 3:4]])]
MOVES: Any = [(TWO[0], RNG.normal(size=(N, 6, 6))), (TWO[1], RNG.normal(size=(N, 6, 6)))]
LINEAR = Linear(LEFT, ROWS, ZEROS, MOVES, WHITENERS, KEPT, 66.0)


def system(size: float, so_far: Any) -> Any:
    """Return rows and sides of all unknowns and zeros, these expected to be none of a size."""
    both = np.concatenate([ROWS, ZEROS], axis=2)
    rows = (WHITENERS @ both)[KEPT].reshape(-1, P + K)
    left = (WHITENERS @ LEFT[..., None])[KEPT].ravel()
    known = np.concatenate([np.zeros((K, P)), np.eye(K) / size], axis=1)
    return np.vstack([rows, known]), np.append(left, so_far / size)


def test_zeros_of_a_size_are_told_beside_the_unknowns() -> None:
    rows, left = system(0.7, np.zeros(K))
    assert LINEAR.information(0.7) == pytest.approx(rows.T @ rows)
    best, *_ = np.linalg.lstsq(rows, left, rcond=None)
    explained = left @ left - ((left - rows @ best) ** 2).sum()
    assert _explained(LINEAR, 0.7) == pytest.approx(explained)
    fit = LINEAR.fit(0.7)
    assert fit.covariance == pytest.approx(np.linalg.inv(rows.T @ rows))
    assert fit.weights == pytest.approx(WHITENERS**2) and fit.inliers is KEPT
    assert fit.jacobian.shape == (N, 6, P + K)


def test_a_step_of_the_offsets_is_that_of_least_squares_with_what_was_corrected() -> None:
    """In units of each arm's deviation; the first joint's zero is the base's."""
    size, moved = 0.7, []

    class Bent(SimpleNamespace):
        def moved(self, by: Any) -> Any:
            moved.append(by)
            return self

    arms: Any = [Bent(offsets=np.array([9.0, 2e-4, -4e-4]), deviation=2e-4, twists=np.zeros((N, 6, 2))),
                 Bent(offsets=np.array([9.0, 3e-4, 0, 6e-4]), deviation=3e-4, twists=np.zeros((N, 6, 3)))]  # fmt: skip
    rows, left = system(size, np.array([1.0, -2.0, 1.0, 0.0, 2.0]))
    step = -np.linalg.lstsq(rows, left, rcond=None)[0][P:]
    assert _stepped(LINEAR, arms, size) == arms
    assert moved[0] == pytest.approx(step[:2]) and moved[1] == pytest.approx(step[2:])


def test_unknowns_follow_errors_as_fits_to_them_would() -> None:
    rows, _ = system(0.7, np.zeros(K))
    errors = (WHITENERS @ OFF)[KEPT].reshape(-1, 3)
    errors = np.vstack([errors, np.zeros((K, 3))])
    moved = np.linalg.lstsq(rows, errors, rcond=None)[0][:P]
    found = LINEAR.following(np.linalg.inv(rows.T @ rows), OFF)
    assert found == pytest.approx(moved @ moved.T)
    alone = rows[:-K, :P]
    moved = np.linalg.lstsq(alone, errors[:-K], rcond=None)[0]
    assert LINEAR.following(np.linalg.inv(alone.T @ alone), OFF) == pytest.approx(moved @ moved.T)
    (others,) = LINEAR.others
    assert others == pytest.approx(
        np.concatenate([MOVES[0][1][:, :, :2], MOVES[1][1][:, :, 3:4]], 2)
    )


def test_the_covariance_beside_zeros_is_as_wide_as_the_residuals_say() -> None:
    given: list[Any] = []

    def mixed(kinds: Any, scales: Any) -> Any:
        given.append((kinds, scales))
        return "joint"

    sizes: Any = SimpleNamespace(
        expected=np.array([0.7, 9.0]), weights=np.full(4, 0.25), mixed=mixed
    )
    found: Any = SimpleNamespace(with_joint=lambda joint: joint)
    rows, left = system(0.7, np.zeros(K))
    covariance = np.linalg.inv(rows.T @ rows)
    for times in (1.0, 0.01):
        linear = Linear(times * LEFT, ROWS, ZEROS, MOVES, WHITENERS, KEPT, 66.0)
        known: Any = _known(found, linear, sizes)
        assert known == "joint"
        taken = K - np.trace(covariance[P:, P:]) / 0.49
        freedom = 66 - P - taken
        scale = max(times**2 * (left[:-K] ** 2).sum() / freedom, 1.0)
        (own, off), scales = given.pop()
        assert own == pytest.approx(scale * covariance_inflation(freedom, 6) * covariance[:P, :P])
        assert off == pytest.approx(linear.following(covariance, linear.others[0]))
        assert scales.tolist() == [1.0] * 4


def test_offsets_are_told_in_milliradians() -> None:
    arms: Any = [SimpleNamespace(name="left", offsets=np.array([0, 1.25e-3]), joints=np.ones((2, 2))),
                 SimpleNamespace(name="right", offsets=np.array([0, -2e-3]), joints=np.ones((2, 2)))]  # fmt: skip
    assert _told(arms) == (
        "the joints of left are off by (0.00, 1.25) mrad, of right are off by (0.00, -2.00) mrad; "
        "the second answer is for them so corrected"
    )
    nothing: Any = None
    corrections = CorrectedArms(nothing, arms).corrections
    assert corrections["right"].tool_offset.tolist() == [0.0] * 3
    assert corrections["right"].joint_offsets is arms[1].offsets


def chosen_by(
    explains: dict[str, float], branches: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> Any:
    """Return the branches that are taken where each explains so much, by itself."""
    sizes = SimpleNamespace(expected=np.array([3.0, 9.0]))
    monkeypatch.setattr(rooms, "_sizes", lambda linear, zeros_alone: sizes)

    def explained(linear: Any, size: float) -> float:
        assert size == 3.0
        return sum(explains[arm] for arm in linear)

    monkeypatch.setattr(rooms, "_explained", explained)
    sighted: Any = SimpleNamespace(linear=lambda found, arms: arms)
    given: Any = branches
    return rooms.likeliest(sighted, sighted, given)


def test_each_arm_is_taken_on_the_branch_that_explains_most(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    explains = {"up": 1.0, "down": 5.0, "left": 3.0, "right": 2.0, "back": 4.0, "only": 0.0}
    branches = [["up", "down"], ["only"], ["left", "right", "back"]]
    assert chosen_by(explains, branches, monkeypatch) == ["down", "only", "back"]
    explains["down"], explains["back"] = 0.5, 1.0
    assert chosen_by(explains, branches, monkeypatch) == ["up", "only", "left"]


def test_zeros_are_found_in_three_steps_each_about_those_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Seen(SimpleNamespace):
        def linear(self, found: Any, arms: Any) -> Any:
            return self.offset, found, arms

        def with_arms(self, arms: Any) -> Any:
            return Seen(offset=arms)

        def solved(self, start: Any) -> Any:
            return SimpleNamespace(places=(start, self.offset))

    monkeypatch.setattr(rooms, "_stepped", lambda linear, arms, size: arms + size)
    sighted: Any = Seen(offset=0)
    begun: Any = 0
    reported: Any = SimpleNamespace(places="as reported")
    answer: Any = rooms._corrected(reported, sighted, begun, 2.0)
    found, linear, arms = answer
    assert arms == 6.0 and found.places == ((("as reported", 2.0), 4.0), 6.0)
    assert linear == (6.0, found, 6.0)

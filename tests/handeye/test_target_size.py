"""A factor on the camera's distances: what the arm's motion tells of it, and when it is refused."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.errors import CalibrationRefused
from flangeye.handeye import target_size
from flangeye.handeye.candidates import Model
from flangeye.handeye.consensus import Consensus
from flangeye.handeye.likelihood import with_noise
from flangeye.handeye.loop import LoopProblem
from flangeye.handeye.target_size import (
    EstimatedFactor,
    correlation,
    deeper,
    estimated_factor,
    longer_distances,
    require_size,
)
from flangeye.maths.statistics import f_quantile
from tests.handeye.cells import ISSUE, fitted, given, two_numbers

HAND = "eye-in-hand, marker"


def resized(factor: float, focal: float = 1.0) -> LoopProblem:
    """Return a problem whose camera takes all distances, or those in depth, for longer."""
    problem = given(HAND, "pose", 14, ISSUE.scaled(0.1), stated=False)
    s = problem.measurements
    return replace(
        problem, measurements=replace(s, centres=s.centres * factor * np.array([1, 1, focal]))
    )


def modelled(problem: LoopProblem) -> Model:
    return Model(Consensus(problem, fitted(problem)))


@pytest.mark.parametrize("factor", [1.02, 0.97])
def test_a_factor_on_distances_is_found_beside_all_else(factor: float) -> None:
    problem = resized(factor)
    told = estimated_factor(modelled(problem), longer_distances(problem.measurements))
    assert told.share == pytest.approx(1 / factor - 1, abs=4 * told.sigma)
    assert told.sigma < 1e-3 and told.is_certain
    assert told.freedom > 14 and told.score == pytest.approx((told.share / told.sigma) ** 2)


def test_what_is_longer_moves_what_is_seen_away() -> None:
    s = resized(1.0).measurements
    longer = longer_distances(s)
    assert longer[:, 3:, 0] == pytest.approx(-s.centres) and not longer[:, :3].any()
    assert deeper(longer)[:, 5, 0] == pytest.approx(-s.centres[:, 2])
    assert not deeper(longer)[:, :5].any()


def test_a_factor_is_certain_beyond_what_chance_gives_once_in_a_million() -> None:
    limit = np.sqrt(f_quantile(1 - 1e-6, 1, 30.0)) * 2e-3
    assert EstimatedFactor(1.001 * limit, 2e-3, 30.0).is_certain
    assert not EstimatedFactor(0.999 * limit, 2e-3, 30.0).is_certain


@pytest.mark.parametrize(
    ("size", "focal", "told"),
    [
        ((0.03, 1e-3), (0.02, 1e-3), "the target is 1.0300 +- 0.0010 times as large as was said"),
        ((0.03, 2e-3), (0.02, 1e-3), "focal length is 1.0200 +- 0.0010 times as long as was said"),
        ((-0.03, 1e-3), (0.02, 1e-3), "the target is 0.9700 +- 0.0010 times as large as was said"),
        ((0.009, 1e-4), (0.02, 1e-3), None),  # within the limit
        ((0.03, 2e-2), (0.02, 2e-2), None),  # not certain
        ((-1.0, 1e-3), (0.02, 1e-3), None),  # of no size at all
    ],
)
def test_the_surer_of_size_and_focal_length_is_named(
    size: tuple[float, float], focal: tuple[float, float], told: str | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    def factor(model: Model, moves: Any, arms: Any = ()) -> EstimatedFactor:
        return EstimatedFactor(*(size if moves[:, :5].any() else focal), freedom=50.0)

    monkeypatch.setattr(target_size, "estimated_factor", factor)
    model = modelled(resized(1.0))
    if told is None:
        require_size(model, 0.01, ())
        return
    with pytest.raises(CalibrationRefused) as refused:
        require_size(model, 0.01, ())
    assert told in str(refused.value)
    require_size(model, 0.05, ())
    circles = modelled(given("eye-on-base, flange", "normal", 6))
    require_size(circles, 0.01, ())


def test_what_the_arm_may_be_off_by_is_in_the_deviation_before_anything_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arms: Any = [[None]]
    monkeypatch.setattr(target_size, "last_unknown_by_arms", lambda *_: 0.02)
    model = modelled(resized(1.03))
    with pytest.raises(CalibrationRefused):
        require_size(model, 0.01, ())
    require_size(model, 0.01, arms)


def test_scores_that_are_alike_in_time_vary_more_in_sum() -> None:
    """Of nine, lags of one, two and three by three quarters, a half and a quarter."""
    scores = np.array([3.0, 2, 2, 1, 0, -1, -2, -2, -3]) + 7.0
    c = scores - 7.0
    shared = 0.75 * c[1:] @ c[:-1] + 0.5 * c[2:] @ c[:-2] + 0.25 * c[3:] @ c[:-3]
    assert correlation(scores) == pytest.approx(1 + 2 * shared / (c @ c))
    assert correlation(np.array([1.0, -1.0] * 8)) == 1.0
    assert correlation(np.ones(9)) == 1.0


@pytest.mark.parametrize("stated", [True, False])
def test_a_factor_is_looked_for_beside_noise_in_depth_where_noise_is_not_stated(
    stated: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which would hide a wrong focal length; what poses tell of other nuisances stays."""
    problem = replace(resized(1.0), stated=stated, nuisance=two_numbers(14))
    seen: list[LoopProblem] = []

    def watched(problem: LoopProblem, found: Any) -> Any:
        seen.append(problem)
        return with_noise(problem, found)

    monkeypatch.setattr(target_size, "with_noise", watched)
    estimated_factor(modelled(problem), longer_distances(problem.measurements))
    (free,) = seen
    assert free.in_depth == (not stated) and len(free.nuisance) == 3
    assert np.isinf(free.nuisance.prior[2]) and free.nuisance.mean[2] == 0.0

"""How the groove is sought: down until something is touched, across, and what counts as a wall."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flangeye.types import Floats
from flangeye_plugins.weld.following.model_prior import ModelPrior
from flangeye_plugins.weld.following.search import SweepSearch
from flangeye_plugins.weld.settings import Following

SETTINGS = Following()
PRELOAD, REACH = SETTINGS.preload, SETTINGS.reach
QUIET = ModelPrior(40e-3, noise=(1e-9, 1e-9))


def rested(
    prior: ModelPrior = QUIET, rest: Any = (0.0, 0.0, 0.0), settings: Following = SETTINGS
) -> SweepSearch:
    """Return a search whose tip was measured in the air."""
    search = SweepSearch(settings, prior)
    for _ in range(10):
        assert search.resting
        search.feel(np.array(rest), 0.0, 0.0)
    return search


def fed(search: SweepSearch, count: int, deflection: float, compression: float) -> SweepSearch:
    for _ in range(count):
        search.feel(np.zeros(3), deflection, compression)
    return search


def test_the_tip_is_measured_ten_times_in_the_air_and_its_middle_counts() -> None:
    search, rng = (
        SweepSearch(SETTINGS, ModelPrior(40e-3, noise=(10e-6, 60e-6))),
        np.random.default_rng(0),
    )
    seen: Floats = rng.normal(0.0, [5e-6, 40e-6, 20e-6], (10, 3)) + [1e-4, -2e-4, 3e-4]
    seen[3] += 1e-2
    for i, each in enumerate(seen):
        assert search.resting == (i < 10)
        search.feel(each, 0.0, 0.0)
    assert not search.resting and search.rest == pytest.approx(np.median(seen, axis=0))
    assert search.sigma == pytest.approx(np.maximum([10e-6, 10e-6, 60e-6], seen.std(axis=0)))


def test_a_tip_that_scatters_is_measured_longer_and_no_rest_is_taken_for_a_touch() -> None:
    scatter, false, counts = np.array([0.19e-3, 0.19e-3, 1.14e-3]), 0, []
    for seed in range(200):
        search, rng = SweepSearch(SETTINGS, ModelPrior(40e-3)), np.random.default_rng(seed)
        counts.append(0)
        while search.resting:
            search.feel(scatter * rng.normal(size=3), 0.0, 0.0)
            counts[-1] += 1
        for _ in range(200):
            search.feel(np.zeros(3), 0.0, 1.14e-3 * rng.normal() - search.rest[2])
        false += search.down
    assert np.median(counts) > 100
    assert false <= 4  # of 200; 52 are with ten measurements


@pytest.mark.parametrize(
    ("rest", "bent"),
    [
        ((0.49e-3, 0, 0), False),
        ((0, 0.51e-3, 0), True),
        ((0.4e-3, 0.4e-3, 0), True),
        ((0, 0, 9e-3), False),
    ],
)
def test_a_tip_that_is_bent_aside_by_half_a_millimetre_touches_something(
    rest: Any, bent: bool
) -> None:
    assert rested(rest=rest).bent == bent


def test_a_tip_that_moves_about_in_the_air_is_not_free() -> None:
    search = SweepSearch(SETTINGS, ModelPrior(40e-3))
    for i in range(10):
        search.feel(np.array([(-1) ** i * 0.6e-3, 0.0, 0.0]), 0.0, 0.0)
    assert np.linalg.norm(search.rest) < 0.5e-3 and search.bent


def test_a_tag_that_is_misread_once_bends_nothing() -> None:
    search = SweepSearch(SETTINGS, ModelPrior(40e-3))
    for i in range(10):
        search.feel(np.array([6e-3 * (i == 4), 0.0, 0.0]), 0.0, 0.0)
    assert not search.bent


def test_something_is_touched_at_half_the_preload_by_three_measurements() -> None:
    search = fed(rested(), 9, 0.0, 0.49 * PRELOAD)
    assert not search.down and search.step(0.0) == 0.0
    fed(search, 1, 0.0, 0.51 * PRELOAD)
    assert not search.down  # the mean of three is not yet above it
    assert fed(search, 1, 0.0, 0.51 * PRELOAD).down


def test_the_noisier_a_tip_is_the_more_measurements_are_taken_to_a_mean() -> None:
    """As many as make it four standard deviations of their mean; sixty at most."""
    for sigma, count in ((0.0, 3), (0.5, 4), (0.8, 11), (1.2, 24), (9.0, 60)):
        upright = max(sigma * PRELOAD / 2, 1e-9)
        search = fed(rested(ModelPrior(40e-3, noise=(1e-9, upright))), count - 1, 0.0, PRELOAD)
        assert not search.down
        assert fed(search, 1, 0.0, PRELOAD).down


def test_a_seat_bears_when_its_preload_is_right_to_a_tenth() -> None:
    """A tip that still slides down its wall has three quarters of it."""
    search = fed(rested(), 3, 0.0, PRELOAD)
    for share, seated in ((0.91, True), (0.89, False), (1.09, True), (1.11, False)):
        assert fed(search, 15, 0.0, share * PRELOAD).seated == seated


@pytest.mark.parametrize("friction", [SETTINGS.friction, 0.0])
def test_a_wall_is_felt_beyond_what_friction_gives_and_half_of_what_the_tip_probes_by(
    friction: float,
) -> None:
    settings = Following.model_validate({"friction": friction})
    wall = max(1.1 * QUIET.sliding(settings), settings.probe / 2)
    assert friction or wall == settings.probe / 2
    for share, found in ((0.98, False), (1.02, True), (-0.98, False), (-1.02, True)):
        search = fed(rested(settings=settings), 3, 0.0, PRELOAD)
        assert fed(search, 15, share * wall, PRELOAD).found == found
        if found:
            assert fed(search, 15, 0.0, PRELOAD).found  # it stays so


def test_the_sweep_goes_as_far_to_either_side_and_ends() -> None:
    search = fed(rested(), 3, 0.0, PRELOAD)
    assert search.step(0.0) == pytest.approx(REACH)
    assert search.step(REACH - 0.21e-3) == pytest.approx(0.21e-3) and not search.over
    assert search.step(REACH - 0.19e-3) == pytest.approx(-2 * REACH + 0.19e-3)
    assert search.step(-REACH + 0.21e-3) == pytest.approx(-0.21e-3) and not search.over
    assert search.step(-REACH + 0.1e-3) == 0.0 and search.over


@pytest.mark.parametrize(("side", "sign"), [("left", 1.0), ("right", -1.0)])
def test_where_one_wall_alone_holds_the_tip_that_one_is_looked_for(side: str, sign: float) -> None:
    settings = Following.model_validate({"side": side})
    prior = ModelPrior(40e-3, noise=(1e-9, 1e-9), two_walls=False)
    search = fed(rested(prior, settings=settings), 3, 0.0, PRELOAD)
    assert search.step(0.0) == pytest.approx(sign * REACH)
    assert search.step(sign * REACH) == 0.0 and search.over

"""The torch's bound, predicted along the plan before anything moves."""

from __future__ import annotations

from dataclasses import replace
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye_emulators.weld_world.truth import WeldTruth
from flangeye_plugins.weld.following.bound import Predicted, best_sweep_fit, check_bound, predicted
from flangeye_plugins.weld.following.model_prior import ModelPrior
from flangeye_plugins.weld.following.probing import SOFTER
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following
from tests.plugins.weld.bench import circle, following, straight
from tools.weld_bench import curved, try_condition
from tools.weld_conditions import Condition

BEND, DISTANCE = 0.05, 0.04


def foreseen(plan: Path, prior: ModelPrior, settings: Following) -> Predicted:
    return predicted(plan, prior, settings, *best_sweep_fit(prior, settings))


@pytest.mark.parametrize("sigmas", [2.0, 3.0, 4.0])
def test_the_files_are_known_to_so_many_sigma_within_the_error_that_is_allowed(
    sigmas: float,
) -> None:
    plan, prior = Path(straight(0.12)), ModelPrior(DISTANCE, torch_sigma=0.2e-3, along_sigma=0.0)
    asked = following(sigmas=sigmas, gain_drift=0.0)
    # Four places, as far from each other as torch and tip: the bound holds at all of them.
    beyond = (1.0 - NormalDist().cdf(sigmas)) / (1.0 + 0.12 / DISTANCE)
    bound = NormalDist().inv_cdf(1.0 - beyond) * np.sqrt(prior.fixed_variance(asked))
    check_bound(plan, prior, asked.model_copy(update={"max_error": 1.001 * bound}))
    with pytest.raises(StageError, match=f"{bound * 1e3:.2f} mm at best, .* calibrate the tool"):
        check_bound(plan, prior, asked.model_copy(update={"max_error": 0.999 * bound}))


def test_in_a_bend_the_tool_stands_askew_and_turns() -> None:
    """Tip and torch are both on a circle: the chord of 40 mm stands at half its arc to it."""
    prior = ModelPrior(DISTANCE, along_sigma=0.5e-3, tip_sigma=0.3e-3)
    alone = replace(prior, two_walls=False)  # no sweep tells how far ahead the tip is
    found = foreseen(Path(circle(BEND)), alone, following())
    chord = np.arcsin(DISTANCE / 2 / BEND)
    half = chord + 2e-3 / DISTANCE  # one wall is pressed by 2 mm, to the left
    middle = (found.s > 0.045) & (found.s < 0.05)
    np.testing.assert_allclose(found.askew[middle], (0.5e-3 * np.sin(half)) ** 2, rtol=0.05)
    np.testing.assert_allclose(found.tip[middle], (0.3e-3 * 2 * np.sin(half)) ** 2, rtol=0.2)
    swept = foreseen(Path(circle(BEND)), prior, following())  # it tells how far ahead the tip is
    softer = 2e-3 / SOFTER
    half = chord + softer / DISTANCE
    told = (0.02e-3 * 2 * np.sin(half)) ** 2 + (0.3e-3 * 2 * np.sin(half) ** 2) ** 2
    np.testing.assert_allclose(swept.tip[middle], told, rtol=0.3)
    line = foreseen(Path(straight(0.12)), prior, following())
    assert line.askew.max() == pytest.approx((0.5e-3 * softer / DISTANCE) ** 2, rel=0.01)
    assert line.tip.max() < 1e-14


@pytest.mark.parametrize(
    ("prior", "asked", "told"),
    [
        (
            {"along_sigma": 2e-3},
            {},
            "most of it along_sigma, because the tool is askew to the seam",
        ),
        ({"tip_sigma": 2e-3}, {}, "most of it tip_sigma, because the tool turns"),
        (
            {},
            {"gain_drift": 0.9},
            "most of it the finger's gain and play, and the weave.*weld faster",
        ),
    ],
)
def test_what_is_largest_and_what_lessens_it_is_said(prior: Any, asked: Any, told: str) -> None:
    with pytest.raises(StageError, match=told):
        check_bound(Path(circle(BEND)), ModelPrior(DISTANCE, **prior), following(**asked))


def test_the_follower_states_no_less_than_was_predicted() -> None:
    """And little more where nothing is wrong: what it feels is all that comes on top."""
    condition = Condition(
        WeldTruth(), {"max_error": "2 mm"}, (0.0, 0.0), {"along_sigma": 1e-3, "tip_sigma": 0.2e-3}
    )
    found = try_condition(condition, 0, 0.1, 16e-3)
    expected = foreseen(Path(curved(0.1)), ModelPrior(DISTANCE, **condition.prior), Following())
    inside = (found.column("torch_s") > 0.01) & (found.column("torch_s") < 0.09)
    s, sigma = found.column("torch_s")[inside], found.column("bound")[inside] / 3.0
    least = np.sqrt(np.interp(s, expected.s, expected.variance - expected.felt))
    assert found.done
    assert (sigma > 0.97 * least).all()
    assert np.median(sigma / least) < 1.5

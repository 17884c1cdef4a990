"""Which part has changed: the same whatever was thought before of where the scanner stands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from flangeye.types import Floats
from flangeye.types.geometry import hat
from flangeye.workflow.doctor.monitor.attribution import (
    _noise,
    attribute_change,
    explained,
    suspects,
)
from flangeye.workflow.doctor.monitor.drift import CheckSightings, Information, allowance
from tools.checked_year import ABOUT, Happening, Year, watch

DAILY = 3e-5
WATCHED = watch(Year(checks=3), Happening(), np.random.default_rng(0))
SEEN, BEFORE = WATCHED.sightings.of(0, 3), Information.of_covariance(WATCHED.prior)
THOUGHT = np.array([1e-4, -2e-4, 3e-4, 2e-4, -1e-4, 3e-4])


def thought(sign: float = 1.0) -> tuple[Information, CheckSightings]:
    """Return what is known and seen with the scanner thought to stand elsewhere [rad, m]."""
    known = Information(BEFORE.matrix, BEFORE.vector + BEFORE.matrix @ (sign * THOUGHT))
    return known, replace(SEEN, residuals=SEEN.residuals - SEEN.effects @ (sign * THOUGHT))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_who_is_blamed_does_not_depend_on_where_motions_are_taken_from(sign: float) -> None:
    plain = attribute_change(BEFORE, SEEN, ABOUT, WATCHED.scanner, DAILY)
    moved = attribute_change(*thought(sign), ABOUT, WATCHED.scanner, DAILY)
    assert sum(plain.values()) == pytest.approx(1.0)
    assert moved == pytest.approx(plain, rel=1e-6)
    assert [p for _, p in suspects(plain)] == sorted((p for _, p in suspects(plain)), reverse=True)
    assert sum(p for _, p in suspects(plain)) == pytest.approx(1.0)


def test_scatter_as_it_was_is_explained_and_a_centimetre_of_it_is_not() -> None:
    assert explained(BEFORE, SEEN, ABOUT, WATCHED.scanner, DAILY)
    assert explained(*thought(), ABOUT, WATCHED.scanner, DAILY)
    wild = 0.01 * np.random.default_rng(1).standard_normal(SEEN.residuals.shape)
    spoilt = replace(SEEN, residuals=SEEN.residuals + wild)
    assert not explained(BEFORE, spoilt, ABOUT, WATCHED.scanner, DAILY)


def test_what_sightings_scatter_by_is_their_own_the_days_and_what_was_known() -> None:
    """The arm's weights, beside the camera's six, are known as before and alike at every check."""
    rng = np.random.default_rng(2)
    n, weights = len(SEEN.residuals), 4
    effects = np.concatenate([SEEN.effects, rng.normal(size=(n, 5, weights))], axis=2)
    spread = rng.normal(size=(6 + weights, 6 + weights))
    before = Information.of_covariance(spread @ spread.T + 0.1 * np.eye(6 + weights))
    told = _noise(before, replace(SEEN, effects=effects), 0.5)
    for i in range(n):
        for j in range(n):
            expected = effects[i] @ before.covariance @ effects[j].T
            if SEEN.check[i] == SEEN.check[j]:
                expected += effects[i][:, :6] @ allowance(0.5) @ effects[j][:, :6].T
            if i == j:
                expected += SEEN.covariances[i]
            block = told[5 * i : 5 * i + 5, 5 * j : 5 * j + 5]
            np.testing.assert_allclose(block, expected, rtol=1e-9, atol=1e-9)


def test_blame_is_the_same_with_weights_of_the_arm_that_do_nothing() -> None:
    n = len(SEEN.residuals)
    more = replace(SEEN, effects=np.concatenate([SEEN.effects, np.zeros((n, 5, 2))], axis=2))
    wide = np.eye(8)
    wide[:6, :6] = WATCHED.prior
    plain = attribute_change(BEFORE, SEEN, ABOUT, WATCHED.scanner, DAILY)
    weighed = attribute_change(Information.of_covariance(wide), more, ABOUT, WATCHED.scanner, DAILY)
    assert weighed == pytest.approx(plain, rel=1e-6)
    assert explained(Information.of_covariance(wide), more, ABOUT, WATCHED.scanner, DAILY)


def one_sighting(residual: Floats) -> CheckSightings:
    """Return one sighting by a scanner that stands a metre above, nothing else being known."""
    own = 1e-8 * np.eye(5)[None]
    effects = np.concatenate([-hat(np.array([[0, 0, -1.0]])), np.eye(3)[None]], axis=2)
    effects = np.concatenate([effects, np.zeros((1, 2, 6))], axis=1)
    turned = np.eye(3)[None]
    return CheckSightings(residual[None], effects, own, turned, None, np.zeros(1, dtype=int))


NOTHING = Information.of_covariance(1e-12 * np.eye(6))


@pytest.mark.parametrize(("share", "told"), [(0.99, True), (1.01, False)])
def test_a_part_may_be_off_by_a_tenth_of_a_metre_or_radian_and_no_chance_is_one_in_a_million(
    share: float, told: bool
) -> None:
    """Along the line to the scanner, where its turns move nothing: by a shift, or the flange."""
    limit = np.sqrt(stats.chi2(5).isf(1e-6) * (0.1**2 + 1e-8))
    seen = one_sighting(share * limit * np.eye(5)[2])
    above = np.array([0.0, 0.0, 1.0])
    assert explained(NOTHING, seen, above, above, 1e-9) == told


def test_each_part_is_as_likely_as_what_it_does_by_a_millimetre_or_milliradian() -> None:
    """By the normal distributions of what is seen, the parts being as likely beforehand."""
    seen = one_sighting(np.array([1.2e-3, -0.3e-3, 0.8e-3, 0.0, 0.0]))
    above = np.array([0.0, 0.0, 1.0])
    noise = 1e-8 * np.eye(5)
    turned, shifted = np.diag([1.0, 1.0, 0, 0, 0]) * 1e-6, np.diag([1.0, 1.0, 1.0, 0, 0]) * 1e-6
    does = {
        "scanner turned": turned, "scanner shifted": shifted,
        "scanner moved": turned + shifted, "flange replaced": shifted,
    }  # fmt: skip
    density = {
        part: stats.multivariate_normal(np.zeros(5), noise + spread).pdf(seen.residuals[0])
        for part, spread in does.items()
    }
    expected = {part: each / sum(density.values()) for part, each in density.items()}
    assert attribute_change(NOTHING, seen, above, above, 1e-9) == pytest.approx(expected, rel=1e-3)


def test_a_joint_by_itself_or_the_arm_is_blamed_by_what_joints_do() -> None:
    """Not the first, which turns the base as the scanner would."""
    columns = np.zeros((1, 5, 3))
    columns[0, 0, 0], columns[0, 1, 1], columns[0, 2, 2] = 0.5, 0.7, 0.9
    seen = replace(one_sighting(np.array([0.0, 2e-3, 0.0, 0.0, 0.0])), joints=columns)
    above = np.array([0.0, 0.0, 1.0])
    parts = attribute_change(NOTHING, seen, above, above, 1e-9)
    assert {p for p in parts if "re-mastered" in p} == {
        "joint 2 re-mastered", "joint 3 re-mastered", "arm re-mastered",
    }  # fmt: skip
    one = np.diag([1e-8, 1e-8 + (0.7e-3) ** 2, 1e-8, 1e-8, 1e-8])
    arm = one + np.diag([0, 0, (0.9e-3) ** 2, 0, 0])
    ratio = [stats.multivariate_normal(np.zeros(5), s).pdf(seen.residuals[0]) for s in (one, arm)]
    assert parts["joint 2 re-mastered"] / parts["arm re-mastered"] == pytest.approx(
        ratio[0] / ratio[1], rel=1e-3
    )

"""Whether an answer is the best of all: shown where it is, not shown where it is not."""

import numpy as np
import pytest

from flangeye.handeye import certificate
from flangeye.handeye.certificate import NOT_SHOWN, Certificate, Sightings, certify
from flangeye.maths.geometry import invert, rigid, rotation_exp
from flangeye.types import Floats
from flangeye_plugins.solve.robust import RobustParams, solve_poses
from tests.handeye.cells import CONFIGURATIONS, ROBOT, session

OPTIMAL = "globally optimal: nowhere is there an answer that fits the agreeing poses better"


def anywhere(rng: np.random.Generator) -> Floats:
    axis = rng.standard_normal(3)
    turn = rotation_exp(rng.uniform(-np.pi, np.pi) * axis / np.linalg.norm(axis))
    return rigid(turn, rng.uniform(-1, 1, 3))


def sighted(noise: tuple[float, float], seed: int) -> tuple[Sightings, Floats, Floats]:
    """Fifteen sightings of A X M = Y with noise [rad, m], X and Y."""
    rng = np.random.default_rng(seed)
    x, y, seen = anywhere(rng), anywhere(rng), []
    a = np.array([rigid(rotation_exp(rng.uniform(-0.8, 0.8, 3)), rng.uniform(-0.4, 0.4, 3))
                  for _ in range(15)])  # fmt: skip
    for exact in invert(a @ x) @ y:
        turn = exact[:3, :3] @ rotation_exp(noise[0] * rng.standard_normal(3))
        seen.append(rigid(turn, exact[:3, 3] + noise[1] * rng.standard_normal(3)))
    still = np.broadcast_to(np.eye(4), a.shape)
    weights = (np.full(15, each**-2.0) for each in noise)
    return Sightings(a, np.array(seen), still, still, *weights), x, y


@pytest.mark.parametrize("noise", [(1e-3, 1e-4), (5e-3, 1e-3), (3e-2, 5e-3), (0.2, 2e-2)])
@pytest.mark.parametrize("seed", range(3))
def test_the_best_answer_is_certified(noise: tuple[float, float], seed: int) -> None:
    sightings, x, y = sighted(noise, seed)
    shown = certify(sightings, x, y)
    assert shown.optimal
    assert shown.missing < 1e-3 * shown.cost
    assert 0.6 * 78 < shown.cost < 1.5 * 78  # numbers measured less those found


def test_another_valley_is_not_certified() -> None:
    rng, found = np.random.default_rng(7), 0
    for seed in range(3):
        sightings, x, y = sighted((5e-3, 1e-3), seed)
        best = certify(sightings, x, y)
        for _ in range(5):
            other = certify(sightings, anywhere(rng), anywhere(rng))
            if other.cost > 1.01 * best.cost:
                found += 1
                assert not other.optimal
                assert other.missing >= (1 - 1e-6) * (other.cost - best.cost)  # it is a bound
    assert found >= 2


@pytest.mark.parametrize("name", ["eye-in-hand, marker", "eye-on-base, marker"])
def test_a_solver_says_so(name: str) -> None:
    made = session(CONFIGURATIONS[name], np.random.default_rng(3), n=15)
    told = solve_poses(made.observations, RobustParams(certify=True), ROBOT, made.configuration)
    assert told.notes[-1] == OPTIMAL


def test_what_cannot_be_shown_is_said_to_be_so() -> None:
    made = session(CONFIGURATIONS["two arms, marker"], np.random.default_rng(3), n=15)
    told = solve_poses(made.observations, RobustParams(certify=True), ROBOT, made.configuration)
    assert told.notes[-1] == (
        f"{NOT_SHOWN}: that can be done for whole poses and two unknown places alone"
    )


@pytest.mark.parametrize(
    ("cost", "missing", "told"), [(8.0, 1.0, "12.5%"), (2.0, 5.0, "100.0%"), (0.0, 0.0, "0.0%")]
)
def test_how_much_better_another_answer_may_be_is_said(
    cost: float, missing: float, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def shown(sightings: Sightings, x: Floats, y: Floats) -> Certificate:
        return Certificate(np.array([x[:3, :3], y[:3, :3]]), cost, missing, False)

    monkeypatch.setattr(certificate, "certify", shown)
    made = session(CONFIGURATIONS["eye-in-hand, marker"], np.random.default_rng(3), n=15)
    found = solve_poses(made.observations, RobustParams(certify=True), ROBOT, made.configuration)
    assert found.notes[-1] == (
        f"{NOT_SHOWN}: another answer may leave squared errors less by {told}"
    )

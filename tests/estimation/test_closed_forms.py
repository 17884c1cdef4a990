"""Closed forms: exact on exact data, within their known errors on noise, no worse than OpenCV 4's."""

from typing import Any

import numpy as np
import pytest

from flangeye import CalibrationRefused, StageError
from flangeye.estimation.start.closed import alternate, motions_of, park_martin, random_rotations
from flangeye.types.geometry import invert, rigid, rotation_exp, rotation_log
from flangeye_plugins.solve.literature import _ratios, kronecker, tsai_lenz, two_steps
from flangeye_plugins.solve.named import CLOSED_FORMS, ClosedFormParams
from tests.estimation.arms import REAL, drawn
from tests.estimation.cells import (
    CONFIGURATIONS,
    ROBOT,
    Noise,
    Session,
    errors,
    moves,
    rotation,
    session,
)

EXACT = Noise(0.0, 0.0, 0.0, 0.0)
STAGES = {stage.name: stage for stage in CLOSED_FORMS}
ONE_ARM = ["tsai_lenz", "park_martin", "horaud_dornaika", "andreff", "daniilidis", "shah", "li"]
CONFIGURATIONS_OF_ONE_ARM = [
    "eye-on-base, marker", "eye-in-hand, marker", "eye-on-arm 1, marker", "eye-on-arm 2, marker",
    "two arms, flange",
]  # fmt: skip


def solve(name, made):
    stage = STAGES[f"solve.{name}"]
    return stage(made.stream(), ClosedFormParams(), made.configuration, ROBOT)


@pytest.mark.parametrize(
    ("name", "configuration"),
    [(name, "eye-on-base, marker") for name in ONE_ARM]
    + [("park_martin", each) for each in CONFIGURATIONS_OF_ONE_ARM[1:]]
    + [("shah", each) for each in CONFIGURATIONS_OF_ONE_ARM[1:]],
)
def test_exact_poses_give_the_exact_answer(name: str, configuration: str) -> None:
    made = session(
        CONFIGURATIONS[configuration], np.random.default_rng(1), n=8, tilt=0.5, noise=EXACT
    )
    found = solve(name, made)
    for unknown, estimate in found.transforms.items():
        assert np.abs(errors(estimate, made.truth[unknown])).max() < 1e-8
    assert found.method == f"solve.{name}"


@pytest.mark.parametrize(
    ("configuration", "feature"),
    [
        ("eye-on-base, flange", "centre"), ("eye-in-hand, base circle", "normal"),
        ("eye-in-hand, marker", "centre"), ("eye-in-hand, marker", "normal"),
        ("eye-on-arm 1, flange", "centre"), ("eye-on-arm 2, base circle", "centre"),
        ("two arms, flange", "centre"), ("two arms, flange", "normal"),
    ],
)  # fmt: skip
def test_exact_circles_give_the_exact_answer(configuration: str, feature: str) -> None:
    made = session(
        CONFIGURATIONS[configuration], np.random.default_rng(2), noise=EXACT, feature=feature
    )
    estimate = solve("linear", made).camera
    assert np.abs(errors(estimate, made.truth[estimate.transform.name])).max() < 1e-8


def test_kronecker_is_exact_for_two_arms() -> None:
    made = session(CONFIGURATIONS["two arms, marker"], np.random.default_rng(3), noise=EXACT)
    for unknown, estimate in solve("kronecker", made).transforms.items():
        assert np.abs(errors(estimate, made.truth[unknown])).max() < 1e-7


def resting(rng, n=8):
    """Return A, B, C, X, Y, Z of two arms of which one rests while the other moves."""
    x, y, z = (rigid(rotation(rng), rng.normal(0, 0.3, 3)) for _ in range(3))
    a = rigid(rotation(rng), rng.normal(0, 0.3, 3)) @ moves(rng, 2 * n, 0.4)
    c = rigid(rotation(rng), rng.normal(0, 0.3, 3)) @ moves(rng, 2 * n, 0.4)
    a[n:], c[:n] = a[0], c[0]
    return (a, invert(a @ x) @ (y @ c @ z), c), (x, y, z)


def test_two_steps_are_exact_where_each_arm_rests_once() -> None:
    given, truth = resting(np.random.default_rng(4))
    for found, true in zip(two_steps(*given), truth, strict=True):
        assert np.allclose(found, true, atol=1e-9)


def test_two_steps_need_an_arm_that_rests() -> None:
    made = session(CONFIGURATIONS["two arms, marker"], np.random.default_rng(5))
    with pytest.raises(CalibrationRefused) as error:
        solve("two_steps", made)
    assert str(error.value) == (
        "the second arm stands still at no more than 1 poses; 3 poses at which only "
        "the first arm moves are needed; record such poses, or use solve.robust, which needs none"
    )


@pytest.mark.parametrize("method", [tsai_lenz, park_martin])
def test_a_camera_turned_by_half_a_turn_is_no_exception(method: Any) -> None:
    for axis in np.eye(3):
        rng = np.random.default_rng(6)
        x = rigid(rotation_exp(np.pi * axis), np.array([0.05, 0.02, 0.04]))
        z = rigid(rotation(rng), rng.normal(0, 0.3, 3))
        carried = moves(rng, 8, 0.4)
        seen = invert(carried @ x) @ z
        found = method(motions_of(carried, seen))
        assert np.allclose(found, x, atol=1e-9)


def test_motions_of_half_a_turn_alone_are_refused() -> None:
    rng = np.random.default_rng(7)
    half = rigid(rotation_exp(np.array([np.pi, 0, 0])), np.zeros(3))
    carried = np.array([np.eye(4), half])
    with pytest.raises(CalibrationRefused) as error:
        motions_of(carried, np.array([np.eye(4), half]))
    assert str(error.value) == (
        "all 1 motions between poses turn by 180 deg or more: the sign of the axis of a half "
        "turn is not determined; add poses in between"
    )
    assert rng


@pytest.mark.parametrize(
    ("name", "configuration", "feature", "told"),
    [
        (
            "park_martin", "eye-in-hand, base circle", "normal",
            "solve.park_martin: needs a marker's full poses, but these are circles: use "
            "solve.linear or solve.robust",
        ),
        (
            "shah", "eye-in-hand, base circle", "pose",
            "solve.shah: has two unknowns, and the configuration leaves one: write place: unknown "
            "for a marker on or in front of one arm, or use solve.robust",
        ),
        (
            "tsai_lenz", "two arms, marker", "pose",
            "solve.tsai_lenz: has two unknowns, and the configuration leaves three: write place: "
            "unknown for a marker on or in front of one arm, or use solve.robust",
        ),
        (
            "kronecker", "eye-in-hand, marker", "pose",
            "solve.kronecker: AXB = YCZ has three unknowns: it needs two arms, a marker, and "
            "place: unknown",
        ),
        (
            "linear", "eye-in-hand, marker", "pose",
            "solve.linear: takes circles, but the features are poses: use solve.park_martin",
        ),
    ],
)  # fmt: skip
def test_what_a_closed_form_cannot_take_is_named(
    name: str, configuration: str, feature: str, told: str
) -> None:
    made = session(CONFIGURATIONS[configuration], np.random.default_rng(8), feature=feature)
    with pytest.raises(StageError) as error:
        solve(name, made)
    assert str(error.value) == told


def test_kronecker_says_how_many_poses_it_needs() -> None:
    made = session(CONFIGURATIONS["two arms, marker"], np.random.default_rng(9), n=9)
    with pytest.raises(StageError, match="solve.kronecker: 12 poses needed, 9 given"):
        solve("kronecker", made)


def test_alternation_only_climbs() -> None:
    rng = np.random.default_rng(10)
    x, y, z = random_rotations(rng)
    a, c = (np.array([rotation(rng) for _ in range(12)]) for _ in range(2))
    b = x.T @ np.swapaxes(a, 1, 2) @ y @ c @ z
    start = random_rotations(rng)
    errors_by_round = [alternate((a, b, c), start, rounds=k)[1] for k in (1, 3, 10, 100)]
    assert errors_by_round == sorted(errors_by_round, reverse=True)


def test_several_problems_are_alternated_at_once_as_each_would_be_alone() -> None:
    rng = np.random.default_rng(14)
    given = tuple(np.array([[rotation(rng) for _ in range(6)] for _ in range(3)]) for _ in range(3))
    starts = random_rotations(rng, (3,))
    together, errors_of = alternate((given[0], given[1], given[2]), starts, rounds=4)
    for k in range(3):
        alone, error = alternate(
            (given[0][k], given[1][k], given[2][k]), (starts[0][k], starts[1][k], starts[2][k]), 4
        )
        for one, other in zip(alone, together, strict=True):
            np.testing.assert_allclose(one, other[k], atol=1e-9)
        assert error == pytest.approx(errors_of[k])


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            name, marks=() if name in ("tsai_lenz", "daniilidis", "li") else pytest.mark.slow
        )
        for name in ONE_ARM
    ],
)
def test_the_region_of_a_closed_form_holds_its_share(name: str) -> None:
    rng, inside = np.random.default_rng(11), []
    for _ in range(30):
        made = session(CONFIGURATIONS["eye-in-hand, marker"], rng, n=8)
        found = solve(name, made).camera
        error = errors(found, made.truth[found.transform.name])
        inside.append(error @ np.linalg.solve(found.covariance, error) < 12.592)
    assert np.mean(inside) >= 0.75


@pytest.mark.parametrize(
    ("name", "configuration"),
    [("park_martin", "eye-in-hand, marker"), ("linear", "eye-on-base, flange")],
)
def test_the_region_of_a_closed_form_holds_for_an_arm_as_bad_as_real_ones(
    name: str, configuration: str
) -> None:
    told, kinds = [], CONFIGURATIONS[configuration]
    for seed in range(8):
        seen, truth = drawn(kinds, seed, REAL)
        told.append(solve(name, Session(kinds, seen, dict(enumerate(truth)))))
        true = told[-1].true[0]
        error = errors(true, truth[0])
        assert error @ np.linalg.solve(true.covariance, error) < 30


@pytest.mark.slow
def test_axb_ycz_converges_from_a_random_start() -> None:
    rng, good = np.random.default_rng(12), 0
    for _ in range(500):
        made = session(CONFIGURATIONS["two arms, marker"], rng)
        first = [o.base_T_flange.rotation for o in made.observations]
        seen = [o.feature.camera_T_target.rotation for o in made.observations]
        second = [o.poses["flange2"].rotation for o in made.observations]
        given = np.array(first), np.array(seen), np.array(second)
        (x, _, _), _ = alternate(given, random_rotations(rng))
        true = made.truth["flange_T_camera"][:3, :3]
        good += np.linalg.norm(rotation_log(x @ true.T)) < np.radians(1.0)
    assert good >= 0.99 * 500


def test_kronecker_alone_is_a_start() -> None:
    made = session(CONFIGURATIONS["two arms, marker"], np.random.default_rng(13))
    given = (
        np.array([o.base_T_flange.matrix for o in made.observations]),
        np.array([o.feature.camera_T_target.matrix for o in made.observations]),
        np.array([o.poses["flange2"].matrix for o in made.observations]),
    )
    x, _, _ = kronecker(*given)
    turn = rotation_log(x[:3, :3] @ made.truth["flange_T_camera"][:3, :3].T)
    assert np.linalg.norm(turn) < np.radians(1.0)


@pytest.mark.parametrize(
    ("parabola", "expected"),
    [
        ((1.0, -3.0, 2.0), [1.0, 2.0]),
        ((1.0, 2.0, 1.0 + 1e-9), [-1.0]),  # noise has left it short of zero: its vertex
        ((0.5, 2.0, 2.0 + 1e-9), [-2.0]),
    ],
)
def test_where_a_parabola_is_zero_or_nearest_to_it(parabola: Any, expected: list[float]) -> None:
    found = [s / t for s, t in _ratios(*parabola)]
    assert sorted(found) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("roots", [(0.3, -2.0), (-1.5, 4.0)])
@pytest.mark.parametrize("scale", [1.0, -7.0, 1e-4])
def test_ratios_solve_their_quadratic_or_stand_at_its_vertex(
    roots: tuple[float, float], scale: float
) -> None:
    """Noise may leave a double root short of zero: whichever way round it is solved, it is that."""
    one, other = roots
    found = _ratios(scale, -scale * (one + other), scale * one * other)
    assert sorted(s / t for s, t in found) == pytest.approx(sorted(roots))
    ((s, t),) = _ratios(scale, -2 * scale * one, scale * one**2 * (1 + 1e-9))
    assert s / t == pytest.approx(one, rel=1e-6)

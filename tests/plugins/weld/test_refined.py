"""The refined path: its likelihoods as dense normal distributions, and plans that are moved as one."""

from __future__ import annotations

import numpy as np
import pytest

from flangeye.types import Floats
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.refined import (
    BIN,
    PRIOR,
    ZONE,
    RefinedPath,
    _explained,
    _Field,
    _rigid_rows,
    _unexplained,
    _whitened,
)

RNG = np.random.default_rng(0)


def circle(radius: float = 0.08, angle: float = 1.5) -> Floats:
    turn = np.linspace(0.0, angle, 400)
    return radius * np.column_stack([np.sin(turn), 1 - np.cos(turn), 0 * turn])


def test_a_bordered_root_solves_columns_as_the_root_does() -> None:
    rows = RNG.normal(size=(6, 9))
    among, columns = rows @ rows.T, RNG.normal(size=(6, 2))
    root = np.linalg.cholesky(among)
    diagonal, white = _whitened(among, columns)
    assert diagonal == pytest.approx(np.diag(root))
    assert white == pytest.approx(np.linalg.solve(root, columns))


@pytest.mark.parametrize("size", [1e-4, 1e-2])
def test_a_motion_is_as_unlikely_as_one_normal_distribution_of_all_says(size: float) -> None:
    """Its scale left free; the motion is that of least squares with what is expected of it."""
    half = RNG.normal(size=(12, 15))
    among, rows = 1e-9 * half @ half.T, RNG.normal(size=(12, 3)) * [1.0, 1.0, 0.05]
    felt = size * RNG.normal(size=12)
    found = _explained(among, rows, felt)
    total = among + rows @ np.diag(PRIOR**2) @ rows.T
    scale = felt @ np.linalg.solve(total, felt) / 9
    prior = 2 * np.log(PRIOR).sum()
    assert found.unlikely == pytest.approx(
        9 * np.log(scale) + np.linalg.slogdet(total)[1] - prior, rel=1e-6
    )
    information = rows.T @ np.linalg.solve(among, rows) + np.diag(PRIOR**-2)
    shift = np.linalg.solve(information, rows.T @ np.linalg.solve(among, felt))
    assert found.shift == pytest.approx(shift)
    assert found.excess == pytest.approx(max(scale, 1.0))
    assert found.covariance == pytest.approx(found.excess * np.linalg.inv(information))


def test_a_shift_and_a_turn_move_a_plan_along_its_normals() -> None:
    levers, angles, step = RNG.normal(size=(5, 2)), RNG.uniform(0, 6, 5), 1e-6
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    rows = _rigid_rows(levers, normals)
    assert rows[:, :2] == pytest.approx(normals)
    turn = np.array([[np.cos(step), -np.sin(step)], [np.sin(step), np.cos(step)]])
    moved = ((levers @ turn.T - levers) * normals).sum(axis=1) / step
    assert rows[:, 2] == pytest.approx(moved, abs=1e-5)
    assert _unexplained(rows, rows @ [1.0, 2.0, 3.0]) == pytest.approx(0.0, abs=1e-20)


def test_a_field_is_what_was_felt_and_what_any_plan_is_off_by() -> None:
    field = _Field(4e-8, 6e-3, 9e-8)
    found = field.covariance(np.array([0.0, 0.01]), np.array([0.0, 6e-3, 30e-3]))
    assert found.shape == (2, 3)
    assert found[0] == pytest.approx([
        13e-8, 4e-8 * np.exp(-0.5) + 9e-8 * np.exp(-0.5 * 0.04),
        4e-8 * np.exp(-0.5 * 25) + 9e-8 * np.exp(-0.5),
    ])  # fmt: skip
    assert found[1, 2] == pytest.approx(
        4e-8 * np.exp(-0.5 * (20 / 6) ** 2) + 9e-8 * np.exp(-0.5 * (2 / 3) ** 2)
    )


def felt_of(
    shift: tuple[float, float], turn: float, until: float = 0.06
) -> tuple[RefinedPath, Path, Path]:
    """Return what was felt of a seam that is a plan shifted and turned, the plan, and the seam."""
    plan = Path(circle())
    c, s = np.cos(turn), np.sin(turn)
    seam = Path(circle() @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [*shift, 0.0])
    refined = RefinedPath(plan, 0.05)
    for i, at in enumerate(np.arange(0.005, until, 2e-4).tolist()):
        refined.add(0.01 * i, at, offset_of(plan, seam, at), at)
    refined.confirm(100.0)
    return refined, plan, seam


def offset_of(plan: Path, seam: Path, s: float) -> float:
    """Return how far the seam is to the left of the plan."""
    place, foot = plan.at(s), s
    for _ in range(6):
        there = seam.at(foot)
        foot -= float((there.point - place.point) @ place.tangent / (there.tangent @ place.tangent))
    return float((seam.at(foot).point - place.point) @ place.normal)


@pytest.mark.parametrize(("shift", "turn"), [((2e-3, -1e-3), 0.0), ((0.0, 1e-3), 0.02)])
def test_a_plan_that_is_shifted_and_turned_is_found_beyond_what_was_felt(
    shift: tuple[float, float], turn: float
) -> None:
    refined, plan, seam = felt_of(shift, turn)
    for s, near in ((0.02, 5e-6), (0.05, 5e-6), (0.07, 4e-5), (0.0, 4e-5)):
        assert refined.offset(s) == pytest.approx(offset_of(plan, seam, s), abs=near)
    for s in (0.02, 0.04):
        step = (offset_of(plan, seam, s) - offset_of(plan, seam, s - 1.5e-3)) / 1.5e-3
        assert refined.slope(s) == pytest.approx(step, abs=2e-3)
        point, normal = refined.frame(s)
        foot = seam.at(seam.foot(point, s))
        assert point == pytest.approx(foot.point, abs=1e-5)
        assert normal == pytest.approx(foot.normal, abs=3e-3)
    assert 0 < refined.variance(0.03) < refined.variance(0.08) < refined.variance(0.11)
    assert refined.angle(0.03, 9.0) == pytest.approx(0.03, abs=6e-4)
    assert refined.angle(0.1, 9.0) == pytest.approx(0.06, abs=6e-4)


def test_where_nothing_was_confirmed_the_plan_stands_and_is_off_by_five_millimetres() -> None:
    refined = RefinedPath(Path(circle()), 0.05)
    refined.add(5.0, 0.03, 1e-3, 0.0)
    refined.confirm(4.99)
    assert refined.empty and refined.offset(0.03) == 0.0 and refined.angle(0.03, 7.0) == 7.0
    assert refined.variance(0.03) == pytest.approx(25e-6)
    refined.forget_pending()
    refined.confirm(9.0)
    assert refined.empty
    refined.add(5.0, 0.03, 1e-3, 0.0)
    refined.confirm(5.0)
    assert not refined.empty


def test_an_earlier_weld_is_recalled_as_it_was_believed() -> None:
    refined, plan, _ = felt_of((1e-3, 1e-3), 0.01)
    refined.add(200.0, 0.061, 2e-3, 0.5, doubt=3e-4)
    refined.confirm(200.0)
    samples = refined.samples()
    assert samples[:, 3].sum() == len(np.arange(0.005, 0.06, 2e-4)) + 1
    assert samples[-1] == pytest.approx([0.061, 2e-3, 0.5, 1, 3e-4])
    again = RefinedPath(plan, 0.05)
    again.recall(samples)
    assert again.samples() == pytest.approx(samples)
    for s in (0.01, 0.03, 0.08):
        assert again.offset(s) == pytest.approx(refined.offset(s), abs=1e-12)
        assert again.doubt(s) == refined.doubt(s)
    # A doubt reaches 4 mm along the seam, either way.
    assert refined.doubt(0.061 - 3.9e-3) == refined.doubt(0.061 + 3.9e-3) == 3e-4
    assert refined.doubt(0.061 - 4.9e-3) == refined.doubt(0.061 + 4.9e-3) == 0.0


@pytest.mark.parametrize(
    ("length", "wander"),
    [(1.5e-3, 1e-5), (3e-3, 1e-5), (6e-3, 1e-5), (12e-3, 1e-5), (3e-3, 0.5e-3)],
)
def test_the_length_of_a_field_is_that_which_makes_what_was_felt_likeliest(
    length: float, wander: float
) -> None:
    """Of samples of a field of that length, on a straight plan; each a bin of its own."""
    plan = Path(np.array([[0.0, 0, 0], [0.1, 0, 0]]))
    refined, rng = RefinedPath(plan, 0.05, wander), np.random.default_rng(3)
    along: Floats = np.array([0.25e-3 + 0.5e-3 * i for i in range(10, 50)])
    drawn = _Field(1e-6, length, wander**2)
    root = np.linalg.cholesky(drawn.covariance(along, along) + 1e-12 * np.eye(len(along)))
    felt = root @ rng.normal(size=len(along)) + 1e-5 * rng.normal(size=len(along))
    for s, offset in zip(along.tolist(), felt.tolist(), strict=True):
        refined.add(0.0, s, offset, 0.0)
    refined.confirm(1.0)
    refined.offset(0.015)
    (motion,) = [m for m in refined._motions.values() if m is not None]
    levers = np.column_stack([along, 0 * along]) - motion.about
    rows = _rigid_rows(levers, np.tile([0.0, 1.0], (len(along), 1)))
    waviness = float(np.var(felt - rows @ np.linalg.lstsq(rows, felt, rcond=None)[0]))
    noise = (refined.noise**2 + 1e-6 * waviness) * np.eye(len(along))
    likely = {
        each: _explained(
            _Field(waviness, each, wander**2).covariance(along, along) + noise, rows, felt
        )
        for each in (1.5e-3, 3e-3, 6e-3, 12e-3, 24e-3)
    }
    best = min(likely, key=lambda each: likely[each].unlikely)
    assert motion.field.length == best and best in (length / 2, length, 2 * length)
    assert motion.field.variance == pytest.approx(waviness)
    assert motion.shift == pytest.approx(likely[best].shift, rel=1e-4, abs=1e-7)


def test_a_suspected_piece_is_doubted_four_millimetres_beyond_its_ends_and_no_farther() -> None:
    refined = RefinedPath(Path(np.array([[0.0, 0, 0], [0.1, 0, 0]])), 0.05)
    refined.suspect(0.0301, 0.0501, 1e-3)
    for s, doubted in ((0.0261, True), (0.0256, False), (0.0541, True), (0.0546, False)):
        assert (refined.doubt(s) == 1e-3) == doubted


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_far_beyond_its_ends_a_plan_is_where_it_leads_to_at_the_end_of_what_is_kept(
    way: float,
) -> None:
    refined, _, _ = felt_of((2e-3, -1e-3), 0.02)
    last = {1.0: 0.12 + 0.05, -1.0: -0.05}[way]
    for beyond in (0.1, 0.4):
        far = last + way * beyond
        assert refined.offset(far) == pytest.approx(refined.offset(last), abs=0.1e-3)
        assert refined.variance(far) == pytest.approx(refined.variance(last), rel=0.1)
        assert refined.doubt(far) == 0.0 and refined.frame(far)[0].shape == (2,)


def felt_once(offset: float, along: Floats) -> RefinedPath:
    """Return a path whose plan goes straight along a direction (2,), felt at 50 mm alone."""
    plan = Path(np.linspace(0.0, 0.1, 200)[:, None] * [*along, 0.0])
    refined = RefinedPath(plan, 0.05, 1e-6)
    refined.add(0.0, 0.05, offset, 0.0)
    refined.confirm(1.0)
    return refined


@pytest.mark.parametrize("along", [np.array([1.0, 0.0]), np.array([0.0, 1.0])])
def test_a_plan_is_expected_to_be_off_by_five_millimetres_and_a_twentieth_of_a_radian(
    along: Floats,
) -> None:
    """Felt at one place alone it may be turned, and that is taken for eleven times as much."""
    near = felt_once(0.0, along)
    for away in (0.02, -0.03):
        turned = 11.0 * 0.05 * abs(away)
        assert np.sqrt(near.variance(0.05 + away)) == pytest.approx(turned, rel=0.02)
    far = felt_once(15e-3, along)  # three times what is expected
    assert far.variance(0.07) == pytest.approx(9.0 * near.variance(0.07), rel=0.02)
    assert felt_once(4e-3, along).variance(0.07) == pytest.approx(near.variance(0.07), rel=0.02)


def test_a_place_that_is_felt_again_is_taken_in_at_once_and_far_from_it_nothing_changes() -> None:
    once, _, _ = felt_of((0.0, 0.0), 0.0)
    at, far = 0.0301, 0.012
    before = {s: once.offset(s) for s in (at - 7e-3, at, at + 7e-3, far)}
    assert before[at] == pytest.approx(0.0, abs=1e-6)
    for _ in range(30):
        once.add(200.0, at, 0.2e-3, 0.0)
    once.confirm(200.0)
    assert once.offset(at) > 0.01e-3
    assert once.offset(at - 7e-3) != before[at - 7e-3]
    assert once.offset(at + 7e-3) != before[at + 7e-3]
    assert once.offset(far) == before[far]


def test_the_more_often_a_place_was_felt_the_better_it_is_known_up_to_four_times() -> None:
    """What is felt oftener there errs alike."""
    refined = RefinedPath(Path(circle()), 0.05)
    refined.noise = 3e-5
    for i, count in enumerate((1, 2, 4, 30)):
        for _ in range(count):
            refined.add(0.0, 0.01 + 1e-3 * i, 0.0, 0.0)
    refined.confirm(1.0)
    used = np.flatnonzero(refined._count)
    assert refined._noise(used) == pytest.approx(9e-10 / np.array([1.0, 2.0, 4.0, 4.0]))


@pytest.mark.parametrize("steep", [0.4, -0.4])
def test_across_a_seam_that_leaves_its_plan_steeply_is_a_right_angle_to_the_seam(
    steep: float,
) -> None:
    refined = RefinedPath(Path(np.array([[0.0, 0, 0], [0.1, 0, 0]])), 0.05)
    for s in np.arange(0.0, 0.05, 2e-4).tolist():
        refined.add(0.0, s, steep * (s - 0.025), 0.0)
    refined.confirm(1.0)
    point, normal = refined.frame(0.03)
    assert point == pytest.approx([0.03, steep * 0.005], abs=3e-5)
    assert normal == pytest.approx(np.array([-steep, 1.0]) / np.hypot(1.0, steep), abs=1e-3)


@pytest.mark.parametrize(
    ("s", "kept"), [(-0.0524, True), (-0.0532, False), (0.1524, True), (0.1545, False)]
)
def test_what_is_felt_is_kept_within_the_room_beyond_both_ends(s: float, kept: bool) -> None:
    """Fifty millimetres, and five pieces of half a millimetre for what is looked at beside them."""
    refined = RefinedPath(Path(np.array([[0.0, 0, 0], [0.1, 0, 0]])), 0.05)
    refined.add(0.0, s, 1e-3, 0.0)
    refined.confirm(1.0)
    assert refined.empty != kept


def test_who_is_hurried_takes_what_is_known_of_the_bin_after_and_of_the_next_zone() -> None:
    refined, plan, seam = felt_of((1e-3, 0.0), 0.0)
    refined.hurried = True
    edge = next(s for s in np.arange(0.03, 0.04, BIN).tolist() if refined._index(s) % ZONE == 0)
    here = refined.offset(edge)
    zone = refined._index(edge) // ZONE
    away = {z: refined._known_zone(z * ZONE + 3) for z in range(zone - 2, zone + 3)}
    assert away == {
        zone - 2: None,
        **dict.fromkeys((zone - 1, zone, zone + 1), zone),
        zone + 2: None,
    }
    for before in (0.1 * BIN, 0.9 * BIN):  # of another zone, by the fit of the bin after
        there = offset_of(plan, seam, edge - before)
        assert refined.offset(edge - before) == pytest.approx(there, abs=5e-6)
    assert len(refined._fits) == 1 and refined.offset(edge) == here
    refined.offset(edge - 1.1 * BIN)
    assert len(refined._fits) == 2

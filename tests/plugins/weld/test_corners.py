"""Plans with sharp corners: found, refused where the tool has no room, welded leg by leg."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from flangeye.errors import StageError
from flangeye.types import Seam
from flangeye.types.geometry import arc_lengths, rows_at
from flangeye_emulators.weld_world.groove import Tip
from flangeye_emulators.weld_world.truth import WeldTruth
from flangeye_plugins.weld.checks import check_seam
from flangeye_plugins.weld.corners import corners_of, leg_of
from flangeye_plugins.weld.following.follower import Follower
from flangeye_plugins.weld.following.task import WeldTask
from flangeye_plugins.weld.frame import WorkSurface
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following, WeldTactileParams
from tests.plugins.weld import bench, cell
from tools.weld_bench import set_up, start_at
from tools.weld_conditions import LAP, Condition
from tools.weld_trial import run_trial

Points = NDArray[np.float64]


def polyline(*turns: float, legs: Sequence[float] = (0.06,) * 4) -> Points:
    """Legs of so many lengths, turning to the left by so much [deg] between them."""
    headings = np.radians(np.cumsum([0.0, *turns]))
    ways = np.stack([np.cos(headings), np.sin(headings), 0 * headings], axis=1)
    steps = np.array(legs)[: len(headings), None] * ways
    return np.concatenate([[[0.0, 0, 0]], np.cumsum(steps, axis=0)])


def dense(points: Points) -> Points:
    along = arc_lengths(points)
    ticks = np.unique(np.concatenate([np.arange(0.0, along[-1], 1.7e-3), along]))
    return rows_at(ticks, along, points)


def seam_of(points: Points) -> Seam:
    n = len(points)
    return Seam(points, np.tile([0.0, 0, 1.0], (n, 1)), np.tile(np.eye(3) * 1e-8, (n, 1, 1)))


def asked(**given):
    defaults = {"side": "left", "joint": "lap", "corner_radius": None}
    return WeldTactileParams.model_construct(**{**defaults, **given})


@pytest.mark.parametrize("turns", [(90.0,), (60.0, -60.0), (120.0, -120.0, 120.0), (-45.0,)])
@pytest.mark.parametrize("sampled", [polyline, lambda *t: dense(polyline(*t))])
def test_corners_are_found_where_they_are(turns, sampled) -> None:
    found = corners_of(sampled(*turns))
    np.testing.assert_allclose([np.degrees(each.turn) for each in found], turns, atol=1e-6)
    np.testing.assert_allclose(
        [each.along for each in found], 0.06 * np.arange(1, len(turns) + 1), atol=1e-9
    )


def test_a_curve_has_no_corner() -> None:
    angle = np.linspace(0.0, np.pi, 200)
    curve = 0.02 * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1)
    assert corners_of(curve) == []


def test_a_leg_is_what_lies_between_its_corners() -> None:
    points = dense(polyline(90.0, 60.0))
    legs = [leg_of(seam_of(points), asked(leg=k)).points_in_base for k in (1, 2, 3)]
    for leg, corner in zip(legs, polyline(90.0, 60.0), strict=False):
        np.testing.assert_allclose(leg[0], corner, atol=1e-12)
        assert np.linalg.norm(leg[-1] - leg[0]) == pytest.approx(0.06)


@pytest.mark.parametrize(
    ("turns", "given", "message"),
    [
        ((90.0,), {}, r"sharp corners \(\+90 deg at 60 mm\).*leg: 1 to 2"),
        ((120.0, -120.0), {}, r"\+120 deg at 60 mm, -120 deg at 120 mm.*leg: 1 to 3"),
        ((90.0,), {"leg": 3}, r"leg 3 of a seam with 2; its sharp corners: \+90 deg"),
        ((), {"leg": 2}, "leg 2 of a seam with 1; its sharp corners: none"),
        ((-90.0,), {"leg": 1}, r"at the corner -90 deg at 60 mm the finger .* run into a wall"),
        (
            (-90.0,),
            {"leg": 1},
            "go round it with corner_radius, or end the plan before the corner",
        ),
        ((90.0,), {"leg": 2, "joint": "groove"}, "run into a wall: room is only round the outside"),
        ((60.0, -60.0), {"leg": 2}, "at the corner -60 deg at 120 mm the finger"),
    ],
)
def test_what_has_no_room_or_is_not_chosen_is_refused(turns, given, message: str) -> None:
    with pytest.raises(StageError, match=message):
        leg_of(seam_of(polyline(*turns)), asked(**{"leg": None, **given}))


ROUND = {"leg": None, "corner_radius": 5e-3, "joint": "groove"}


@pytest.mark.parametrize("sampled", [polyline, lambda *t: dense(polyline(*t))])
def test_a_rounded_corner_is_an_arc_that_touches_both_legs(sampled) -> None:
    points = sampled(60.0)
    plan = leg_of(seam_of(points), asked(**ROUND))
    cut = 5e-3 * np.tan(np.radians(30.0))
    middle = np.array([0.06 - cut, 5e-3, 0.0])
    away = np.linalg.norm(plan.points_in_base - middle, axis=1)
    assert away.min() == pytest.approx(5e-3, abs=1e-9)
    assert np.count_nonzero(np.abs(away - 5e-3) < 1e-9) >= 40
    for ends in (0, -1):
        np.testing.assert_allclose(plan.points_in_base[ends], points[ends])
    assert plan.covariance.shape == (len(plan.points_in_base), 3, 3)


def test_a_plan_with_rounded_corners_has_no_legs() -> None:
    with pytest.raises(
        StageError, match="with corner_radius the seam is welded in one go, without legs"
    ):
        leg_of(seam_of(polyline(90.0)), asked(**{**ROUND, "leg": 1}))


@pytest.mark.parametrize("turn", [45.0, pytest.param(-45.0, marks=pytest.mark.slow)])
def test_tip_and_torch_go_round_a_corner_of_a_groove(turn: float) -> None:
    true = dense(polyline(turn, legs=(0.07, 0.07)))
    plan = leg_of(seam_of(bench.misplaced(true, (1e-3, 1e-3, 0.0), 0.01)), asked(**ROUND))
    settings = Following(max_error="1.5 mm")
    done = bench.weld(true, plan.points_in_base, settings=settings)
    assert done.controller.phase == "done", done.controller.reason
    beside = (done.torch_s > 0.0) & (done.torch_s < done.length)
    off = np.abs(done.torch[beside])
    assert (off <= np.where(done.arc_on > 0.0, done.bound, np.inf)[beside]).all()
    assert off.max() < 0.6e-3
    assert np.sqrt(np.mean(off**2)) < 0.1e-3


def round_a_corner(turn, joint, shift, plan_turn=0.01, **given):
    """Weld round a corner in a world of its own, the plan shifted [m]."""
    settings = {"joint": joint, "max_error": "1.5 mm", **given}
    condition = Condition(settings=settings, section=JOINTS[joint])
    true = dense(polyline(turn))
    misplanned = seam_of(bench.misplaced(true, shift, plan_turn))
    leg = leg_of(misplanned, asked(**{**ROUND, "joint": joint}))
    plan = Path(leg.points_in_base)
    _, prior, nominal = set_up(condition, true)
    surface = WorkSurface(leg.points_in_base, leg.openings_in_base)
    check_seam(misplanned, surface, prior.distance, condition.asked)
    controller = Follower(WeldTask(plan, prior, condition.asked))
    start = start_at(plan, prior, condition.asked, 16e-3)
    return run_trial(controller, nominal, WeldTruth(), start, 0)


JOINTS = {"lap": LAP, "groove": None}


@pytest.mark.parametrize("turn", [45.0, -45.0])
def test_a_tip_pressed_against_one_wall_leads_the_torch_round_its_corners(turn: float) -> None:
    """Round the outside of the plate, and into the corner where the next one stands."""
    found = round_a_corner(turn, "lap", (1e-3, 1e-3, 0.0))
    assert found.done, found.controller.reason
    # A real ball stays off an inner corner by so much more: it touches both walls there.
    mitre = Tip().radius * (1.0 / np.cos(np.radians(turn) / 2.0) - 1.0)
    assert (found.errors + mitre <= found.column("bound")[found.beside]).all()
    assert found.errors.max() < 0.5e-3
    assert np.sqrt(np.mean(found.errors**2)) < 0.1e-3


@pytest.mark.slow
def test_an_arc_that_the_plan_is_off_by_as_much_as_its_radius_stops_or_is_followed() -> None:
    """The arm is then near the arc's centre, from where all of its places are as near."""
    found = round_a_corner(-58.5, "groove", (-0.6e-3, 3.2e-3, 0.0), -0.0175, side="right")
    assert found.done or "position along the seam is not observable" in found.controller.reason
    assert found.bounded


BENT = [[-40.0, -15.0, 14.0], [20.0, -15.0, 14.0], [20.0, 40.0, 14.0]]
"""An L round the corner of a plate that lies to its left [mm]."""


@pytest.fixture
def bent(tmp_path: FilePath) -> FilePath:
    cad = FilePath("data/workpieces/v-straight.stl").absolute()
    (tmp_path / "bent.stl").write_bytes(cad.read_bytes())
    seam = {"name": "groove", "points": BENT, "opening": [0, 0, 1]}
    file = {"title": "L", "cad": "bent.stl", "unit": "mm", "seams": [seam], "source": "test"}
    (tmp_path / "bent.yaml").write_text(yaml.safe_dump(file))
    return tmp_path / "bent.yaml"


@pytest.mark.parametrize("leg", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_the_torch_comes_to_the_corner_and_goes_on_from_it(bent: FilePath, leg: int) -> None:
    line = np.array(BENT) * 1e-3 @ cell.HERE[:3, :3].T + cell.HERE[:3, 3]
    off = np.array([1e-3, -0.7e-3, 0.0])
    seam = seam_of(line + off)
    sensor = {"plate": "5 mm", "leg": leg}
    report, _ = cell.run(seam, bent, sensor=sensor, joint="lap", leg=leg, speed="10 mm/s")
    assert report.completed, report.reason
    start, end = line[leg - 1], line[leg]
    along = (end - start) / np.linalg.norm(end - start)
    torch = report.true_torch - start
    s, across = torch @ along, torch @ np.cross([0.0, 0, 1], along)
    arc_from = report.figures["arc_from"]
    beside = (s > max(arc_from, 0.0)) & (s < np.linalg.norm(end - start))
    assert s[beside].min() < 0.012  # the first leg's weld begins, and the second's, at its start
    # Along the seam nothing is felt: where a leg ends is as the plan has it.
    planned = (seam.points_in_base[leg] - start) @ along
    assert s[beside].max() == pytest.approx(min(planned, np.linalg.norm(end - start)), abs=0.3e-3)
    assert np.sqrt(np.mean(across[beside] ** 2)) < 0.1e-3


@pytest.mark.parametrize(
    ("turn", "lengths", "corners"),
    [
        # More than 35 deg within ten millimetres, not nearer to an end than a chord
        (34.0, (0.06, 0.06), 0), (36.0, (0.06, 0.06), 1), (-34.0, (0.06, 0.06), 0),
        (-36.0, (0.06, 0.06), 1), (90.0, (0.06, 0.0049), 0), (90.0, (0.06, 0.0051), 1),
        # Bends that near to each other are one corner
        (30.0, (0.05, 3e-3, 0.05), 1), (30.0, (0.05, 14e-3, 0.05), 0),
        (60.0, (0.05, 9e-3, 0.05), 1), (60.0, (0.05, 11e-3, 0.05), 2),
    ],
)  # fmt: skip
def test_what_a_corner_is(turn: float, lengths: tuple[float, ...], corners: int) -> None:
    points = polyline(*[turn] * (len(lengths) - 1), legs=lengths)
    for way in (points, points[::-1]):
        assert len(corners_of(way)) == corners


@pytest.mark.parametrize(
    ("turn", "given", "room"),
    [
        (60.0, {"side": "left"}, True), (-60.0, {"side": "right", "joint": "fillet"}, True),
        (-60.0, {"side": "left"}, False), (60.0, {"side": "right"}, False),
        (60.0, {"joint": "groove"}, False), (60.0, {"half_angle": 0.7}, False),
    ],
)  # fmt: skip
def test_round_the_outside_of_the_plate_that_is_pressed_the_finger_has_room(
    turn: float, given: dict[str, Any], room: bool
) -> None:
    seam = replace(seam_of(polyline(turn)), half_angle=given.pop("half_angle", None))
    for leg in (1, 2):
        with bench.refused(None if room else "would run into a wall"):
            kept = leg_of(seam, asked(leg=leg, **given)).points_in_base
            assert kept == pytest.approx(polyline(turn)[leg - 1 : leg + 1])


@pytest.mark.parametrize(
    ("radius", "told"),
    [(29.9e-3, None), (30.1e-3, r"90 deg at (60|120) mm has no room .* at most 30 mm")],
)
@pytest.mark.parametrize("turns", [(90.0,), (60.0, -90.0)])
def test_an_arc_begins_beyond_the_middle_of_the_leg_before_it(
    turns: tuple[float, ...], radius: float, told: str | None
) -> None:
    with bench.refused(told):
        leg_of(seam_of(polyline(*turns)), asked(**{**ROUND, "corner_radius": radius}))


def test_round_two_corners_the_plan_goes_on_in_order_and_keeps_what_is_known_of_it() -> None:
    points = dense(polyline(60.0, -60.0))
    along, seam = arc_lengths(points), seam_of(points)
    lean = 0.3 * along
    openings = np.column_stack([0 * lean, np.sin(lean), np.cos(lean)])
    odd = Seam(points, openings, np.array(seam.covariance) * (1.0 + along[:, None, None]))
    plan = leg_of(odd, asked(**ROUND))
    cut = 5e-3 * np.tan(np.radians(30.0))
    steps = np.linalg.norm(np.diff(plan.points_in_base, axis=0), axis=1)
    assert steps.max() < 1.8e-3
    arcs = 2 * 5e-3 * np.radians(60.0)
    assert steps.sum() == pytest.approx(0.18 - 4 * cut + arcs, abs=1e-5)
    for corner, side in ((0.06, 1.0), (0.12, -1.0)):  # an arc's middle lies beside its corner
        here = np.array([np.interp(corner, along, axis) for axis in points.T])
        nearest = np.linalg.norm(plan.points_in_base - here, axis=1).min()
        assert nearest == pytest.approx(5e-3 / np.cos(np.radians(30.0)) - 5e-3, abs=2e-5), side
    leans = np.arctan2(plan.openings_in_base[:, 1], plan.openings_in_base[:, 2])
    at = leans / 0.3  # what is told of a place is that of its arc length
    assert (np.diff(at) > -1e-12).all() and at[-1] == pytest.approx(0.18)
    assert plan.covariance[:, 0, 0] == pytest.approx(1e-8 * (1.0 + at), rel=1e-5)

"""The controller's parts, one by one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flangeye.files.paths import bundled
from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.maths.seam_geometry import torch_deviation
from flangeye.models.finger import Finger
from flangeye.models.model import read_model
from flangeye.motion.seam_following import Command, ToolPose, turned
from flangeye.types import Transform
from flangeye_emulators.weld_world.groove import Contact as Tip3D
from flangeye_emulators.weld_world.groove import Groove, Section, Tip
from flangeye_plugins.weld.consistency import Seating
from flangeye_plugins.weld.frame import Tool, WorkPlane
from flangeye_plugins.weld.motion import Track
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.refined import BIN, LENGTHS, ZONE, RefinedPath
from tests.plugins.weld.bench import curved, misplaced, straight

FINGER = read_model(bundled("data") / "fingers" / "srm.yaml", Finger)
RADIUS = 0.06


def circle(turns=0.5):
    angle = np.linspace(0.0, 2 * np.pi * turns, 400)
    return RADIUS * np.column_stack([np.sin(angle), 1 - np.cos(angle), 0 * angle])


# --- path -----------------------------------------------------------------------------------------


@given(st.floats(0.0, np.pi * RADIUS))
def test_a_path_knows_points_tangents_and_normals(s: float) -> None:
    place, angle = PATH.at(s), s / RADIUS
    np.testing.assert_allclose(
        place.point, RADIUS * np.array([np.sin(angle), 1 - np.cos(angle)]), atol=2e-6
    )
    np.testing.assert_allclose(place.tangent, [np.cos(angle), np.sin(angle)], atol=5e-3)
    np.testing.assert_allclose(place.normal, [-place.tangent[1], place.tangent[0]])
    points, tangents = PATH.evaluate(np.array([s]))
    np.testing.assert_allclose(points[0, :2], place.point, atol=1e-12)
    np.testing.assert_allclose(tangents[0], place.tangent, atol=1e-12)


PATH = Path(circle())


def test_a_path_goes_on_straight_beyond_its_ends() -> None:
    end = PATH.at(PATH.length)
    np.testing.assert_allclose(PATH.at(PATH.length + 0.04).point, end.point + 0.04 * end.tangent)
    assert PATH.climb(-0.01) == 0.0


def test_progress_neither_goes_back_nor_jumps_to_another_branch() -> None:
    eight = Path(
        np.column_stack([np.sin(t := np.linspace(0, 2 * np.pi, 800)), np.sin(2 * t) / 2, 0 * t])
        * 0.1
    )
    s, crossings = 0.0, []
    for ahead in np.arange(0.0, eight.length, 1e-3):
        at = eight.at(float(ahead)).point
        before, s = s, eight.advance(at, s, 5e-3)
        assert before <= s <= before + 5e-3
        crossings.append(abs(s - ahead))
    assert max(crossings) < 1e-3
    assert eight.advance(eight.at(0.0).point, s, 5e-3) >= s


def test_the_curvature_of_a_path_is_a_circle_s_and_not_its_scatter_s() -> None:
    angle = np.linspace(0.0, np.pi / 2, 300)
    circle = 0.05 * np.column_stack([np.sin(angle), 1 - np.cos(angle), 0 * angle])
    path = Path(circle)
    assert path.sharpest(0.0, path.length) == pytest.approx(20.0, rel=0.02)
    assert path.sharpest(path.length + 0.01, path.length + 0.02) == 0.0
    scatter = straight() + 0.02e-3 * np.random.default_rng(0).standard_normal((200, 3))
    assert Path(scatter).sharpest(0.0, 0.12) < 5.0


# --- the refined path -----------------------------------------------------------------------------


def test_where_nothing_was_felt_the_plan_is_moved_onto_what_was() -> None:
    true, plan = Path(curved()), Path(misplaced(curved(), (1e-3, 2e-3, 0.0), np.deg2rad(1.0)))
    refined = RefinedPath(plan, 0.05)
    for i, s in enumerate(
        np.concatenate([np.arange(0.03, 0.05, 2e-4), np.arange(0.07, 0.09, 2e-4)])
    ):
        place = plan.at(float(s))
        foot = true.foot(place.point, float(s))
        for _ in range(3):  # the true seam across the plan
            at = true.at(foot)
            foot -= float((at.point - place.point) @ place.tangent) / float(
                at.tangent @ place.tangent
            )
        offset = float((true.at(foot).point - place.point) @ place.normal)
        refined.add(i * 0.01, float(s), offset, 0.0)
    refined.confirm(100.0)
    for s in (0.02, 0.04, 0.06, 0.08, 0.1):
        point, normal = refined.frame(s)
        foot = true.foot(point, s)
        assert np.linalg.norm(true.at(foot).point - point) < 0.05e-3
        assert normal @ true.at(foot).normal > np.cos(np.deg2rad(0.5))


def test_what_is_not_confirmed_is_not_believed() -> None:
    refined = RefinedPath(Path(straight()), 0.05)
    refined.add(1.0, 0.01, 1e-3, 0.0)
    assert refined.empty
    refined.confirm(0.5)
    assert refined.empty
    refined.forget_pending()
    refined.confirm(2.0)
    assert refined.empty
    assert refined.offset(0.01) == 0.0


def test_a_long_seam_costs_a_cycle_no_more_than_a_short_one() -> None:
    refined = RefinedPath(Path(straight(5.0)), 0.05)
    for s in np.arange(0.0, 4.0, 4e-4):
        refined.add(0.0, float(s), 1e-3, 0.0)
    refined.confirm(1.0)
    assert len(refined._nearest(20, 120)) == len(refined._nearest(4000, 120)) == 240
    assert refined.offset(2.0) == pytest.approx(1e-3, abs=1e-6)
    assert refined.offset(4.5) == pytest.approx(1e-3, abs=1e-5)  # half a metre beyond


# --- where the tool was ---------------------------------------------------------------------------


def test_an_image_meets_the_pose_of_its_own_time() -> None:
    track = Track()
    for i in range(200):
        track.add(ToolPose(i * 0.01, np.array([i * 1e-3, 0.0, 0.0]), i * 0.1))
    assert track.at(1.505).position[0] == pytest.approx(0.1505)
    assert track.at(1.505).angle == pytest.approx(15.05)
    assert track.at(9.0).position[0] == pytest.approx(0.199)
    assert track.at(0.5) is None


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-0.3, 0.3))
def test_the_flange_moves_as_the_tip_is_told(angle: float, yaw: float, turn: float) -> None:
    base_T_plane = rigid(rotation_exp(np.array([0.1, -0.2, yaw])), np.array([0.5, 0.1, 0.2]))
    points = np.array([[0.0, 0, 0], [0.1, 0, 0]]) @ base_T_plane[:3, :3].T + base_T_plane[:3, 3]
    plane = WorkPlane(points, np.tile(base_T_plane[:3, 2], (2, 1)))
    finger = FINGER.model_copy(update={"tip": (0.03, -0.01, 0.18), "direction": 0.7})
    tool = Tool(finger, plane)
    flange = tool.base_T_flange(np.array([0.01, 0.02, 0.03]), angle)
    assert tool.tilt(flange) < 1e-6
    before = tool.pose(flange, 0.0)
    np.testing.assert_allclose(before.position, [0.01, 0.02, 0.03], atol=1e-12)
    step = 1e-5
    twist = tool.twist(Command(np.array([5e-3, -2e-3, 1e-3]), turn), flange)
    moved = rigid(
        rotation_exp(twist[3:] * step) @ flange.rotation, flange.translation + twist[:3] * step
    )
    after = tool.pose(Transform("base", "flange", moved), step)
    np.testing.assert_allclose(
        (after.position - before.position) / step, [5e-3, -2e-3, 1e-3], atol=1e-5
    )
    assert (after.angle - before.angle) / step == pytest.approx(turn, abs=1e-5)


def test_turning_is_about_the_normal() -> None:
    np.testing.assert_allclose(turned(np.array([1.0, 0.0, 2.0]), np.pi / 2), [0, 1, 2], atol=1e-12)


# --- the simulated tip ----------------------------------------------------------------------------

SECTION = Section(np.pi / 6, 8e-3)
SEAT = 1.5e-3 / np.sin(np.pi / 6)


def energy(tip, position, rest):
    off = position - rest
    return tip.lateral * off[1] ** 2 + tip.axial * off[2] ** 2


@given(st.floats(-3e-3, 3e-3), st.floats(-3e-3, 4e-3))
def test_the_tip_takes_the_place_of_least_energy_between_the_walls(
    across: float, up: float
) -> None:
    tip = Tip(friction=0.0)
    contact = Tip3D(Groove(Path(straight()), SECTION), tip)
    rest = np.array([0.06, across, SEAT + up])
    found = contact.settle(rest)
    y = np.linspace(-5e-3, 5e-3, 2001)
    floor = SEAT + np.abs(y) / np.tan(SECTION.half_angle)
    height = np.maximum(floor, rest[2])
    least = (tip.lateral * (y - rest[1]) ** 2 + tip.axial * (height - rest[2]) ** 2).min()
    assert found[2] >= SEAT + abs(found[1]) / np.tan(SECTION.half_angle) - 1e-9
    assert energy(tip, found, rest) <= least + 1e-9


def test_the_tip_lags_by_friction_and_no_more() -> None:
    tip = Tip(friction=0.1)
    contact = Tip3D(Groove(Path(straight()), SECTION), tip)
    for x in np.arange(0.02, 0.03, 1e-4):
        found = contact.settle(np.array([x, 1e-3, SEAT - 1e-3]))
    normal = np.hypot(tip.lateral * 1e-3, tip.axial * 1e-3)
    assert x - found[0] == pytest.approx(0.1 * normal / tip.lateral, rel=1e-6)


def test_outside_the_workpiece_and_on_its_face_the_tip_is_free() -> None:
    contact = Tip3D(Groove(Path(straight()), SECTION), Tip())
    np.testing.assert_array_equal(contact.settle(np.array([-0.01, 0, 0.0])), [-0.01, 0, 0])
    on_top = contact.settle(np.array([0.05, 8e-3, 5e-3]))
    np.testing.assert_allclose(on_top[1:], [8e-3, 8e-3 + 1.5e-3], atol=1e-9)


def test_the_torch_is_measured_across_the_opening_and_only_beside_the_seam() -> None:
    line = np.array([[0.0, 0, 0], [0.1, 0, 0]])
    points = np.array([[-0.01, 0, 0], [0.05, 2e-3, 7e-3], [0.2, 0, 0]])
    found = torch_deviation(points, line, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(found, [2e-3])


def test_where_the_field_is_held_by_samples_an_error_of_the_plan_s_motion_does_no_harm() -> None:
    plan = Path(straight(0.12))
    refined = RefinedPath(plan, 0.05)
    refined.noise = 10e-6
    for s in np.arange(0.0, 0.08, 2e-4):
        refined.add(0.0, float(s), 1e-3 * np.sin(2 * np.pi * s / 10e-3), 0.2)
    refined.confirm(1.0)
    assert refined.offset(0.04) == pytest.approx(1e-3 * np.sin(2 * np.pi * 4), abs=0.01e-3)
    assert refined.slope(0.04) == pytest.approx(2 * np.pi * 0.1, rel=0.3)
    assert np.sqrt(refined.variance(0.04)) < 0.03e-3
    assert np.sqrt(refined.variance(0.1)) > 0.5e-3  # where nothing was felt the waves go on unseen
    assert refined.angle(0.04, 0.0) == 0.2


@pytest.mark.parametrize("bow", [-3e-3, 3e-3])
def test_a_plan_whose_shape_is_wrong_is_stated_beyond_what_was_felt(bow: float) -> None:
    """A bow that shift and turn nearly explain leads the plan elsewhere beyond its last sample."""
    plan = Path(curved(0.1))
    rng = np.random.default_rng(0)
    refined = RefinedPath(plan, 0.05)
    refined.noise = 30e-6

    def bowed(s):
        return bow * np.sin(np.pi * s / plan.length)

    for s in np.arange(5e-3, plan.length - 10e-3, 2e-4):
        refined.add(0.0, s, bowed(s) + refined.noise * rng.standard_normal(), 0.0)
    refined.confirm(1.0)
    for s in np.arange(plan.length - 10e-3, plan.length, 1e-3):
        off = abs(refined.offset(s) - bowed(s))
        assert off < 4 * np.sqrt(refined.variance(s)) < 4e-3


def test_waves_felt_in_two_short_pieces_are_not_taken_for_a_plan_turned_far() -> None:
    """A turn by 16 deg and a shift by 35 mm explain both; between them the wave goes on."""
    refined = RefinedPath(Path(curved(0.1)), 0.05)
    refined.noise, rng = 60e-6, np.random.default_rng(0)

    def wave(s):
        return -1.3e-3 * np.cos(2 * np.pi * (s - 10.5e-3) / 28e-3) - 0.9e-3

    for s in [*np.arange(6e-3, 13e-3, 0.6e-3).tolist(), 27.5e-3, 28e-3]:
        refined.add(0.0, s, wave(s) + refined.noise * rng.standard_normal(), 0.0)
    refined.confirm(1.0)
    for s in np.arange(14e-3, 27e-3, 1e-3):
        assert abs(refined.offset(s) - wave(s)) < 4 * np.sqrt(refined.variance(s))


def test_a_hurried_path_finds_one_thing_again_at_a_time_and_is_the_same_in_the_end() -> None:
    exact, hurried = (RefinedPath(Path(curved(0.1)), 0.05) for _ in range(2))
    hurried.hurried = True
    for refined in (exact, hurried):
        for s in np.arange(0.0, 0.05, 2e-4).tolist():
            refined.add(s, s, 1e-3 * np.cos(s / 10e-3), 0.0)
        refined.confirm(0.02)
    first = hurried.variance(0.03)
    assert first == exact.variance(0.03)
    for refined in (exact, hurried):
        refined.confirm(1.0)
    after = []
    # The motion, a length each, then the field about the place: of the one that is new first.
    for _ in range(2 * (len(LENGTHS) + 2)):
        after.append(hurried.variance(0.03))
        hurried.renew((0.03, 0.05))
    assert set(after) == {first}
    assert hurried.variance(0.03) == exact.variance(0.03) < first
    assert hurried.variance(0.05) == exact.variance(0.05)
    np.testing.assert_array_equal(hurried.frame(0.03), exact.frame(0.03))


def test_a_hurried_path_takes_what_is_known_beside_a_new_place_and_waits_for_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    refined = RefinedPath(Path(curved(0.1)), 0.05)
    refined.hurried = True
    for s in np.arange(0.0, 0.05, 2e-4).tolist():
        refined.add(s, s, 1e-3 * np.cos(s / 10e-3), 0.0)
    refined.confirm(1.0)
    edge = next(s for s in np.arange(0.04, 0.046, BIN) if refined._index(s) % ZONE == ZONE - 1)
    exact = refined.offset(edge)
    monkeypatch.setattr(refined, "_find", None)  # whoever finds a motion now would fail
    beside = refined.offset(edge + 0.9 * BIN)  # by the fit of the bin before
    assert beside == pytest.approx(1e-3 * np.cos((edge + 0.9 * BIN) / 10e-3), abs=5e-6)
    assert refined.frame(edge + BIN)[0] != pytest.approx(refined.frame(edge)[0], abs=1e-6)
    assert len(refined._fits) == 1
    refined.renew((edge, edge + 2 * BIN))  # the zone's motion is not known: the next one's does
    assert len(refined._fits) == 2
    assert refined.offset(edge + 2 * BIN) == pytest.approx(
        1e-3 * np.cos((edge + 2 * BIN) / 10e-3), abs=5e-6
    )
    assert refined.offset(edge) == exact


def test_what_was_felt_at_two_places_says_little_of_the_rest() -> None:
    few, many = RefinedPath(Path(straight()), 0.05), RefinedPath(Path(straight()), 0.05)
    for refined, end in ((few, 1e-3), (many, 40e-3)):
        for s in np.arange(0.0, end, 2e-4):
            refined.add(0.0, s, 1e-3, 0.0)
        refined.confirm(1.0)
    assert few.variance(11e-3) > 20 * many.variance(50e-3)


# --- whether the tip is where the seam is ---------------------------------------------------------


def climbing(aside, lifted):
    """Judge a straight seam, then a tip aside and lifted [m]; return the largest doubt."""
    seating, rng, doubt = Seating(1.0, 1.0), np.random.default_rng(0), 0.0
    for i in range(200):
        there = i >= 120
        noise = 10e-6 * rng.standard_normal(2)
        assert seating.judge(i * 2e-4, there * aside + noise[0], there * lifted + noise[1]) is None
        doubt = max(doubt, seating.doubt if i > 130 else 0.0)
    return doubt


def test_a_tip_that_may_have_climbed_a_little_is_doubted_by_so_much() -> None:
    assert climbing(0.3e-3, 0.3e-3) == pytest.approx(0.3e-3, abs=0.05e-3)
    assert climbing(0.0, 1.5e-3) < 0.05e-3  # a tack weld
    assert climbing(0.3e-3, 0.0) < 0.05e-3  # the seam turns aside


def test_a_piece_of_the_seam_is_suspected_after_it_was_felt() -> None:
    refined = RefinedPath(Path(straight(0.1)), 0.05)
    refined.suspect(0.02, 0.04, 1e-3)
    refined.suspect(0.03, 0.04, 0.5e-3)
    assert [refined.doubt(s) for s in (0.01, 0.02, 0.035, 0.05)] == [0.0, 1e-3, 1e-3, 0.0]


def risen(rise, first=0.03, last=1.0):
    """Judge a seam that leaves its plan to the other side; the tip rises from first on [m]."""
    seating, rng, most = Seating(1.0, 1.0), np.random.default_rng(0), 0.0
    seating.seated(np.array([(5e-3, 0.0, 0.6e-3 * rng.standard_normal()) for _ in range(100)]))
    for s in np.arange(5e-3, 80e-3, 0.3e-3).tolist():
        height = rise * max(s - first, 0.0) * (s < last) + 0.6e-3 * rng.standard_normal()
        seating.judge(s, -0.2 * s, height)
        most = max(most, seating.risen)
    return most


def test_a_tip_that_stays_higher_is_doubted_whatever_it_does_aside() -> None:
    assert risen(0.06) > 0.5e-3
    assert risen(0.015) == 0.0  # the plan is tilted by 1 deg
    assert risen(0.2, last=38e-3) == 0.0  # a tack weld of 8 mm


def test_what_lies_far_behind_is_neither_looked_at_nor_kept() -> None:
    rng = np.random.default_rng(0)
    samples = [(0.1e-3 * i, *(0.1e-3 * rng.standard_normal(2))) for i in range(6000)]
    long, late = Seating(1.0, 1.0), Seating(1.0, 1.0)
    for i, sample in enumerate(samples):
        long.judge(*sample)
        if i > 4000:
            late.judge(*sample)
            assert i < 5000 or (long.doubt, long.risen) == (late.doubt, late.risen)
    assert len(long._seated.rows) < 1000  # a cycle's cost goes with it


def test_a_noisy_tip_on_a_short_line_is_not_taken_for_one_that_is_lifted() -> None:
    for seed in range(20):
        seating, rng = Seating(1.0, 1.0), np.random.default_rng(seed)
        for i in range(90):  # the line goes through 1 to 20 mm of what was felt
            noise = 0.6e-3 * rng.standard_normal(2)
            assert seating.judge(i * 0.33e-3, noise[0], noise[1]) is None

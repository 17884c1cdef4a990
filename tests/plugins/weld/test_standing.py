"""Where a weld begins again, where images are looked at, and what else is small and alone."""

from __future__ import annotations

import math
from pathlib import Path as FilePath
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye.motion.seam_following import ToolPose
from flangeye.plugin.stage import BoundPart
from flangeye.types import Image, Seam
from flangeye_emulators.finger.sensor import SimulatedFingerParams, sensor_simulated_finger
from flangeye_plugins.weld.corners import corners_of, leg_of
from flangeye_plugins.weld.following.follower import Follower
from flangeye_plugins.weld.following.model_prior import ModelPrior, body_of
from flangeye_plugins.weld.following.sensing import Track
from flangeye_plugins.weld.following.task import ResumePoint, WeldStart
from flangeye_plugins.weld.joint import JointKind, WeldJoint, edges_half_angle, joint_of
from flangeye_plugins.weld.passes import MultiPassController
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.resuming import (
    _away,
    _require_same,
    controller_of,
    restart,
    task_of,
)
from flangeye_plugins.weld.settings import Following, WeldTactileParams
from flangeye_plugins.weld.touch.tag_observation import RegionOfInterest, cut, shifted
from tests.plugins.weld.bench import straight

SENSOR = BoundPart(sensor_simulated_finger, SimulatedFingerParams())
DISTANCE = 0.04
CONSTRUCT: Any = WeldTactileParams.model_construct


def params(**given: Any) -> WeldTactileParams:
    return WeldTactileParams.model_validate({"sensor": SENSOR, **given})


def again(torch: float, plan: Any = None, number: int = 0, **given: Any) -> WeldStart:
    path = Path(straight(0.3) if plan is None else plan)
    return restart(
        params(**given), path, DISTANCE, ResumePoint(np.zeros((0, 5)), torch, number=number)
    )


# --- going on -------------------------------------------------------------------------------------


@pytest.mark.parametrize("torch", [0.0, 2e-3, 5e-3, 10.9e-3])
def test_a_weld_that_has_hardly_begun_begins_again_where_it_did(torch: float) -> None:
    assert again(torch).tip == pytest.approx(params().inset)


def test_the_torch_is_lit_an_overlap_before_the_stop_and_set_down_a_run_in_before_that() -> None:
    """In which it takes back what the sweep led it aside by: twice 8 mm."""
    found = again(0.2, overlap="30 mm")
    assert found.torch == pytest.approx(0.17)
    assert found.tip == pytest.approx(0.17 - 0.016 + DISTANCE, abs=0.6e-3)
    assert found.angle == pytest.approx(0.0, abs=1e-9)
    early = again(0.02, overlap="30 mm")
    assert early.torch == 0.0
    assert early.tip == pytest.approx(0.02 - 0.03 - 0.016 + DISTANCE, abs=0.6e-3)
    bent_slightly = np.linspace(0.0, 0.5, 800)
    circle = 0.5 * np.column_stack(
        [np.sin(bent_slightly), 1 - np.cos(bent_slightly), 0 * bent_slightly]
    )
    earlier = again(0.005, circle, overlap="30 mm")
    assert earlier.tip == pytest.approx(params().inset, abs=0.6e-3)


def test_the_tip_is_set_down_where_it_still_presses_for_five_millimetres() -> None:
    asked = params()
    letting_go = asked.ending + asked.speed * asked.deflection / asked.release
    found = again(0.29)
    assert found.tip == pytest.approx(0.3 - letting_go - 5e-3)
    short = letting_go + 5e-3 + asked.inset
    assert again(0.05, straight(short + 1e-4)).tip >= asked.inset
    with pytest.raises(StageError, match="the rest of the seam is too short for the tip to press"):
        again(0.05, straight(short - 1e-4))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_on_a_curve_the_tool_stands_along_the_chord_from_torch_to_tip(side: float) -> None:
    turn, radius = np.linspace(0.0, 4.0, 800), 0.06
    circle = radius * np.column_stack([np.sin(turn), side * (1 - np.cos(turn)), 0 * turn])
    found = again(0.13, circle)
    half = math.asin(DISTANCE / (2 * radius))
    assert found.angle == pytest.approx(-side * half, abs=0.02)
    arc = 2 * radius * half
    assert found.tip == pytest.approx(0.13 - 0.03 - 0.016 + arc, abs=1.1e-3)


def test_a_later_pass_comes_down_right_where_it_is_lit() -> None:
    passes = list[Any](({}, {}))
    found = again(0.1, number=1, passes=passes)
    assert found.torch == pytest.approx(0.07)
    assert found.tip == pytest.approx(0.07 + DISTANCE, abs=0.6e-3)
    assert again(0.02, number=2, passes=passes).torch == 0.0


def test_a_plan_is_the_same_within_a_thousandth_of_a_millimetre() -> None:
    points = straight(0.1)
    _require_same(FilePath("log"), points, points + [0.0, 0.9e-6, 0.0])
    for other in (points + [0.0, 1.1e-6, 0.0], points - [0.0, 1.1e-6, 0.0], points[:-1]):
        with pytest.raises(StageError, match="log: was planned on another seam; resume it on"):
            _require_same(FilePath("log"), points, other)


def test_the_controller_is_the_one_that_was_asked_for() -> None:
    plan, prior = Path(straight(0.1)), ModelPrior(DISTANCE)
    root, more = Following(), Following.model_validate({"passes": [{}]})
    tactile, vision = (controller_of(plan, prior, root, mode) for mode in ("tactile", "vision"))
    assert isinstance(tactile, Follower) and tactile.mode == "tactile"
    assert isinstance(vision, Follower) and vision.mode == "vision"
    assert isinstance(controller_of(plan, prior, more, "tactile"), MultiPassController)
    assert isinstance(controller_of(plan, prior, more, "vision"), Follower)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        task = task_of(plan, DISTANCE, Following.model_validate({"side": side}))
        assert task.side == sign and task.speed == root.speed


# --- joints and bodies ----------------------------------------------------------------------------


@pytest.mark.parametrize(("side", "upright"), [(1.0, "left"), (-1.0, "right")])
def test_the_walls_of_a_joint_follow_from_its_kind(side: float, upright: str) -> None:
    kinds: list[JointKind] = ["fillet", "lap"]
    for kind in kinds:
        joint: Any = joint_of(kind, None, side, 1e-3, 0.0)
        flat = "right" if upright == "left" else "left"
        assert getattr(joint, upright) == pytest.approx(0.0)
        assert getattr(joint, flat) == pytest.approx(math.pi / 2)
    corner: Any = joint_of("corner", None, side, 1e-3, 0.0)
    assert corner.left == corner.right == pytest.approx(math.pi / 4)
    for gap, known in ((0.0, False), (0.1e-3, True), (1.99e-3, True), (2e-3, False), (3e-3, False)):
        assert (joint_of("butt", None, side, 1e-3, gap) is not None) == known
    assert joint_of("groove", None, side, 1e-3, 1e-3) is None
    assert WeldJoint(0.6).lean == 0.0


@pytest.mark.parametrize("gap", [0.5e-3, 1.5e-3])
def test_a_ball_on_two_edges_climbs_as_steeply_as_in_its_groove(gap: float) -> None:
    radius, step = 1e-3, 1e-9
    # About the right edge, with the ball's centre turned from where it touches both.
    up = math.sqrt(radius**2 - (gap / 2) ** 2)
    aside = step
    raised = math.sqrt(radius**2 - (gap / 2 - aside) ** 2)
    assert (raised - up) / aside == pytest.approx(
        1 / math.tan(edges_half_angle(gap, radius)), rel=1e-4
    )


@pytest.mark.parametrize(("half_angle", "lean"), [(0.7, 0.3), (0.5, -0.4)])
def test_a_seat_moves_with_either_wall_by_no_more_than_is_stated(
    half_angle: float, lean: float
) -> None:
    joint, step, radius = WeldJoint(half_angle, lean), 1e-7, 2e-3
    here = joint.seat(radius)[0]
    left = WeldJoint(half_angle + step / 2, lean + step / 2).seat(radius)[0] - here
    right = WeldJoint(half_angle + step / 2, lean - step / 2).seat(radius)[0] - here
    most = max(abs(left), abs(right)) / step
    assert joint.seat_slope(radius) == pytest.approx(most, rel=1e-4)


def test_a_tool_leans_away_from_the_wall_it_presses() -> None:
    finger: Any = SimpleNamespace(torch_from_tip=np.array([-0.04, 0.0, 0.0]))
    for side, sign in (("left", -1.0), ("right", 1.0)):
        asked = Following.model_validate({"side": side, "work_angle": "20 deg"})
        up = body_of(finger, asked).level_R_tool[:, 2]
        assert up == pytest.approx(
            [0.0, sign * math.sin(math.radians(20)), math.cos(math.radians(20))]
        )


# --- what was, and where to look ------------------------------------------------------------------


def test_a_track_knows_the_last_second() -> None:
    track = Track()
    for i in range(300):
        track.add(ToolPose(i * 0.01, np.array([i * 1.0, 0.0, 0.0]), -2.0 * i))
    between: Any = track.at(2.345)
    assert between.position[0] == pytest.approx(234.5) and between.angle == pytest.approx(-469.0)
    assert between.time == 2.345
    assert track.at(1.97) is None and track.at(2.01) is not None
    exact: Any = track.at(2.5)
    assert exact.position[0] == pytest.approx(250.0)
    assert len(track._poses) in (100, 101)


def picture() -> Image:
    pixels = np.arange(60 * 80, dtype=np.int64).reshape(60, 80) % 251
    matrix = np.array([[400.0, 0, 40.0], [0, 410.0, 30.0], [0, 0, 1.0]])
    return Image(pixels.astype(np.uint8), matrix)


def test_the_tag_is_looked_for_around_its_last_place_and_then_everywhere() -> None:
    image, region = picture(), RegionOfInterest()
    (whole,) = region.pieces(image)
    assert whole.image is image and whole.corner == (0, 0)
    corners = np.array([[30.2, 25.7], [40.1, 25.7], [40.1, 35.2], [30.2, 35.2]])
    region.follow(whole, corners)
    piece, rest = region.pieces(image)
    assert rest.image is image and piece.corner == (14, 9)
    assert piece.image.pixels.tolist() == image.pixels[9:52, 14:57].tolist()
    region.follow(piece, corners - [14, 9])  # found there: in the piece's own pixels
    assert next(region.pieces(image)).corner == (14, 9)
    region.follow(whole, corners - [30, 25])
    near_the_edge = next(region.pieces(image))
    assert near_the_edge.corner == (0, 0) and near_the_edge.image.pixels.shape == (27, 27)
    region.follow(whole, None)
    assert len(list(region.pieces(image))) == 1


def test_a_piece_of_an_image_sees_the_same_rays() -> None:
    image = picture()
    piece = cut(image, (10, 5), (30, 20))
    assert piece.image.pixels.tolist() == image.pixels[5:20, 10:30].tolist()
    ray = np.array([0.02, -0.01, 1.0])
    seen = image.camera_matrix @ ray - [10, 5, 0]
    assert piece.image.camera_matrix @ ray == pytest.approx(seen)
    assert shifted(image.camera_matrix, (10, 5)) == pytest.approx(piece.image.camera_matrix)
    assert image.camera_matrix[0, 2] == 40.0  # the whole one's stays


# --- corners --------------------------------------------------------------------------------------


def bent(turn: float, legs: tuple[float, ...] = (0.06, 0.06), sampled: float = 1e-3) -> Any:
    heading, here, points = 0.0, np.zeros(3), [np.zeros(3)]
    for leg in legs:
        way = np.array([math.cos(heading), math.sin(heading), 0.0])
        count = max(1, round(leg / sampled))
        points += [here + way * leg * (i + 1) / count for i in range(count)]
        here, heading = points[-1], heading + turn
    return np.array(points)


def seam_of(points: Any, **more: Any) -> Seam:
    n = len(points)
    return Seam(points, np.tile([0.0, 0, 1.0], (n, 1)), np.tile(np.eye(3), (n, 1, 1)), **more)


def test_a_turn_of_thirty_five_degrees_within_a_centimetre_is_a_corner() -> None:
    for degrees, count in ((34.5, 0), (35.5, 1), (-34.5, 0), (-35.5, 1)):
        assert len(corners_of(bent(math.radians(degrees)))) == count


def test_corners_nearer_than_a_centimetre_are_the_sharper_one() -> None:
    angle = math.radians(60.0)
    (one,) = corners_of(bent(angle, (0.06, 4e-3, 0.06)))
    assert one.along == pytest.approx(0.062, abs=2.1e-3) and one.turn > angle
    near, far = corners_of(bent(angle, (0.06, 15e-3, 0.06)))
    assert (near.along, far.along) == pytest.approx((0.06, 0.075))
    assert [near.turn, far.turn] == pytest.approx([angle, angle])


def test_a_bend_nearer_to_an_end_than_a_chord_is_none() -> None:
    for near, count in ((4.5e-3, 0), (5.5e-3, 1)):
        for legs in ((near, 0.06), (0.06, near)):
            assert len(corners_of(bent(1.0, legs, sampled=0.02))) == count


def round_of(points: Any, radius: float) -> Seam:
    given = CONSTRUCT(leg=None, corner_radius=radius, side="left", joint="groove")
    return leg_of(seam_of(points), given)


def test_a_corner_is_rounded_within_half_of_its_shorter_leg() -> None:
    """By the tangent of half its turn."""
    points, radius = bent(1.0, (0.04, 0.1)), 0.02 / math.tan(0.5)
    found = round_of(points, 0.999 * radius)
    assert len(found.points_in_base) == len(found.openings_in_base)
    steps = np.linalg.norm(np.diff(found.points_in_base, axis=0), axis=1)
    assert steps.max() < 3e-3  # in the order of their way
    headings = np.unwrap(np.arctan2(*np.diff(found.points_in_base[:, :2], axis=0).T[::-1]))
    assert (np.diff(headings) > -1e-6).all() and headings[-1] == pytest.approx(1.0)
    with pytest.raises(
        StageError, match=f"of {1.001e3 * radius:.3g} mm, at most {1e3 * radius:.3g} mm"
    ):
        round_of(points, 1.001 * radius)
    with pytest.raises(StageError, match="no room"):
        round_of(points[::-1], 1.001 * radius)


@pytest.mark.parametrize(
    ("turn", "side", "joint", "half_angle", "room"),
    [
        (1.2, "left", "lap", None, True),
        (-1.2, "right", "fillet", None, True),
        (-1.2, "left", "lap", None, False),
        (1.2, "right", "fillet", None, False),
        (1.2, "left", "lap", 0.7, False),
        (1.2, "left", "groove", None, False),
    ],
)
def test_room_is_round_the_outside_of_an_upright_plate_alone(
    turn: float, side: str, joint: str, half_angle: float | None, room: bool
) -> None:
    for leg in (1, 2):
        given = CONSTRUCT(leg=leg, corner_radius=None, side=side, joint=joint)
        seam = seam_of(bent(turn), half_angle=half_angle)
        if room:
            ends = leg_of(seam, given).points_in_base[[0, -1]]
            assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(0.06)
            continue
        with pytest.raises(StageError, match="would run into a wall"):
            leg_of(seam, given)


@pytest.mark.parametrize("distance", [0.031, 0.0364, 0.0407])
def test_tip_and_torch_are_set_down_a_tool_s_length_apart_to_half_a_millimetre(
    distance: float,
) -> None:
    turn = np.linspace(0.0, 4.0, 800)
    plan = Path(0.06 * np.column_stack([np.sin(turn), 1 - np.cos(turn), 0 * turn]))
    for place in (0.05, 0.09, 0.1303):
        here = plan.at(place).point
        for found in (_away(plan, place, distance), _away(plan, place, -distance)):
            apart = np.linalg.norm(plan.at(found).point - here)
            assert distance - 1e-12 <= apart < distance + 0.5e-3

"""Which poses of the flange are asked of an arm: seen, lit, clear, and near to where it stands."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from flangeye.maths.kinematics import Arm
from flangeye.models.bodies import TargetBody, arm_body, load_body
from flangeye.models.loading import load_model
from flangeye.models.robots import Volume
from flangeye.models.urdf import robot_from_urdf
from flangeye.motion.clearance import ArmVolume
from flangeye.motion.reach import Margins, Reach, Site, _sides, poses_near
from flangeye.types.geometry import invert, rigid, rotation_from_rpy
from flangeye.units import SI
from tests.motion.stand_in import LIMITS, MODEL, turned

RECIPES = Path(__file__).parents[2] / "recipes"
ARM = Arm(MODEL)
AHEAD = np.array([0.6, 0.0, 0.3])
OVERHEAD = np.array([[0, -1, 0, 0.6], [-1, 0, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]], dtype=float)
SHOWN = np.radians([10.0, -125.0, -105.0, -40.0, -90.0, 170.0])
"""A posture with the flange below the scanner, facing it."""


@cache
def body(name: str) -> TargetBody:
    """A body of the project; what is worked out of its mesh is kept with it."""
    return load_body(name, None, Path())


def scanner(**more: Any) -> Any:
    """Return a scanner that sees 90 x 60 deg, without a projector."""
    plain = {"field_of_view": np.radians([90.0, 60.0]), "near": 0.5, "far": 1.0, "baseline": 0.0,
             "convergence": 0.0, "projection": None}  # fmt: skip
    return load_model("scanners", "phoxi-m").model_copy(update=plain | more)


def reach(margins: Margins | None = None, **more: Any) -> Reach:
    return Reach(MODEL, scanner(**more), OVERHEAD, 0.05, margins)


def seen_from_above(**far_away: Any) -> Reach:
    """Return a reach whose scanner sees and lights all that the arm can show."""
    return reach(near=0.01, far=9.0, field_of_view=np.radians([170.0, 170.0]), **far_away)


@pytest.mark.parametrize(
    ("place", "seen"),
    [
        ((0.0, 0.0, 0.7), True),
        ((0.6149, 0.0, 0.7), True), ((0.6151, 0.0, 0.7), False),  # 0.95 x 0.7 tan 45 - 0.05
        ((-0.6149, 0.0, 0.7), True), ((-0.6151, 0.0, 0.7), False),
        ((0.0, 0.3338, 0.7), True), ((0.0, 0.3341, 0.7), False),  # 0.95 x 0.7 tan 30 - 0.05
        ((0.0, -0.3338, 0.7), True), ((0.0, -0.3341, 0.7), False),
        ((0.0, 0.0, 0.5), True), ((0.0, 0.0, 0.499), False),
        ((0.0, 0.0, 1.0), True), ((0.0, 0.0, 1.001), False),
    ],
)  # fmt: skip
def test_the_whole_disc_lies_in_the_field_of_view_and_in_range(place: Any, seen: bool) -> None:
    of_camera = Reach(MODEL, scanner(), np.eye(4), 0.05)
    assert of_camera.in_view(rigid(np.eye(3), np.array(place))) is seen


def test_the_rim_of_a_disc_on_edge_counts_not_its_centre_alone() -> None:
    of_camera = Reach(MODEL, scanner(), np.eye(4), 0.05)
    for axis in ("roll", "pitch"):
        on_edge = rotation_from_rpy(*(np.pi / 2 * (axis == name) for name in ("roll", "pitch", "")))
        for depth, seen in ((0.549, False), (0.551, True), (0.949, True), (0.951, False)):
            assert of_camera.in_view(rigid(on_edge, np.array([0.0, 0.0, depth]))) is seen


@pytest.mark.parametrize(
    ("depth", "lit"), [(0.455, False), (0.475, True), (0.7, True), (1.04, True), (1.06, False)]
)
def test_camera_and_projector_lean_towards_each_other_and_both_must_see(
    depth: float, lit: bool
) -> None:
    # Each leans by 30 deg, 0.7 m apart: their axes meet at 0.7 m. From the projector, a point on
    # the camera's axis is at 19.07 deg (0.95 tan 20) from its axis at depths of 0.467 and 1.049 m.
    lean = {"baseline": 0.7, "convergence": np.radians(30.0)}
    both = scanner(near=0.1, far=2.0, projection=np.radians([40.0, 40.0]), **lean)
    pose = rigid(np.eye(3), np.array([0.0, 0.0, depth]))
    assert Reach(MODEL, both, np.eye(4), 1e-4).in_view(pose) is lit
    alone = scanner(near=0.1, far=2.0, **lean)  # lights all of space
    assert Reach(MODEL, alone, np.eye(4), 1e-4).in_view(pose)


def test_the_projector_s_field_lies_about_its_own_axis() -> None:
    lean = np.radians(30.0)
    wide = {"near": 0.01, "far": 9.0, "field_of_view": np.radians([170.0, 170.0])}
    both = scanner(projection=np.radians([40.0, 30.0]), baseline=0.7, convergence=lean, **wide)
    right, up = (0.95 * 0.7 * np.tan(np.radians(half)) for half in (20.0, 15.0))
    turn = rotation_from_rpy(0.0, -2 * lean, 0.0)
    place = 0.7 * np.array([np.cos(lean), 0.0, np.sin(lean)])
    for x, y in ((0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0), (0.9, 1.0), (-0.9, 1.0)):
        for edge, lit in ((-1e-4, True), (1e-4, False)):
            point = np.array([x * (right + edge * abs(x // 1)), y * (up + edge * abs(y)), 0.7])
            pose = rigid(np.eye(3), place + turn @ point)
            assert Reach(MODEL, both, np.eye(4), 1e-6).in_view(pose) is lit


def test_what_lies_behind_the_projector_is_not_lit() -> None:
    lean = {"baseline": 0.7, "convergence": np.radians(60.0)}
    wide = np.radians([120.0, 120.0])
    both = scanner(near=0.01, field_of_view=wide, projection=wide, **lean)
    # 0.15 m before the camera, 0.25 m beyond the projector on the line through both.
    beyond = np.array([0.95 * np.cos(lean["convergence"]), 0.0, 0.95 * np.sin(lean["convergence"])])
    assert not Reach(MODEL, both, np.eye(4), 1e-4).in_view(rigid(np.eye(3), beyond))


def rolls(arm: Reach, place: Any) -> list[tuple[float, Any, Any]]:
    """Return manipulability, rotation and joints of every clear posture that faces the scanner."""
    found = []
    for turn in np.radians(45.0 * np.arange(8)):
        facing = OVERHEAD[:3, :3] @ rotation_from_rpy(np.pi, 0.0, 0.0)
        rotation = facing @ rotation_from_rpy(0.0, 0.0, turn)
        for joints in ARM.inverse(rigid(rotation, place)):
            if arm._clear(joints):
                found.append((float(ARM.manipulability(joints)), rotation, joints))
    return found


def test_a_flange_faces_the_scanner_in_the_posture_that_moves_best() -> None:
    arm = seen_from_above()
    rotation = arm.facing_rotation(AHEAD)
    assert rotation is not None
    assert rotation[:, 2] == pytest.approx(-OVERHEAD[:3, 2], abs=1e-12)
    assert ARM.flange(arm.home) == pytest.approx(rigid(rotation, AHEAD), abs=1e-8)
    best = max(score for score, *_ in rolls(arm, AHEAD))
    assert float(ARM.manipulability(arm.home)) == pytest.approx(best, rel=1e-6)


def test_from_where_the_arm_stands_it_takes_the_nearest_posture_that_moves_half_as_well() -> None:
    arm, place = seen_from_above(), np.array([0.2, 0.2, 0.3])
    every = rolls(arm, place)
    best = max(score for score, *_ in every)
    assert min(score for score, *_ in every) < 0.5 * best  # some do not move well
    for _, _, start in every:
        arm.start_from(start)
        arm.facing_rotation(place)
        turns = [(np.abs(joints - start).max(), score) for score, _, joints in every]
        nearest = min(turn for turn, score in turns if score >= 0.5 * best)
        # Whole turns of a joint may bring a posture nearer yet.
        assert np.abs(arm.home - start).max() <= nearest + 1e-6
        assert float(ARM.manipulability(arm.home)) >= 0.5 * best * (1 - 1e-9)


def test_a_place_out_of_reach_has_no_facing_and_is_said_once_for_each_roll() -> None:
    arm = seen_from_above()
    assert arm.facing_rotation(np.array([3.0, 0.0, 0.3])) is None
    assert arm.why_refused() == "8 out of the arm's reach"
    assert all(refusal.place == pytest.approx([3.0, 0.0, 0.3]) for refusal in arm.refusals)


@pytest.mark.parametrize("last", [20.0, 200.0, 350.0, -200.0, -350.0])
def test_joints_stay_in_the_turn_in_which_the_arm_stands(last: float) -> None:
    arm, start = seen_from_above(), np.r_[SHOWN[:5], np.radians(last)]
    arm.start_from(start)
    assert arm.joints(ARM.flange(start)) == pytest.approx(start, abs=1e-6)


@pytest.mark.parametrize(
    ("last", "by", "there"),
    [(350.0, 9.0, 359.0), (350.0, 11.0, 1.0), (-350.0, -11.0, -1.0), (200.0, 140.0, 340.0)],
)
def test_a_turn_is_gone_on_with_up_to_the_limit(last: float, by: float, there: float) -> None:
    arm, start = seen_from_above(), np.r_[SHOWN[:5], np.radians(last)]
    arm.start_from(start)
    pose = ARM.flange(turned(start, j6=np.radians(by)))
    found = [q for q in arm._possible(pose) if np.abs(q[:5] - SHOWN[:5]).max() < 1e-6]
    assert [np.degrees(joints[5]) for joints in found] == [pytest.approx(there, abs=1e-4)]


def test_of_several_postures_the_one_nearest_to_home_is_taken() -> None:
    arm, pose = seen_from_above(), ARM.flange(SHOWN)
    clear = [joints for joints in ARM.inverse(pose) if arm._clear(joints)]
    assert len(clear) > 1
    for joints in clear:
        arm.home = joints
        assert arm.joints(pose) == pytest.approx(joints, abs=1e-6)


def only(joints: Any, room: float = 0.02) -> Margins:
    """Return margins that leave the arm no posture but those near one."""
    limits = replace(LIMITS, lower=joints - room, upper=joints + room)
    return Margins(limits, 0.0, 0.0)


@pytest.mark.parametrize(("turn", "folds"), [(119.9, False), (120.1, True), (-120.1, True)])
def test_an_arm_under_way_does_not_fold_over(turn: float, folds: bool) -> None:
    arm = seen_from_above(margins=only(SHOWN))
    start = turned(SHOWN, j4=np.radians(turn))
    arm.home = start
    assert arm.joints(ARM.flange(SHOWN)) is not None  # nothing is known of where it stands
    arm.start_from(start)
    assert (arm.joints(ARM.flange(SHOWN)) is None) is folds
    assert arm.why_refused() == ("1 only with a joint more than 120 deg from home" if folds else "")


def scaled(joints: Any) -> float:
    """Return the smallest singular value of the Jacobian, lengths in units of the reach."""
    units = np.r_[np.ones(3), np.full(3, 1 / MODEL.length)]
    return float(np.linalg.svd(units[:, None] * ARM.jacobian(joints), compute_uv=False).min())


@pytest.mark.parametrize(
    ("margins", "reason"),
    [
        (only(SHOWN), ""),
        (only(SHOWN)._replace(joints=0.019), ""),
        (only(SHOWN)._replace(joints=0.021), "near the limits of the joints"),
        (Margins(replace(LIMITS, high=np.array([1.0, 1.0, 0.3])), 0.0, 0.0),
         "outside robot.limits.box"),
    ],
)  # fmt: skip
def test_a_pose_that_is_too_near_to_a_margin_is_refused_and_says_to_which(
    margins: Margins, reason: str
) -> None:
    arm = seen_from_above(margins=margins)
    assert (arm.joints(ARM.flange(SHOWN)) is None) is bool(reason)
    assert arm.why_refused() == (f"1 {reason}" if reason else "")


def test_a_single_posture_that_is_too_near_says_so_too() -> None:
    pose = ARM.flange(np.radians([19.7, -141.7, -116.2, 0.2, -118.1, 182.7]))
    assert sum(seen_from_above()._clear(joints) for joints in ARM.inverse(pose)) == 1
    arm = seen_from_above(margins=Margins(replace(LIMITS, high=np.zeros(3)), 0.0, 0.0))
    assert arm.joints(pose) is None
    assert arm.why_refused() == "1 outside robot.limits.box"


def test_a_posture_counts_as_singular_by_its_worst_direction_in_units_of_the_reach() -> None:
    clear = [
        joints for joints in ARM.inverse(ARM.flange(SHOWN)) if seen_from_above()._clear(joints)
    ]
    best = max(scaled(joints) for joints in clear)
    for share, refused in ((0.999, ""), (1.001, "1 near a singularity")):
        arm = seen_from_above(margins=Margins(LIMITS, 0.0, share * best))
        arm.joints(ARM.flange(SHOWN))
        assert arm.why_refused() == refused


def test_the_arm_comes_down_to_the_table_and_not_below_it() -> None:
    volume = ArmVolume(MODEL)
    axes = volume.axes(ARM.frames(SHOWN))
    arm = seen_from_above(margins=only(SHOWN, 1.5))
    low = ARM.flange(SHOWN)
    for _ in range(3):  # the wrist is lowest: it goes down with the flange
        joints = ARM.inverse_near(low, SHOWN[None])[0]
        axes, moving = volume.axes(ARM.frames(joints)), volume.links >= 2
        low[2, 3] -= (axes[moving, :, 2].min(axis=1) - volume.radii[moving]).min()
    for above, clear in ((0.0005, True), (-0.0005, False)):
        pose = rigid(low[:3, :3], low[:3, 3] + [0.0, 0.0, above])
        joints = ARM.inverse_near(pose, SHOWN[None])[0]
        assert arm._clear(joints) is clear


def test_an_arm_in_the_line_of_sight_of_camera_or_projector_is_in_the_way() -> None:
    # Seen from the side, the flange turned away from it: the arm itself stands between.
    place = ARM.flange(SHOWN)[:3, 3]
    for baseline, convergence in ((0.0, 0.0), (0.8, 0.0)):
        for way, clear in ((1.0, True), (-1.0, False)):
            camera = OVERHEAD.copy()
            camera[2, 3] = place[2] + way * 0.7
            lean = {"baseline": baseline, "convergence": convergence}
            arm = Reach(MODEL, scanner(**lean), camera, 0.05)
            assert arm._clear(SHOWN) is clear


@pytest.mark.parametrize(("link", "clear"), [(6, True), (5, False)])
def test_the_link_that_ends_in_the_flange_is_behind_its_face(link: int, clear: bool) -> None:
    """A capsule about the last link of a URDF's mesh reaches beyond the flange that it ends in."""
    of_link = invert(ARM.frames(SHOWN)[link]) @ ARM.flange(SHOWN)
    start, end = (tuple(map(SI, (of_link @ [0.0, 0.0, z, 1.0])[:3])) for z in (-0.03, 0.03))
    volume = Volume(link=link, start=start, end=end, radius=SI(0.04))
    robot = MODEL.model_copy(update={"volumes": (*MODEL.known_volumes(), volume)})
    camera = OVERHEAD.copy()
    camera[:3, 3] = ARM.flange(SHOWN)[:3, 3] + [0.0, 0.0, 0.7]
    assert Reach(robot, scanner(), camera, 0.05)._clear(SHOWN) is clear


def test_each_axis_of_a_flange_may_be_the_one_that_is_shown() -> None:
    """To z, from wherever it points, without a turn that tilts it."""
    shown = [side.T @ [0.0, 0.0, 1.0] for side in _sides()]
    found = sorted(tuple(np.round(axis).astype(int).tolist()) for axis in shown)
    assert np.abs(np.array(shown) - np.round(shown)).max() < 1e-12
    assert found == sorted(tuple(each) for each in (*np.eye(3, dtype=int), *-np.eye(3, dtype=int)))


@pytest.mark.parametrize(("before", "clear"), [(-0.01, True), (0.05, False)])
def test_what_stands_before_the_flange_of_a_far_scanner_is_in_the_way(
    before: float, clear: bool
) -> None:
    """The line of sight is as wide as the flange, 4 cm here, and ends as far before it."""
    of_link = invert(ARM.frames(SHOWN)[5]) @ ARM.flange(SHOWN)
    place = tuple(map(SI, (of_link @ [0.0, 0.0, before, 1.0])[:3]))
    volume = Volume(link=5, start=place, end=place, radius=SI(0.005))
    robot = MODEL.model_copy(update={"volumes": (volume,)})
    camera = OVERHEAD.copy()
    camera[:3, 3] = ARM.flange(SHOWN)[:3, 3] + [0.0, 0.0, 2.5]
    assert Reach(robot, scanner(), camera, 0.04)._clear(SHOWN) is clear


def test_an_arm_keeps_off_the_scanners_housing() -> None:
    elbow = ARM.frames(SHOWN)[3][:3, 3]
    for aside, clear in ((0.0, False), (0.6, True)):
        camera = OVERHEAD.copy()
        camera[:3, 3] = elbow + [0.0, aside, 0.0]
        assert Reach(MODEL, scanner(), camera, 0.0)._clear(SHOWN) is clear


def test_a_scanner_s_housing_reaches_ten_centimetres_about_its_eyes() -> None:
    tip = (1.2, 0.0, 0.5)  # of an arm of one small ball, far from the table and the flange
    ball = Volume(link=0, start=tuple(map(SI, tip)), end=tuple(map(SI, tip)), radius=SI(0.05))
    robot = MODEL.model_copy(update={"volumes": (ball,)})
    for away, clear in ((0.149, False), (0.151, True)):
        camera = OVERHEAD.copy()
        camera[:3, 3] = np.array(tip) + [away, 0.0, 0.0]
        beyond = Reach(robot, scanner(), camera, body("ring-plate"))
        assert beyond._clear(SHOWN) is clear


TORCH = body("torch")


@pytest.mark.parametrize("name", ["gripper", "torch", "ring-plate"])
def test_a_body_is_shown_by_most_of_what_faces_the_camera(name: str) -> None:
    tool = body(name)
    arm = Reach(MODEL, load_model("scanners", "phoxi-m"), OVERHEAD, tool)
    site = Site(
        arm.middle(), OVERHEAD[:3, 3], arm.facing_rotation, arm.joints, shown=lambda: arm.shown
    )
    poses = poses_near(site.centre, 10, site, np.random.default_rng(0), (0.1, 0.3))
    assert len(poses) == 10
    for pose in poses:
        mesh = trimesh.Trimesh(tool.vertices, tool.triangles).apply_transform(pose.base_T_flange)
        towards = OVERHEAD[:3, 3] - mesh.triangles_center
        areas = mesh.area_faces * np.einsum("ij,ij->i", mesh.face_normals, towards).clip(min=0)
        assert areas[arm._inside(mesh.triangles_center)].sum() > 0.5 * areas.sum()
        assert mesh.vertices[:, 2].min() > 0


def test_a_flat_body_turns_its_broad_side_to_the_camera_not_to_a_projector_aside() -> None:
    lean = np.radians(40.0)  # the axes meet where the body is shown
    aside = {"baseline": 1.4 * np.sin(lean), "convergence": lean}
    eye = scanner(near=0.1, far=9.0, field_of_view=np.radians([100.0, 100.0]), **aside)
    arm = Reach(MODEL, eye, OVERHEAD, body("ring-plate"))
    assert arm.facing_rotation(AHEAD) is not None
    assert np.abs(arm.shown) == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)


def test_a_body_is_worked_with_at_the_nearest_depth_at_which_it_can_be_shown() -> None:
    camera = OVERHEAD.copy()
    camera[2, 3] = 2.2  # the arm reaches up to 1.3 m below it
    arm = Reach(MODEL, scanner(near=1.1, far=2.3), camera, TORCH)
    assert arm.middle() == pytest.approx([0.6, 0.0, 0.9])
    assert arm.why_refused() == ""  # what was tried on the way is no pose that was asked for
    camera[2, 3] = 1.2  # and here all of it; 0.6 m is the working distance
    arm = Reach(MODEL, scanner(near=0.3, far=0.9), camera, TORCH)
    assert arm.middle() == pytest.approx([0.6, 0.0, 0.6])


def test_a_body_out_of_the_field_or_behind_the_arm_is_refused() -> None:
    wide = {"near": 0.1, "far": 9.0}
    for turn, field, shown in ((0.0, 60.0, True), (0.0, 2.0, False), (np.pi, 60.0, False)):
        camera = ARM.flange(SHOWN) @ rigid(rotation_from_rpy(np.pi + turn, 0.0, 0.0), np.zeros(3))
        camera[:3, 3] -= 0.8 * camera[:3, 2]
        eye = scanner(**wide, field_of_view=np.radians([field, field]))
        arm = Reach(MODEL, eye, camera, TORCH)
        assert arm._clear(SHOWN)
        assert arm._allowed(SHOWN) is shown
        assert arm._why_not(SHOWN[None]) == "with too little of the body in view"


def test_a_tool_stays_above_the_table() -> None:
    low = ARM.flange(SHOWN)
    down = rigid(low[:3, :3] @ rotation_from_rpy(np.pi, 0.0, 0.0), np.array([0.5, 0.1, 0.12]))
    for tool in (TORCH, 0.05):
        arm = Reach(MODEL, scanner(near=0.01, far=9.0), OVERHEAD, tool)
        above = [arm._volume.above(arm._volume.axes(ARM.frames(q)), 0.0) for q in ARM.inverse(down)]
        assert any(above) is (tool is not TORCH)


def test_an_arm_shows_itself_from_the_side_and_not_to_a_camera_that_sees_its_tip_alone() -> None:
    robot = robot_from_urdf(RECIPES / "boxes-arm.urdf")
    body, eye = arm_body(robot, {}, Path()), load_model("scanners", "azure-kinect")
    camera = rigid(rotation_from_rpy(-1.92, 0.0, 1.75), np.array([1.3, 0.3, 0.8]))
    joints = np.array([1.7, -1.5, 1.6, -1.7, -1.4, 0.4])
    assert Reach(robot, eye, camera, body)._seen(joints)[1] > 0.9
    camera[:3, 3] += 1.1 * camera[:3, 2]
    assert Reach(robot, eye, camera, body)._seen(joints)[1] < 0.6


def test_an_arm_that_touches_itself_is_in_its_own_way() -> None:
    folded = np.radians([0.0, -90.0, 157.0, 0.0, 86.0, 0.0])
    arm = seen_from_above()
    assert not arm._volume.apart(arm._volume.axes(ARM.frames(folded)))
    assert not arm._clear(folded)


def test_what_the_projector_does_not_light_is_not_seen() -> None:
    """From 45 degrees to the side it leaves the gripper's other side dark."""
    wide = {"near": 0.1, "far": 9.0, "field_of_view": np.radians([120.0, 120.0])}
    camera = ARM.flange(SHOWN) @ rigid(rotation_from_rpy(np.pi, 0.0, 0.0), np.zeros(3))
    camera[:3, 3] -= 0.8 * camera[:3, 2]
    gripper = body("gripper")
    alone, aside = (
        Reach(MODEL, scanner(**wide, baseline=at), camera, gripper)._seen(SHOWN)[1]
        for at in (0.0, 0.8)
    )
    assert alone == pytest.approx(1.0) and aside < 0.8

"""seam.joint: six joints in scans of a ray caster of its own, against the truth, and its refusals."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from flangeye import CalibrationRefused, StageError
from flangeye.maths.seam_geometry import errors_from, tube_radii
from flangeye.types import (
    CAMERA,
    FLANGE,
    Box,
    PointCloud,
    ScanPlace,
    Transform,
    TransformEstimate,
    VerifiedHandEye,
    WorkpieceScan,
)
from flangeye.types.geometry import rigid, rotation_from_rpy
from flangeye_plugins.seam.ends import last_in_strips
from flangeye_plugins.seam.joint import JointParams, seam_joint
from tests.plugins.seam.raycast import JOINTS, LENGTH, MM, WIDE, Plate, box, prism, scan_of, seen_by
from tests.plugins.seam.scenes import BASE_T_CAMERA, hand_eye, scanned
from tools.seam_joints import outcome, planned, table


@pytest.mark.parametrize("joint", JOINTS)
def test_a_joint_is_where_it_is(joint: str) -> None:
    found = outcome(0, joint)
    assert found["across"] < 0.15
    assert found["inside"] > 0.9
    assert max(found["ends"]) < 1
    assert not found["wrong"]


@pytest.mark.slow
@pytest.mark.parametrize("joint", JOINTS)
def test_fifty_scans_of_a_joint(joint: str) -> None:
    found = [outcome(seed, joint) for seed in range(50)]
    good = [f for f in found if "refused" not in f]
    print(table(found))
    assert len(good) >= 40
    assert np.median([f["across"] for f in good]) < 0.15
    assert np.median([f["ends"] for f in good]) < 0.5
    assert not any(f["wrong"] for f in good)


@cache
def plain_plate():
    plate = [prism([(-60 * MM, -10 * MM), (60 * MM, -10 * MM), (60 * MM, 0), (-60 * MM, 0)])]
    return scan_of("plate", 1, pitch=0.5 * MM, plates=(plate, (-60 * MM, 60 * MM)))


@pytest.mark.parametrize("joint", JOINTS)
def test_a_plain_plate_is_no_joint(joint: str) -> None:
    scan = plain_plate()
    with pytest.raises(
        CalibrationRefused, match=f"no {joint} joint|is known to|no gap is seen|no joint is seen"
    ):
        planned(scan, joint)


@pytest.mark.parametrize(
    ("scanned", "asked"), [("fillet", "vee"), ("vee", "lap"), ("lap", "corner")]
)
def test_another_joint_is_refused(scanned: str, asked: str) -> None:
    with pytest.raises(CalibrationRefused, match="seam.joint: "):
        planned(scan_of(scanned, 0, pitch=0.5 * MM), asked)


def test_the_opening_is_half_way_between_what_meets() -> None:
    seam, _ = planned(scan := scan_of("fillet", 0), "fillet")
    joint = BASE_T_CAMERA.rotation @ scan.camera_T_joint[:3, :3]
    assert np.allclose(seam.openings_in_base, joint @ [0, 0.5**0.5, 0.5**0.5], atol=0.01)
    assert np.degrees(seam.half_angle) == pytest.approx(45, abs=0.5)


def disc_on_plate(radius=30 * MM, height=6 * MM, sides=90):
    """Return a round plate on a square one: a lap joint that closes."""
    angle = np.arange(sides) * 2 * np.pi / sides
    round_ = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    normals = np.vstack([round_, [[0, 0, 1], [0, 0, -1]]])
    disc = Plate(normals, np.append(np.full(sides, radius), [height, 0]))
    return [disc, box([-0.08, -0.08, -0.01], [0.08, 0.08, 0])], (0, 0)


def test_a_round_seam_is_closed() -> None:
    scan = scan_of("plate", 3, 0.5 * MM, plates=disc_on_plate(sides=60), tilt=10.0)
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rough = 32 * MM * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) + [2 * MM, 0, 0]
    camera = rough @ scan.camera_T_joint[:3, :3].T + scan.camera_T_joint[:3, 3]
    line = [[f"{1e3 * v} mm" for v in point] for point in BASE_T_CAMERA.apply(camera)]
    cloud = WorkpieceScan(PointCloud(CAMERA, scan.points.astype(np.float32)), "disc")
    params = JointParams.model_validate({"joint": "lap", "line": line, "closed": True})
    seam = seam_joint(hand_eye(), cloud, params)
    back = BASE_T_CAMERA.inverse().apply(seam.points_in_base) - scan.camera_T_joint[:3, 3]
    place = back @ scan.camera_T_joint[:3, :3]
    errors = np.hypot(np.linalg.norm(place[:, :2], axis=1) - 30 * MM, place[:, 2])
    assert np.median(errors) < 0.15 * MM
    assert (errors <= tube_radii(seam)).mean() > 0.9
    assert np.linalg.norm(place[0] - place[-1]) < 0.1 * MM


@pytest.mark.parametrize("workpiece", ["v-straight", "v-curved"])
def test_a_groove_before_the_simulated_scanner(workpiece: str) -> None:
    scan, truth = scanned(workpiece, seed=1)
    seam = in_groove(scan, truth[[0, len(truth) // 2, -1]] if len(truth) > 2 else truth)
    errors = errors_from(seam, truth)
    assert np.sqrt(np.mean(errors**2)) < 0.2 * MM
    assert (errors <= tube_radii(seam)).mean() > 0.9
    assert np.degrees(seam.half_angle) == pytest.approx(40, abs=1.5)
    assert seam.half_width == pytest.approx(8.4 * MM, abs=0.5 * MM)
    off = np.linalg.norm(seam.points_in_base[[0, -1]] - truth[[0, -1]], axis=1)
    assert (off < 4 * np.array([seam.figures["start"], seam.figures["end"]])).all()


def in_groove(scan, line, workspace=None, hand=None, **given):
    """Return the V-groove along a rough line (N, 3) in base."""
    line = [[f"{1e3 * v} mm" for v in point] for point in line]
    params = JointParams.model_validate({"joint": "vee", "line": line, **given})
    return seam_joint(hand or hand_eye(), scan, params, None, workspace)


def test_the_seam_moves_with_the_scene() -> None:
    scan, truth = scanned("v-straight", seed=1)
    motion = rigid(rotation_from_rpy(0.02, -0.03, 0.04), np.array([0.01, 0.02, -0.03]))
    moved = truth @ motion[:3, :3].T + motion[:3, 3]
    seam, other = in_groove(scan, truth), in_groove(scan, moved, hand=hand_eye(error=motion))
    expected = seam.points_in_base @ motion[:3, :3].T + motion[:3, 3]
    assert np.allclose(other.points_in_base, expected, atol=1e-9)


def test_a_seam_outside_the_workspace_is_refused() -> None:
    scan, truth = scanned("v-straight", seed=1)
    box = Box(np.array([0.6, 0.0, 0.3]), np.array([0.1, 0.3, 0.2]))
    with pytest.raises(CalibrationRefused, match="seam.joint: the seam leaves the workspace by"):
        in_groove(scan, truth, box)


def test_a_line_that_turns_back_is_refused() -> None:
    scan, truth = scanned("v-straight", seed=1)
    with pytest.raises(StageError, match="seam.joint: line turns back at its point 2; give its po"):
        in_groove(scan, [truth[1], truth[0], truth.mean(axis=0)])


@pytest.mark.parametrize(("hides", "told"), [(2.5 * MM, None), (9 * MM, "its end is known to")])
def test_an_end_that_a_block_hides(hides: float, told: str | None) -> None:
    """A block on one face at the seam's end: as far as the others end alike, or not at all."""
    section = [(-WIDE, 0), (0, 0), (-8 * MM, 10 * MM), (-WIDE, 10 * MM)]
    other = [(0, 0), (WIDE, 0), (WIDE, 10 * MM), (8 * MM, 10 * MM)]
    block = box([LENGTH / 2 - hides, -WIDE, 10 * MM], [LENGTH / 2 + 0.02, -8 * MM, 25 * MM])
    plates = [prism(section), prism(other), block], (-LENGTH / 2, LENGTH / 2)
    scan = scan_of("plate", 4, faults=False, plates=plates, tilt=5.0)
    if told:
        with pytest.raises(CalibrationRefused, match=told):
            planned(scan, "vee")
        return
    seam, truth = planned(scan, "vee")
    off = np.linalg.norm(seam.points_in_base[-1] - truth[1])
    assert off < 4 * seam.figures["end"]
    assert seam.figures["end"] > 2 * seam.figures["start"]


@pytest.mark.parametrize("count", [5, 8])
def test_a_round_groove_is_found_from_a_few_points_about_it(count: int) -> None:
    """The chords between five points miss the circle by 11 mm, and meet at 72 deg."""
    scan, truth = scanned("v-ring", seed=2, distortion=0.0)
    line = truth[np.linspace(0, len(truth) - 1, count, endpoint=False).round().astype(int)]
    seam = in_groove(scan, line, closed=True)
    errors = errors_from(seam, truth)
    assert np.sqrt(np.mean(errors**2)) < 0.15 * MM and errors.max() < 0.3 * MM
    assert (errors <= tube_radii(seam)).mean() > 0.9
    assert seam.arc_length[-1] == pytest.approx(2 * np.pi * 60 * MM, rel=2e-3)


def test_a_thing_that_lies_across_the_seam_is_told_of() -> None:
    scan, truth = scanned("v-straight", seed=3)
    points = scan.cloud.points().astype(np.float64)
    along = truth[-1] - truth[0]
    length = np.linalg.norm(along)
    s = (BASE_T_CAMERA.apply(points) - truth[0]) @ along / length
    covered = np.abs(s - length / 2) < 15 * MM
    points[covered, 2] = BASE_T_CAMERA.inverse().apply(truth[:1])[0, 2] - 12 * MM
    over = replace(scan, cloud=PointCloud(CAMERA, points.astype(np.float32)))
    with pytest.raises(
        CalibrationRefused, match="from 8[0-9] to 1[12][0-9] mm along the seam most points"
    ):
        in_groove(over, truth)


def test_a_pipe_on_a_plate_is_closed_and_seen_from_around_it() -> None:
    """One place sees half of the fillet about it; six clouds of a scanner on the flange see it all."""
    radius, angles = 30 * MM, np.arange(6) * np.pi / 3
    plates = disc_on_plate(radius, height=40 * MM, sides=60)
    clouds, places = [], []
    for angle in angles:
        c, s = np.cos(angle), np.sin(angle)
        spin = rigid(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.zeros(3))
        lean = rigid(rotation_from_rpy(np.radians(40), 0, 0), np.zeros(3))
        stands = (
            spin @ lean @ np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.6], [0, 0, 0, 1.0]])
        )
        bodies = [plate.moved(np.linalg.inv(stands)) for plate in plates[0]]
        clouds.append(seen_by(bodies, 0.7 * MM / 0.6, half=0.08))
        places.append(ScanPlace(len(clouds[-1]), stands, np.zeros(6)))
    covariance = np.diag([1e-10] * 6)
    camera = TransformEstimate(Transform(FLANGE, CAMERA, np.eye(4)), covariance, np.zeros(3))
    cloud = PointCloud(CAMERA, np.concatenate(clouds).astype(np.float32))
    around = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rough = 32 * MM * np.column_stack([np.cos(around), np.sin(around), 0 * around]) + [2 * MM, 0, 0]
    line = [[f"{1e3 * v} mm" for v in point] for point in rough]
    params = JointParams.model_validate({"joint": "fillet", "line": line, "closed": True})
    scan = WorkpieceScan(cloud, "pipe", places=tuple(places))
    seam = seam_joint(VerifiedHandEye(camera, (), "test"), scan, params)
    errors = np.hypot(
        np.linalg.norm(seam.points_in_base[:, :2], axis=1) - radius, seam.points_in_base[:, 2]
    )
    assert np.median(errors) < 0.15 * MM and errors.max() < 0.5 * MM
    assert np.linalg.norm(seam.points_in_base[0] - seam.points_in_base[-1]) < 0.2 * MM
    assert seam.arc_length[-1] == pytest.approx(2 * np.pi * radius, rel=0.01)
    assert np.degrees(seam.half_angle) == pytest.approx(45, abs=1)
    outwards = seam.points_in_base * [1, 1, 0] / radius
    tilted = np.einsum("ni,ni->n", seam.openings_in_base, (outwards + [0, 0, 1]) / np.sqrt(2))
    assert (tilted > 0.99).all()


def test_without_a_line_it_says_what_to_write() -> None:
    scan = WorkpieceScan(PointCloud(CAMERA, np.ones((5, 3), np.float32)), "few")
    with pytest.raises(StageError) as error:
        seam_joint(hand_eye(), scan, JointParams(joint="vee"))
    assert str(error.value) == (
        "seam.joint: no rough seam line; write line:, or put a seam step before it"
    )


def test_too_few_points_about_the_line_are_refused() -> None:
    params = JointParams.model_validate(
        {"joint": "vee", "line": [["0 mm", "0 mm", "0 mm"], ["100 mm", "0 mm", "0 mm"]]}
    )
    scan = WorkpieceScan(PointCloud(CAMERA, np.ones((5, 3), np.float32)), "few")
    with pytest.raises(StageError, match="seam.joint: 0 points are near the line; 300 are needed"):
        seam_joint(hand_eye(), scan, params)


def test_a_surface_without_points_has_no_lanes() -> None:
    empty = np.zeros(0)
    last, more = last_in_strips(empty, empty, 0.3 * MM)
    assert len(last) == len(more) == 0


@pytest.mark.slow
def test_a_corner_of_which_a_face_is_lost_is_refused() -> None:
    assert "refused" in outcome(238, "corner")

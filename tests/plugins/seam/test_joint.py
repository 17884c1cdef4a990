"""seam.joint: six joints in scans of a ray caster of its own, against the truth, and its refusals."""

import numpy as np
import pytest

from flangeye import CalibrationRefused, StageError
from flangeye.maths.seam_geometry import tube_radii
from flangeye.types import CAMERA, PointCloud, WorkpieceScan
from flangeye_plugins.seam.joint import JointParams, seam_joint
from tests.plugins.seam.raycast import JOINTS, MM, Plate, box, prism, scan_of
from tests.plugins.seam.scenes import BASE_T_CAMERA, hand_eye
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


@pytest.mark.parametrize("joint", JOINTS)
def test_a_plain_plate_is_no_joint(joint: str) -> None:
    plate = [prism([(-60 * MM, -10 * MM), (60 * MM, -10 * MM), (60 * MM, 0), (-60 * MM, 0)])]
    scan = scan_of("plate", 1, plates=(plate, (-60 * MM, 60 * MM)))
    with pytest.raises(
        CalibrationRefused, match=f"no {joint} joint|is known to|no gap is seen|no joint is seen"
    ):
        planned(scan, joint)


@pytest.mark.parametrize(
    ("scanned", "asked"), [("fillet", "vee"), ("vee", "lap"), ("lap", "corner")]
)
def test_another_joint_is_refused(scanned: str, asked: str) -> None:
    with pytest.raises(CalibrationRefused, match="seam.joint: "):
        planned(scan_of(scanned, 0), asked)


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
    scan = scan_of("plate", 3, 0.5 * MM, plates=disc_on_plate(), tilt=10.0)
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


def test_without_a_line_it_says_what_to_write() -> None:
    scan = WorkpieceScan(PointCloud(CAMERA, np.ones((5, 3), np.float32)), "few")
    with pytest.raises(StageError) as error:
        seam_joint(hand_eye(), scan, JointParams(joint="vee"))
    assert str(error.value) == (
        "seam.joint: knows no rough line; write line:, or put a seam step before it"
    )


def test_too_few_points_about_the_line_are_refused() -> None:
    params = JointParams.model_validate(
        {"joint": "vee", "line": [["0 mm", "0 mm", "0 mm"], ["100 mm", "0 mm", "0 mm"]]}
    )
    scan = WorkpieceScan(PointCloud(CAMERA, np.ones((5, 3), np.float32)), "few")
    with pytest.raises(StageError, match="seam.joint: 0 points are near the line; 300 are needed"):
        seam_joint(hand_eye(), scan, params)

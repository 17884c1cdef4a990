"""seam.cad: accuracy against the truth, robustness, refusals."""

import re
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import CalibrationRefused, StageError
from flangeye.maths.seam_geometry import errors_from, tube_radii
from flangeye.models.loading import load_model
from flangeye.models.workpiece import load_workpiece
from flangeye.types import CAMERA, Box, PointCloud, WorkpieceScan
from flangeye.types.geometry import rigid, rotation_from_rpy, rotation_log
from flangeye_emulators.scan import SimulatedScanParams
from flangeye_plugins.body.looks import Looks
from flangeye_plugins.seam.cad import CadParams, seam_cad
from flangeye_plugins.seam.register import Registered, register
from tests.plugins.seam.scenes import BASE_T_CAMERA, hand_eye, scanned, write_plate
from tools.workpieces import PLATES, samples

MM = 1e-3
PHOXI = load_model("scanners", "phoxi-m")
FOUND: dict[Any, Registered] = {}


@pytest.fixture(autouse=True)
def registered_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register equal scans to equal parts once: half of these tests are about what comes after."""

    def registered(points, workpiece, seam, most):
        arrays = points, workpiece.vertices, workpiece.triangles, seam.points, seam.openings
        key = *(array.tobytes() for array in arrays), seam.half_width, most
        if key not in FOUND:
            FOUND[key] = register(points, workpiece, seam, most)
        return FOUND[key]

    monkeypatch.setattr("flangeye_plugins.seam.cad.register", registered)
    monkeypatch.setattr("flangeye_plugins.seam.register.Looks", looks_of)


SEEN: dict[Any, Looks] = {}


def looks_of(vertices, triangles):
    """Prepare equal parts once."""
    key = vertices.tobytes(), triangles.tobytes()
    if key not in SEEN:
        SEEN[key] = Looks(vertices, triangles)
    return SEEN[key]


@lru_cache
def plain(workpiece="v-straight"):
    """Return the planned seam of the plain scene, made once."""
    return planned(scanned(workpiece)[0], workpiece)


def planned(scan, workpiece="v-straight", workspace=None, hand=None, **given):
    params = CadParams.model_validate({"workpiece": str(workpiece), **given})
    return seam_cad(hand or hand_eye(), scan, params, workspace, PHOXI)


@pytest.mark.parametrize(
    ("workpiece", "given"),
    [
        ("v-curved", {"seed": 3}),
        ("v-straight", {"covered": 0.4}),
        ("v-straight", {"rpy": ("15 deg", "-20 deg", "140 deg"), "seed": 2}),
    ],
)
def test_the_seam_is_where_it_is(workpiece: str, given: dict[str, Any]) -> None:
    scan, truth = scanned(workpiece, **given)
    check_planned(planned(scan, workpiece), truth)


def test_the_plain_seam_is_where_it_is() -> None:
    check_planned(plain(), scanned("v-straight")[1])


def check_planned(seam, truth):
    errors = errors_from(seam, truth)
    assert errors.max() < 0.15 * MM
    assert (errors <= tube_radii(seam)).all()
    assert tube_radii(seam).max() < 0.3 * MM
    ends = np.linalg.norm(seam.points_in_base[[0, -1]] - truth[[0, -1]], axis=1)
    assert ends.max() < 0.3 * MM
    assert seam.arc_length[-1] == pytest.approx(0.2, abs=0.005)
    assert seam.half_angle == pytest.approx(np.radians(40))
    assert seam.cloud.frame == "base"


def test_the_opening_points_at_the_torch() -> None:
    assert (plain().openings_in_base[:, 2] > 0.999).all()


def test_a_plate_that_can_slide_is_held_by_its_outline(tmp_path: Path) -> None:
    path = write_plate(tmp_path, -0.015)
    scan, truth = scanned(path)
    seam = planned(scan, path)
    ends = np.linalg.norm(seam.points_in_base[[0, -1]] - truth[[0, -1]], axis=1)
    assert ends.max() < 0.5 * MM
    assert 0.2 * MM < seam.figures["registration"] < 2 * MM  # along the seam, and it says so
    assert tube_radii(seam).max() < 0.5 * MM  # across it


def test_the_seam_moves_with_the_scene() -> None:
    """Another camera frame of the same scan gives the same seam in the base."""
    scan, _ = scanned("v-straight")
    motion = rigid(rotation_from_rpy(0.02, -0.03, 0.04), np.array([0.01, 0.02, -0.03]))
    seam = plain()
    moved = planned(scan, hand=hand_eye(error=motion))
    assert np.allclose(
        moved.points_in_base, seam.points_in_base @ motion[:3, :3].T + motion[:3, 3], atol=1e-9
    )


def test_the_hand_eye_covariance_widens_the_tube_away_from_where_it_holds() -> None:
    scan, _ = scanned("v-straight")
    seam = planned(scan, hand=hand_eye(sigma=(5e-3, 1e-7)))
    arm = np.linalg.norm(seam.points_in_base - [0.6, 0.0, 0.25], axis=1)
    wide = tube_radii(seam)
    assert wide[np.argmax(arm)] == pytest.approx(2.448 * 5e-3 * arm.max(), rel=0.2)
    assert wide[np.argmax(arm)] > 2 * wide[np.argmin(arm)] > tube_radii(plain()).min()


def refused(scan, workpiece="v-straight", error=CalibrationRefused, **given):
    with pytest.raises(error) as caught:
        planned(scan, workpiece, **given)
    return str(caught.value)


def test_a_cad_in_another_unit_is_named(tmp_path: Path) -> None:
    scan, _ = scanned("v-straight")
    path = write_plate(tmp_path, -0.015, unit="m")
    told = refused(scan, path, StageError)
    assert told.startswith(f"{path}: with unit: m the part is 239.7 m across, ")
    assert told.endswith("it would be 0.2397 m: set unit: mm")
    tiny = WorkpieceScan(PointCloud(CAMERA, 1e3 * scan.cloud.points()), "in mm")
    assert "too small for the scan, whose points are about" in refused(tiny, error=StageError)


def test_another_part_is_refused() -> None:
    scan, _ = scanned("v-straight")
    told = refused(scan, "v-curved")
    assert told.startswith(("seam.cad: poor fit: ", "seam.cad: the part is nowhere in the scan; "))
    assert told.endswith(
        "; check that the part is 'Plate with a curved V-groove' (v-curved.yaml), and in view"
    )


def test_a_part_that_is_not_there_is_refused() -> None:
    rng = np.random.default_rng(1)
    floor = np.column_stack([rng.uniform(-0.3, 0.3, (40_000, 2)), rng.normal(0.75, 1e-4, 40_000)])
    told = refused(WorkpieceScan(PointCloud(CAMERA, floor.astype(np.float32)), "floor"))
    assert told.startswith("seam.cad: ")
    assert "poor fit" in told or "nowhere in the scan" in told


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_part_that_could_lie_either_way_is_refused(tmp_path: Path, seed: int) -> None:
    path = write_plate(tmp_path, 0.0)
    told = refused(scanned(path, seed=seed)[0], path)
    assert told.startswith("seam.cad: ambiguous: the part turned by 180 deg about the CAD's z")
    away = re.search(r"its seam would be up to (\d+) mm away", told)
    assert away is not None
    assert float(away[1]) == pytest.approx(200, abs=1)  # the estimated pose's, not the drawing's


@pytest.mark.parametrize("workpiece", ["pipe-on-plate", "v-ring"])
def test_a_round_seam_is_where_it_is_however_the_part_is_turned(workpiece: str) -> None:
    """What turns a round part about its axis moves its seam along itself alone."""
    scan, truth = scanned(workpiece)
    seam = planned(scan, workpiece)
    errors = errors_from(seam, truth)
    assert (errors <= tube_radii(seam)).all()
    assert tube_radii(seam).max() < 0.6 * MM  # a pipe seen from above is held by its edges alone


@pytest.mark.parametrize("workpiece", ["v-straight", "pipe-on-plate"])
def test_the_edge_of_a_plate_is_not_the_part(workpiece: str) -> None:
    """Seen from its edge a plate fits many things: so few points do not show where it is."""
    assert refused(scanned(workpiece, seed=2)[0], "fillet").startswith("seam.cad: ")


def test_a_seam_outside_the_workspace_is_refused() -> None:
    scan, _ = scanned("v-straight")
    told = refused(scan, workspace=Box(np.array([0.6, 0.0, 0.3]), np.array([0.15, 0.3, 0.2])))
    assert told.startswith("seam.cad: the seam leaves the workspace by ")
    assert " mm along x, at (" in told


def test_limits_are_held() -> None:
    scan, _ = scanned("v-straight")
    assert "limit 0.01 mm (max_deviation)" in refused(scan, max_deviation="0.01 mm")


def test_too_small_a_scan_is_refused() -> None:
    scan = WorkpieceScan(PointCloud(CAMERA, np.ones((5, 3), np.float32)), "few")
    assert refused(scan, error=StageError) == "seam.cad: the scan has 5 points; 300 are needed"


def test_the_seam_is_chosen_by_name(tmp_path: Path) -> None:
    path = write_plate(tmp_path, -0.015)
    scan, _ = scanned("v-straight")
    told = refused(scan, path, StageError, seam="weld")
    assert told == f"seam.cad: {path} has no seam 'weld'; it has groove"
    text = path.read_text()
    seam = text[text.index("- name: groove") : text.index("source:")]
    path.write_text(text.replace("source:", seam.replace("groove", "second") + "source:"))
    told = refused(scan, path, StageError)
    assert told == f"seam.cad: {path} has the seams groove, second; say which with seam:"


@pytest.mark.parametrize("name", samples())
def test_the_shipped_workpieces_are_those_the_project_makes(name: str) -> None:
    from flangeye.files.paths import bundled

    mesh, description = samples()[name]
    path = bundled("data") / "workpieces" / f"{name}.yaml"
    assert path.read_text() == description
    read = load_workpiece(path)
    corners = mesh.vertices[mesh.triangles]
    assert np.allclose(read.vertices[read.triangles], corners, atol=1e-8)


@pytest.mark.parametrize("plate", PLATES, ids=lambda p: p.name)
def test_the_sample_workpieces_are_closed_and_face_outwards(plate: Any) -> None:
    mesh = plate.mesh()
    edges = np.concatenate([mesh.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    there = {tuple(edge) for edge in edges.tolist()}
    assert len(there) == len(edges)
    assert all((b, a) in there for a, b in there)
    corners = mesh.vertices[mesh.triangles]
    volume = np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert 0.0006 < volume * 0.2 / plate.length < 0.0007


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("plate.stl", "plate.iges"), "plate.iges: '.iges' is not CAD; known: .stl, .ply"),
        (("plate.stl", "none.stl"), "none.stl: cannot be read: No such file"),
        (
            ("-15.0, 14.0]\n", "-15.0, 140.0]\n"),
            "mm outside its CAD; both must be in one frame and one",
        ),
        (("[0, 0, 1]", "[0, 0, 0]"), "has an opening without a direction"),
    ],
)
def test_a_wrong_workpiece_file_is_refused(
    tmp_path: Path, change: tuple[Any, ...], message: str
) -> None:
    path = write_plate(tmp_path, -0.015)
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(StageError, match=message.replace("(", r"\(")):
        load_workpiece(path)


def test_a_file_without_triangles_is_no_cad(tmp_path: Path) -> None:
    path = write_plate(tmp_path, -0.015)
    (tmp_path / "plate.stl").write_bytes(b"solid nothing\nendsolid nothing\n")
    with pytest.raises(
        StageError, match=r"plate.stl: holds no triangles; is it a mesh, and is the file complete\?"
    ):
        load_workpiece(path)


@pytest.mark.slow
def test_the_registration_is_as_uncertain_as_it_says() -> None:
    """Errors of the fit against its own covariance, over scans without the scanner's distortion.

    The mean squared Mahalanobis distance of six parameters is six where the part is as far off its
    CAD as is stated; these are exactly as drawn.
    """
    squares = []
    for seed in range(8):
        scan, _ = scanned("v-curved", seed=seed, resolution=0.3, distortion=0.0)
        squares.append(squared_error(scan))
    assert 0.05 < np.mean(squares) < 6.0


def squared_error(scan):
    """Return the squared Mahalanobis distance of a fit from the truth."""
    workpiece = load_workpiece(CadParams(workpiece="v-curved").workpiece)
    points = scan.cloud.points().astype(np.float64)
    params = CadParams(workpiece="v-curved")
    fit = register(points, workpiece, workpiece.seams["groove"], params.max_residual).fit
    true = BASE_T_CAMERA.inverse().matrix @ SimulatedScanParams().base_T_part
    motion = fit.pose @ np.linalg.inv(true)
    at = fit.pose[:3, 3]
    shift = motion[:3, :3] @ at + motion[:3, 3] - at
    error = np.concatenate([rotation_log(motion[:3, :3]), shift])
    covariance = fit.covariance(params.model_error, lambda points: np.zeros((len(points), 3, 1)))
    return float(error @ np.linalg.solve(covariance, error))

"""seam.line: seams from tables, drawings and CAD, in one unit, and what it refuses."""

import numpy as np
import pytest

from flangeye import StageError
from flangeye_plugins.seam.line import LineParams, seam_line
from tests.plugins.seam.scenes import hand_eye, write_plate

MM = 1e-3


def line_of(path, unit="mm", **given):
    params = LineParams.model_validate({"path": str(path), "unit": unit, **given})
    return seam_line(hand_eye(), params)


def dxf(folder, *entities, header=""):
    """Write a drawing of (name, code, value, code, value, …) entities."""
    rows = f"0 SECTION 2 HEADER {header} 0 ENDSEC 0 SECTION 2 ENTITIES".split()
    for name, *groups in entities:
        rows += ["0", name, *map(str, groups)]
    path = folder / "part.dxf"
    path.write_text("\n".join([*rows, "0", "ENDSEC", "0", "EOF"]) + "\n")
    return path


def test_taught_points_are_a_table(tmp_path) -> None:
    path = tmp_path / "taught.csv"
    path.write_text(
        "name,x,y,z,qx,qy,qz,qw\na,500,0,100,0,0,0,1\nb,500,50,100,0,0,0,1\nc,500,100,110,0,0,0,1\n"
    )
    seam = line_of(path)
    assert np.allclose(seam.points_in_base[[0, -1]], [[0.5, 0, 0.1], [0.5, 0.1, 0.11]])
    assert np.allclose(seam.covariance[0], np.diag([9e-6] * 3))


def test_taught_poses_are_a_list(tmp_path) -> None:
    path = tmp_path / "poses.yaml"
    pose = "  - {cloud: a, position: [%s, 0, 100], quaternion_xyzw: [0, 1, 0, 0]}\n"
    path.write_text("unit: mm\nposes:\n" + pose % 500 + pose % 600)
    assert np.allclose(line_of(path).points_in_base[[0, -1], 0], [0.5, 0.6])


def test_a_drawing_is_joined_where_its_pieces_meet(tmp_path) -> None:
    arc = ("ARC", 10, 100, 20, 10, 40, 10, 50, 270, 51, 0)
    path = dxf(tmp_path, ("LINE", 10, 0, 20, 0, 11, 100, 21, 0), arc, header="9 $INSUNITS 70 4")
    seam = line_of(path, position=["0.5 m", "0 mm", "0 mm"])
    ends = {tuple(np.round(p, 6)) for p in seam.points_in_base[[0, -1]]}
    assert ends == {(0.5, 0.0, 0.0), (0.61, 0.01, 0.0)}
    assert seam.arc_length[-1] == pytest.approx(0.1 + 0.005 * np.pi, rel=1e-3)


def test_bulges_and_circles_are_round(tmp_path) -> None:
    half = ("LWPOLYLINE", 90, 2, 70, 0, 10, -20, 20, 0, 42, 1, 10, 20, 20, 0)
    seam = line_of(dxf(tmp_path, half))
    assert np.allclose(np.linalg.norm(seam.points_in_base, axis=1), 20 * MM, atol=0.02 * MM)
    assert seam.points_in_base[:, 1].min() == pytest.approx(-20 * MM, abs=0.1 * MM)  # anticlockwise
    round_ = line_of(dxf(tmp_path, ("CIRCLE", 10, 0, 20, 0, 40, 30)))
    assert np.allclose(round_.points_in_base[0], round_.points_in_base[-1], atol=1e-9)


def test_a_sharp_edge_of_a_cad_is_a_line(tmp_path) -> None:
    write_plate(tmp_path, 0.0)
    with pytest.raises(StageError, match=r"holds \d+ lines; say which with near:"):
        line_of(tmp_path / "plate.stl")
    root = line_of(tmp_path / "plate.stl", near=["0 mm", "0 mm", "14 mm"])
    assert np.allclose(root.points_in_base[:, 1:], [0.0, 14 * MM], atol=1e-6)
    assert root.arc_length[-1] == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("a.dxf", "", "holds no line"),
        ("a.dxf", "this is\nno drawing\n", "is not an ASCII DXF"),
        ("a.csv", "x,y,z\nnan,nan,nan\n1,2,3\n", "not three finite numbers"),
        ("a.csv", "", "holds no line"),
        ("a.pdf", "x", "'.pdf' holds no line; known: .csv, "),
    ],
)
def test_what_is_no_line_is_one_message(tmp_path, name, text, told) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(StageError, match=told) as error:
        line_of(tmp_path / name)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("value", ["nan", "1e999", "x"])
def test_numbers_that_are_none_are_refused(tmp_path, value) -> None:
    with pytest.raises(StageError, match="not finite|not a number"):
        line_of(dxf(tmp_path, ("LINE", 10, value, 20, 0, 11, 100, 21, 0)))


def test_a_drawing_in_another_unit_is_refused(tmp_path) -> None:
    path = dxf(tmp_path, ("LINE", 10, 0, 20, 0, 11, 1, 21, 0), header="9 $INSUNITS 70 1")
    with pytest.raises(
        StageError, match=r"states the unit in \(\$INSUNITS\), the recipe states unit: mm"
    ):
        line_of(path)


def test_a_drawing_that_is_too_large_is_refused(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("flangeye.files.drawings.MOST_PIECES", 3)
    with pytest.raises(StageError, match="holds more than 3 line segments; keep the seam only"):
        line_of(dxf(tmp_path, ("CIRCLE", 10, 0, 20, 0, 40, 30)))

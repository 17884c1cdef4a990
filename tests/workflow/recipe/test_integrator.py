"""An integrator's way: scans and a robot's table to a ROS launch file, in three commands."""

import csv
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from flangeye.cli import commands
from flangeye.files.clouds import read_cloud
from tests.conftest import Call

SAMPLE = Path(__file__).parents[3] / "data" / "samples" / "ur5_phoxi-m"


def vectors(turn: Rotation) -> list[float]:
    """Return a rotation vector [deg]."""
    return np.degrees(turn.as_rotvec()).tolist()


def kuka(turn: Rotation) -> list[float]:
    """Return A, B, C [deg]."""
    return turn.as_euler("ZYX", degrees=True).tolist()


def fixed(turn: Rotation) -> list[float]:
    """Return roll, pitch, yaw [deg]."""
    return turn.as_euler("xyz", degrees=True).tolist()


def record(
    folder: Path,
    heading: str,
    angles: Callable[[Rotation], list[float]],
    scan: str,
    numbers: Sequence[int] = range(9, 33, 3),
) -> None:
    """Write the sample's scans as PLY and its poses as a robot's table in mm and degrees."""
    (folder / scan).parent.mkdir(parents=True)
    separator = ";" if ";" in heading else ","
    lines = [heading]
    for k, row in enumerate(csv.DictReader((SAMPLE / "poses.csv").read_text().splitlines())):
        turn = Rotation.from_quat([float(row[f"q{axis}"]) for axis in "xyzw"])
        place = [1e3 * float(row[f"{axis}_m"]) for axis in "xyz"]
        names = {"name": [f"p{k}"], "file": [f"p{k}.ply"]}
        name = names.get(heading[:4], [])
        lines.append(separator.join([*name, *(f"{x:.6f}" for x in (*place, *angles(turn)))]))
        write_ply(folder / scan.format(number=numbers[k]), SAMPLE / row["cloud"])
    (folder / "robot.csv").write_text("\n".join(lines) + "\n")


def write_ply(path: Path, source: Path) -> None:
    """Write a cloud as a binary PLY of doubles."""
    points = np.asarray(read_cloud(source).points(), dtype="<f8")
    head = "".join(f"property double {axis}\n" for axis in "xyz")
    text = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{head}end_header\n"
    path.write_bytes(text.encode() + points.tobytes())


@pytest.mark.parametrize(
    ("heading", "angles", "scan", "guessed"),
    [
        (
            "x,y,z,rx,ry,rz",
            vectors,
            "scan_{number:02d}.ply",
            "vector (rotations of arm and target agree",
        ),
        (
            "x,y,z,rx,ry,rz",
            fixed,
            "scan_{number:02d}.ply",
            "xyz (rotations of arm and target agree",
        ),
        ("X;Y;Z;A;B;C", kuka, "scans/part_{number}.ply", "kuka (--rotation changes it)"),
        ("name,x,y,z,a,b,c", kuka, "frame_{number}.ply", "no number in common"),
        ("file,x,y,z,a,b,c", kuka, "frame_{number}.ply", "no number in common"),
    ],
    ids=[
        "vector-in-degrees",
        "roll-pitch-yaw",
        "kuka-semicolons-subfolder",
        "other-names",
        "other-files",
    ],
)
def test_three_commands_lead_to_a_launch_file(
    heading: str, angles: Any, scan: str, guessed: str,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Call,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "cell", heading, angles, scan)

    words = ["--robot", "ur5", "--scanner", "phoxi-m", "--yes", "--out", "cell.yaml"]
    code, said, err = command("init", "cell", *words)
    assert code == 0, err
    assert guessed in said
    assert re.search("paired in order: (row 1|p0) with", said)
    for assumed in (
        "direction of the arm's poses",
        "what the scans show",
        "where the camera is mounted",
    ):
        assert f"assumed: {assumed}" in said

    code, said, err = command("run", "cell.yaml", "--out", "first")
    assert code == 0, said + err
    assert "VERIFIED   8 of 8 captures used" in said
    use = re.search(r"Use it +(flangeye export first --to ros2_launch)", said)
    assert use

    code, said, err = command(*use[1].split()[1:])
    assert code == 0, err
    launch = (tmp_path / "first" / "exports" / "camera.launch.py").read_text()
    x = float(re.findall(r"--x[\"', ]+(-?[\d.]+)", launch)[0])
    assert x == pytest.approx(0.6, abs=2e-3)  # where the simulator had the camera


@pytest.mark.parametrize(
    ("heading", "angles", "shown"),
    [
        ("x,y,z,rx,ry,rz", fixed, "[xyz]"),
        ("x,y,z,rx,ry,rz", vectors, "[vector]"),
        ("X;Y;Z;A;B;C", kuka, "[kuka]"),
    ],
    ids=["roll-pitch-yaw", "vector-in-degrees", "kuka"],
)
def test_a_person_is_offered_what_the_scans_decide(
    heading: str, angles: Any, shown: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "cell", heading, angles, "scan_{number:02d}.ply")
    words = ["init", "cell", "--robot", "ur5", "--scanner", "phoxi-m", "--out", "cell.yaml"]
    done = CliRunner().invoke(commands(), words, input="\n" * 8)
    assert done.exit_code == 0, done.output
    assert f"(--rotation) {shown}" in " ".join(done.output.split())
    assert f"rotation: {shown[1:-1]}" in Path("cell.yaml").read_text()


def test_a_wrong_convention_is_refused_with_the_right_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Call
) -> None:
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "cell", "x,y,z,rx,ry,rz", fixed, "scan_{number:02d}.ply")
    words = ["--robot", "ur5", "--scanner", "phoxi-m", "--yes", "--out", "cell.yaml"]
    assert command("init", "cell", "--rotation", "vector", *words)[0] == 0
    code, said, _ = command("run", "cell.yaml", "--out", "first")
    assert code == 1
    read = "the robot's rotations were read as a rotation vector in degrees, and fit as roll, pitch"
    assert read in " ".join(said.split())
    assert "rotation: xyz" in said


def test_scans_paired_in_a_wrong_order_are_refused_with_the_shift(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Call
) -> None:
    monkeypatch.chdir(tmp_path)
    shifted = [102, 103, 104, 105, 106, 107, 108, 101]
    record(tmp_path / "cell", "name,x,y,z,a,b,c", kuka, "frame_{number}.ply", shifted)
    words = ["--robot", "ur5", "--scanner", "phoxi-m", "--yes", "--out", "cell.yaml"]
    code, said, err = command("init", "cell", *words)
    assert code == 0, err
    assert "warning: poses and scans have no number in common" in said
    code, said, err = command("run", "cell.yaml", "--out", "first")
    assert code == 1
    assert "warning: poses and scans have no number in common" in said + err
    assert "each scan belongs to the pose 1 earlier" in said and "shift: -1" in said


@pytest.mark.parametrize("table", [None, "X,Y,Z,A,B,C\n1,2,3,4,5,6\n"])
def test_a_folder_without_its_poses_names_init(
    table: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Call
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cell").mkdir()
    (tmp_path / "cell" / "a.ply").write_text("")
    if table:
        (tmp_path / "cell" / "poses.csv").write_text(table)
    code, _, err = command("run", "ur5_phoxi-m_sample", "--archive", "cell", "--out", "first")
    assert code == 2
    assert "flangeye init" in err

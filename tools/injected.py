"""Test the detection of faults in recordings: python -m tools.injected [--seed N] [FAULT …]

Two sets of marker poses of a correct arm come from the generator of tests/estimation/foreign.py:
with the marker on the flange, and with the camera on it. Each set is written as two tables with one
fault, run, examined by ``flangeye doctor``, and run again with the line that the doctor prints. A
pose is right if it maps the observations to within 1 mm rms of the true pose.
"""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
import yaml
from scipy.spatial.transform import Rotation

from flangeye.cli import commands
from flangeye.cli.console import report_errors
from flangeye.types.geometry import rigid
from tests.estimation import foreign

POSES, ARM, RIGHT = 24, 0.1e-3, 1e-3
"""Of a session; the arm's joint zeros [rad]; what is right [m]."""


class Rows(NamedTuple):
    """Two tables as written, and their notation as stated in the recipe."""

    arm: np.ndarray
    marker: np.ndarray
    rotations: tuple[str, str] = ("xyzw", "xyzw")
    pose: str = "base_T_flange"
    mounting: str = ""


Fault = Callable[[np.ndarray, np.ndarray], Rows]


def written(poses: np.ndarray, how: str = "xyzw") -> np.ndarray:
    """Return (N, 6 or 7) places [m] and rotations as numbers, by a convention of the tables."""
    turns = Rotation.from_matrix(poses[:, :3, :3])
    numbers = {
        "xyzw": turns.as_quat,
        "wxyz": lambda: turns.as_quat()[:, [3, 0, 1, 2]],
        "vector": turns.as_rotvec,
        "degrees": lambda: turns.as_euler("xyz", degrees=True),
    }.get(how, lambda: turns.as_euler(how))()
    return np.hstack([poses[:, :3, 3], numbers])


def plain(arm: np.ndarray, marker: np.ndarray) -> Rows:
    """Return both tables as the recipe states."""
    return Rows(written(arm), written(marker))


def read_as(who: int, how: str, said: str) -> Fault:
    """Return a fault: a table's rotations are written in another convention than stated."""

    def fault(arm: np.ndarray, marker: np.ndarray) -> Rows:
        rows, names = [written(arm), written(marker)], ["xyzw", "xyzw"]
        rows[who], names[who] = written((arm, marker)[who], how), said
        return Rows(rows[0], rows[1], (names[0], names[1]))

    return fault


def seen(change: Callable[[np.ndarray], Any]) -> Fault:
    """Return the fault that markers' poses are changed in place."""

    def fault(arm: np.ndarray, marker: np.ndarray) -> Rows:
        changed = marker.copy()
        given = change(changed)
        return plain(arm, changed if given is None else given)

    return fault


def _by_six_degrees(poses: np.ndarray) -> None:
    off = np.random.default_rng(0).normal(0, np.radians(6) / np.sqrt(3), (len(poses), 3))
    poses[:, :3, :3] = Rotation.from_rotvec(off).as_matrix() @ poses[:, :3, :3]


def _times(by: float) -> Fault:
    def change(poses: np.ndarray) -> None:
        poses[:, :3, 3] *= by

    return seen(change)


def _moved(poses: np.ndarray) -> None:
    poses[len(poses) // 2 :, :3, 3] += [0.003, -0.004, 0.0]


def _swapped(poses: np.ndarray) -> None:
    poses[[7, 8]] = poses[[8, 7]]


def _mirrored(poses: np.ndarray) -> None:
    poses[:, 1, 3] *= -1


def _left_handed(poses: np.ndarray) -> np.ndarray:
    """Write poses in a frame whose y points the other way."""
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    return np.asarray(flip @ poses @ flip)


def _exchanged_axes(poses: np.ndarray) -> np.ndarray:
    poses = poses.copy()
    poses[:, [0, 1], 3] = poses[:, [1, 0], 3]
    return poses


def _other_axes(turn: np.ndarray) -> Fault:
    """Return the fault that the camera's frame has other axes than x right, y down, z forward."""
    return seen(lambda poses: rigid(turn, np.zeros(3)) @ poses)


def _deeper(poses: np.ndarray) -> None:
    poses[:, 2, 3] *= 1.02


def _half_in_mm(arm: np.ndarray, marker: np.ndarray) -> Rows:
    changed = arm.copy()
    changed[len(arm) // 2 :, :3, 3] *= 1000
    return plain(changed, marker)


def _shuffled(poses: np.ndarray) -> np.ndarray:
    return poses[np.random.default_rng(3).permutation(len(poses))]


def _quarter_turns(poses: np.ndarray) -> None:
    turn = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    poses[1::4, :3, :3] = poses[1::4, :3, :3] @ turn


def _wrong_sign(arm: np.ndarray, marker: np.ndarray) -> Rows:
    rows = plain(arm, marker)._replace(arm=written(arm, "xyz"), rotations=("xyz rad", "xyzw"))
    rows.arm[:, 5] *= -1
    return rows


def _in_the_tool(arm: np.ndarray, marker: np.ndarray) -> Rows:
    """Give positions of the base in the flange beside rotations of the flange in the base."""
    mixed = arm.copy()
    mixed[:, :3, 3] = np.linalg.inv(arm)[:, :3, 3]
    return plain(mixed, marker)


def _frozen(arm: np.ndarray, marker: np.ndarray) -> Rows:
    stale = arm.copy()
    stale[10:14] = stale[10]
    return plain(stale, marker)


def _wrong_mounting(arm: np.ndarray, marker: np.ndarray) -> Rows:
    return plain(arm, marker)._replace(mounting="other")


FAULTS: dict[str, Fault] = {
    "none": plain,
    "both inverted": lambda a, m: plain(np.linalg.inv(a), np.linalg.inv(m)),
    "robot inverted": lambda a, m: plain(np.linalg.inv(a), m),
    "marker inverted": lambda a, m: plain(a, np.linalg.inv(m)),
    "marker's angles off by 6 deg": seen(_by_six_degrees),
    "robot's degrees as radians": read_as(0, "degrees", "xyz rad"),
    "marker's degrees as radians": read_as(1, "degrees", "xyz rad"),
    "robot's radians as degrees": read_as(0, "xyz", "xyz deg"),
    "robot's vector as rpy": read_as(0, "vector", "xyz rad"),
    "robot's rpy as vector": read_as(0, "xyz", "vector rad"),
    "marker's vector as rpy": read_as(1, "vector", "xyz rad"),
    "marker's rpy as vector": read_as(1, "xyz", "vector rad"),
    "robot's wxyz as xyzw": read_as(0, "wxyz", "xyzw"),
    "robot's zyx as xyz": read_as(0, "zyx", "xyz rad"),
    "moved 5 mm half way": seen(_moved),
    "two rows swapped": seen(_swapped),
    "rows shifted by one": seen(lambda m: np.roll(m, 1, axis=0)),
    "robot stale": _frozen,
    "wrong mounting": _wrong_mounting,
    "marker's size + 10 %": _times(1.1),
    "marker's size + 1 %": _times(1.01),
    "marker's size + 0.3 %": _times(1.003),
    "marker in mm": _times(1000.0),
    "marker's y negated": seen(_mirrored),
    "robot transposed": lambda a, m: plain(_transposed(a), m),
    "marker transposed": lambda a, m: plain(a, _transposed(m)),
    "both transposed": lambda a, m: plain(_transposed(a), _transposed(m)),
    "tables exchanged": lambda a, m: plain(m, a),
    "exchanged and inverted": lambda a, m: plain(np.linalg.inv(m), np.linalg.inv(a)),
    "robot exchanged, wrong mounting": lambda a, m: _wrong_mounting(m, a),
    "robot inverted, wrong mounting": lambda a, m: _wrong_mounting(np.linalg.inv(a), m),
    "marker inverted, wrong mounting": lambda a, m: _wrong_mounting(a, np.linalg.inv(m)),
    "both inverted, wrong mounting": lambda a, m: _wrong_mounting(
        np.linalg.inv(a), np.linalg.inv(m)
    ),
    "camera's axes as OpenGL has them": _other_axes(np.diag([1.0, -1.0, -1.0])),
    "camera's axes as ROS bodies have them": _other_axes(
        np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    ),
    "robot left-handed": lambda a, m: plain(_left_handed(a), m),
    "marker left-handed": seen(_left_handed),
    "robot's x and y exchanged": lambda a, m: plain(_exchanged_axes(a), m),
    "marker's x and y exchanged": seen(_exchanged_axes),
    "robot's position in the tool": _in_the_tool,
    "robot's third angle negated": _wrong_sign,
    "robot in mm": lambda a, m: plain(_scaled(a, 1000.0), m),
    "both in mm": lambda a, m: plain(_scaled(a, 1000.0), _scaled(m, 1000.0)),
    "both in inches": lambda a, m: plain(_scaled(a, 1 / 0.0254), _scaled(m, 1 / 0.0254)),
    "robot in mm from half way": _half_in_mm,
    "marker's depth + 2 %": seen(_deeper),
    "rows shuffled": seen(_shuffled),
    "rows reversed": seen(lambda m: m[::-1]),
    "quarter turns of the marker": seen(_quarter_turns),
}


def _scaled(poses: np.ndarray, by: float) -> np.ndarray:
    out = poses.copy()
    out[:, :3, 3] *= by
    return out


def _transposed(poses: np.ndarray) -> np.ndarray:
    out = poses.copy()
    out[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return out


def recipe_of(rows: Rows, in_hand: bool) -> str:
    """Return the recipe that reads the tables in its own folder."""
    columns = [list(range(1, table.shape[1] + 1)) for table in (rows.arm, rows.marker)]
    about = [
        {"file": f"{name}.txt", "length": "m", "columns": each}
        | dict(zip(("rotation", "angle"), how.split(), strict=False))
        for name, each, how in zip(("arm", "marker"), columns, rows.rotations, strict=True)
    ]
    reader = {**about[0], "pose": rows.pose, "target": about[1]}
    name = "eye-in-hand" if in_hand != (rows.mounting == "other") else "eye-on-base"
    step = yaml.safe_dump({"path": ".", "reader": {"table": reader}}, default_flow_style=True)
    return (
        f"title: Samples\nrobot: {{model: ur5e}}\nconfiguration: {{name: {name}, place: unknown}}\n"
        f"steps:\n- acquire.samples: {' '.join(step.split())}\n- solve.robust\n"
        "- verify.holdout: {max_rms: 1 mm}\n"
    )


class Ran(NamedTuple):
    """Outcome of a run: status, error of its pose [m], and named mistake."""

    status: str
    error: float
    named: str


def run(recipe: Path, session: foreign.Session) -> Ran:
    """Run a recipe and compare its pose with the true one."""
    out = recipe.parent / f"out_{recipe.stem}"
    done = _flangeye("run", recipe, "--out", out)
    told = [x for x in done.stdout.splitlines() if x.startswith(("What is wrong", "or   ", "Next"))]
    if not (out / "result.json").exists():
        return Ran(f"error: {(done.stderr.strip() or '?').splitlines()[-1][-160:]}", np.nan, "")
    result = json.loads((out / "result.json").read_text())
    found = [x["matrix"] for name, x in result["transforms"].items() if name.endswith("_T_camera")]
    return Ran(result["status"], _error(np.array(found), session), " ".join(told)[:90])


def _error(found: np.ndarray, s: foreign.Session) -> float:
    if not len(found):
        return float("nan")
    points = s.seen[:, :3, 3]
    first, second = (points @ x[:3, :3].T + x[:3, 3] for x in (found[0], s.camera))
    return float(np.sqrt(((first - second) ** 2).sum(axis=1).mean()))


class Said(NamedTuple):
    """Output of a command."""

    stdout: str
    stderr: str


def doctored(recipe: Path) -> tuple[str, Path | None]:
    """Return the doctor's first finding, and the recipe with its last line inserted."""
    done = _flangeye("doctor", recipe, "--json")
    if not done.stdout.startswith("{"):
        return f"error: {done.stderr.strip().splitlines()[-1][-160:]}", None
    findings = json.loads(done.stdout)["findings"]
    if not findings:
        return "nothing", None
    name = "; ".join(finding["name"] for finding in findings)
    fixes = [finding["fix"].partition("  # or, if")[0] for finding in findings]
    kinds = ("- acquire", "configuration:")
    pasted = {kind: fix for fix in fixes for kind in kinds if fix.startswith(kind)}
    if not pasted:
        return name, None
    file = recipe.with_name("pasted.yaml")
    lines = [
        next((pasted[kind] for kind in pasted if old.startswith(kind)), old)
        for old in recipe.read_text().splitlines()
    ]
    file.write_text("\n".join(lines))
    return name, file


def _flangeye(*words: object) -> Said:
    """Run a command in this process, which saves importing the modules each time."""
    said, why = io.StringIO(), io.StringIO()
    with redirect_stdout(said), redirect_stderr(why), suppress(SystemExit):
        report_errors(lambda: commands()(list(map(str, words))))
    return Said(said.getvalue(), why.getvalue())


def table(faults: Annotated[list[str] | None, typer.Argument()] = None, seed: int = 0) -> None:
    """Print a row for each fault and set."""
    print("| fault | camera | run | its error [mm] | named by the run | doctor | pasted |")
    print("|---|---|---|---|---|---|---|")
    for name in faults or FAULTS:
        for kind in ("marker", "hand"):
            print(row(name, kind, seed), flush=True)


def row(name: str, kind: str, seed: int) -> str:
    """Return a row of the table."""
    session = foreign.session(kind, foreign.UR5E, ARM, POSES, seed)
    rows = FAULTS[name](session.reported, session.seen)
    with tempfile.TemporaryDirectory() as folder:
        recipe = Path(folder) / "recipe.yaml"
        np.savetxt(recipe.with_name("arm.txt"), rows.arm)
        np.savetxt(recipe.with_name("marker.txt"), rows.marker)
        recipe.write_text(recipe_of(rows, session.in_hand))
        ran = run(recipe, session)
        finding, pasted = doctored(recipe)
        cured = run(pasted, session) if pasted else None
    told = f"{ran.status} | {1e3 * ran.error:.2f} | {ran.named}"
    after = f"{cured.status} {1e3 * cured.error:.2f}" if cured else "–"
    return (
        f"| {name} | {'in hand' if session.in_hand else 'fixed'} | {told} | {finding} | {after} |"
    )


if __name__ == "__main__":
    typer.run(table)

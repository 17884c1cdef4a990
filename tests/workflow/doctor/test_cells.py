"""The doctor on cells: each mistake put into a sound session with a bad arm, named and mended."""

import csv
import re
import shutil
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from flangeye.cli import commands
from flangeye.files.paths import bundled
from flangeye.plugin.registry import load_registry
from flangeye.types.geometry import invert, rigid, rotation_exp
from flangeye.workflow.doctor import opening
from flangeye.workflow.doctor.diagnosis import Finding
from flangeye.workflow.recipe.load import load_recipe

REGISTRY = load_registry()
PLACE, TURN = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
Fault = Callable[[Path], None]


def simulated(name: str, seed: int = 0, arm: str = "quality: real") -> Path:
    path = bundled("recipes") / "configurations" / f"{name}_marker_most-likely_simulated.yaml"
    assert path.exists()
    folder = Path(mkdtemp())
    given = ["--set", f"seed={seed}", "--set", f"steps.0.arm={{{arm}}}", "--out"]
    result = CliRunner().invoke(commands(), ["run", str(path), *given, str(folder / "run")])
    assert result.exit_code in (0, 1), result.output  # an arm so bad may exceed the recipe's limit
    return folder / "run"


@cache
def tables(name: str, seed: int = 0) -> Path:
    """Return a folder with the tables of a simulated session, and the recipe that reads them."""
    run = simulated(name, seed)
    out = run.with_name("tables")
    given = ["export", str(run), "--to", "tables", "--out", str(out)]
    assert CliRunner().invoke(commands(), given).exit_code == 0
    return out


def examined(folder: Path) -> Sequence[Finding]:
    recipe = load_recipe(folder / "recipe.yaml", REGISTRY)
    return opening.examined(folder, REGISTRY, recipe).findings


def pasted(folder: Path, finding: Finding) -> None:
    """Replace in the recipe what the line that mends a finding begins with."""
    recipe = folder / "recipe.yaml"
    data = yaml.safe_load(recipe.read_text().replace("'on':", '"on":'))
    (line,) = finding.lines
    ((name, value),) = line.items()
    if name in data:
        data[name] = value
    else:
        assert name in data["steps"][0]
        data["steps"][0] = {name: value}
    recipe.write_text(yaml.safe_dump(data))


def rewritten(table: str, columns: Sequence[str], change: Callable[..., Iterable[float]]) -> Fault:
    """Return the fault that columns of a table hold something else."""

    def fault(folder: Path) -> None:
        with (folder / table).open() as file:
            rows = list(csv.DictReader(file))
        for row in rows:
            values = change(np.array([float(row[column]) for column in columns]))
            row.update({c: repr(float(v)) for c, v in zip(columns, values, strict=True)})
        with (folder / table).open("w") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)

    return fault


def inverse(row: np.ndarray) -> np.ndarray:
    turn = Rotation.from_quat(row[3:]).inv()
    return np.concatenate([-turn.apply(row[:3]), turn.as_quat()])


def both(*faults: Fault) -> Fault:
    def fault(folder: Path) -> None:
        for each in faults:
            each(folder)

    return fault


def in_recipe(before: str, after: str) -> Fault:
    """Return the fault that the recipe says something else."""

    def fault(folder: Path) -> None:
        recipe = folder / "recipe.yaml"
        text, count = re.subn(before, after, recipe.read_text())
        assert count == 1
        recipe.write_text(text)

    return fault


def a_row_elsewhere(table: str) -> Fault:
    def fault(folder: Path) -> None:
        lines = (folder / table).read_text().splitlines()
        lines[4] = ",".join([lines[4].split(",")[0], *lines[9].split(",")[1:]])
        (folder / table).write_text("\n".join(lines))

    return fault


WHOLE = (*PLACE, *TURN)
first, second, arm = "first_marker.csv", "second_marker.csv", "arm.csv"
FAULTS = {
    "inverted marker": (
        rewritten(first, WHOLE, inverse),
        "what first saw of marker are poses target_T_camera, not camera_T_target",
    ),
    "both inverted": (
        both(rewritten(first, WHOLE, inverse), rewritten(second, WHOLE, inverse)),
        "what all cameras saw are poses target_T_camera, not camera_T_target",
    ),
    "marker in mm": (
        rewritten(first, PLACE, lambda p: 1e3 * p),
        "what first saw of marker is in mm",
    ),
    "marker's quaternion": (
        rewritten(first, TURN, lambda q: q[[3, 0, 1, 2]]),
        "the rotations of what first saw of marker were read as a quaternion x, y, z, w, and fit "
        "as a quaternion w, x, y, z",
    ),
    "arm's quaternion": (
        rewritten(arm, TURN, lambda q: q[[3, 0, 1, 2]]),
        "the rotations of the poses of arm were read as a quaternion x, y, z, w, and fit as a "
        "quaternion w, x, y, z",
    ),
    "rail in mm": (
        rewritten("rail.csv", ["value"], lambda x: 1e3 * x),
        "the values of rail are in mm",
    ),
    "rail reversed": (
        rewritten("rail.csv", ["value"], lambda x: -x),
        "rail moves against the axis that the recipe states",
    ),
    "stated inverse": (
        in_recipe("file: second_marker.csv", r"\g<0>\n          pose: target_T_camera"),
        "what second saw of marker are poses camera_T_target, not target_T_camera",
    ),
    "stands elsewhere": (
        in_recipe("second: base", "second: rail"),
        "second is mounted on base, not on rail",
    ),
    "a row elsewhere": (
        a_row_elsewhere(first),
        "1 of 50 sightings do not fit their poses; the others agree without them",
    ),
}


BRIEF = ("both inverted", "rail in mm", "a row elsewhere")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in BRIEF else pytest.mark.slow) for n in FAULTS]
)
def test_each_mistake_is_named_and_its_line_pasted_cures_it(name: str, tmp_path: Path) -> None:
    folder = shutil.copytree(tables("arm-on-rail"), tmp_path / "session")
    fault, what = FAULTS[name]
    fault(folder)
    (finding,) = examined(folder)
    assert finding.what == what
    pasted(folder, finding)
    assert examined(folder) == ()


def test_a_sound_session_has_no_finding() -> None:
    assert examined(tables("arm-on-rail")) == ()


def test_a_run_names_the_mistake_and_its_line_pasted_is_verified(tmp_path: Path) -> None:
    folder = shutil.copytree(tables("arm-on-rail"), tmp_path / "session")
    FAULTS["rail reversed"][0](folder)
    run = ["run", str(folder / "recipe.yaml"), "--out"]
    refused = CliRunner().invoke(commands(), [*run, str(tmp_path / "refused")])
    assert refused.exit_code == 1
    assert FAULTS["rail reversed"][1] in " ".join(refused.output.split())
    (finding,) = examined(folder)
    pasted(folder, finding)
    cured = CliRunner().invoke(commands(), [*run, str(tmp_path / "cured")])
    assert cured.exit_code == 0, cured.output
    assert "VERIFIED (simulated)" in cured.output


def centres_of_a_table(folder: Path) -> Path:
    """Write centres of the flange that two scanners beside an arm saw, as tables have them."""
    rng = np.random.default_rng(0)
    poses = [
        rigid(rotation_exp(rng.normal(0, 0.4, 3)), [0.5, 0.0, 0.3] + rng.uniform(-0.2, 0.2, 3))
        for _ in range(12)
    ]
    for name in ("left", "right"):
        stands = rigid(rotation_exp(rng.normal(0, 0.5, 3)), np.array([0.5, 0.0, -0.6]))
        seen = [(invert(stands) @ pose)[:3, 3] + rng.normal(0, 1e-4, 3) for pose in poses]
        np.savetxt(folder / f"{name}.csv", seen, delimiter=",", header="x,y,z", comments="")
    rows = [[*p[:3, 3], *Rotation.from_matrix(p[:3, :3]).as_quat()] for p in poses]
    np.savetxt(folder / arm, rows, delimiter=",", header=",".join(WHOLE), comments="")
    table = {"file": arm, "rotation": "xyzw", "length": "m"}
    sightings = [
        {"camera": n, "target": "flange", "file": f"{n}.csv", "rotation": "point", "length": "m"}
        for n in ("left", "right")
    ]
    reader = {"cell": {"arms": {"arm": table}, "sightings": sightings}}
    recipe = {
        "title": "two scanners",
        "cell": {
            "arms": {"arm": {"model": "ur5"}},
            "cameras": {"left": "base", "right": "base"},
            "targets": {"flange": {"on": "arm", "place": "known"}},
        },
        "steps": [{"acquire.centres": {"path": ".", "reader": reader}}, "solve.robust"],
    }
    (folder / "recipe.yaml").write_text(yaml.safe_dump(recipe))
    return folder


def test_centres_of_a_table_in_another_unit_are_named(tmp_path: Path) -> None:
    folder = centres_of_a_table(tmp_path)
    assert examined(folder) == ()
    rewritten("left.csv", PLACE, lambda p: 1e3 * p)(folder)
    (finding,) = examined(folder)
    assert finding.what == "what left saw of flange is in mm"
    pasted(folder, finding)
    assert examined(folder) == ()


@pytest.mark.parametrize("link", [pytest.param(None, marks=pytest.mark.slow), 2])
def test_a_camera_on_another_link_is_named(link: int | None, tmp_path: Path) -> None:
    folder = shutil.copytree(tables("forearm-and-wall"), tmp_path / "session")
    in_recipe(r"\n +link: 3\n", f"\n      link: {link}\n" if link else "\n")(folder)
    (finding,) = examined(folder)
    assert (
        finding.what
        == f"forearm is mounted on arm_link3, not on arm{f'_link{link}' if link else ''}"
    )
    pasted(folder, finding)
    assert examined(folder) == ()


def test_nothing_is_named_in_a_sound_session_of_a_bad_arm() -> None:
    assert not examined(tables("two-scanners", seed=1))


def test_nothing_is_named_where_no_cure_helps(tmp_path: Path) -> None:
    folder = shutil.copytree(tables("two-scanners"), tmp_path / "session")
    rng = np.random.default_rng(0)
    for table in ("left_marker.csv", "right_marker.csv"):
        few = (folder / table).read_text().splitlines()[:11]
        (folder / table).write_text("\n".join(few))
        rewritten(
            table, WHOLE, lambda _: [*rng.normal(size=3), *Rotation.random(rng=rng).as_quat()]
        )(folder)
    assert not examined(folder)


def test_the_command_examines_the_log_of_a_cell(tmp_path: Path) -> None:
    told = CliRunner().invoke(commands(), ["doctor", str(tables("two-scanners").with_name("run"))])
    assert told.exit_code == 0, told.output
    assert "40 of 40 samples" in told.output
    assert "nothing found" in told.output


def arms_exchanged(folder: Path) -> None:
    one, two = (folder / f"{name}.csv" for name in ("one", "two"))
    texts = one.read_text(), two.read_text()
    one.write_text(texts[1])
    two.write_text(texts[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "cell", ["hand-and-wall", "arm-on-rail", "two-arms-three-scanners", "forearm-and-wall"]
)
@pytest.mark.parametrize("seed", range(2))
def test_mistakes_are_named_in_every_cell(cell: str, seed: int, tmp_path: Path) -> None:
    sound = tables(cell, seed)
    assert examined(sound) == ()
    table = min(sound.glob("*_marker*.csv")).name
    wanted: dict[str, tuple[Fault, str]] = {
        "inverted": (rewritten(table, WHOLE, inverse), "inverted marker"),
        "millimetres": (rewritten(table, PLACE, lambda p: 1e3 * p), "unit"),
        "quaternion": (rewritten(table, TURN, lambda q: q[[3, 0, 1, 2]]), "pose convention"),
        "row": (a_row_elsewhere(table), "mis-paired pose"),
    }
    if cell == "two-arms-three-scanners":
        wanted["exchanged"] = arms_exchanged, "swapped arms"
    for name, (fault, mistake) in wanted.items():
        folder = shutil.copytree(sound, tmp_path / name)
        fault(folder)
        (finding,) = examined(folder)
        assert finding.name == mistake, name
        pasted(folder, finding)
        assert examined(folder) == (), name

"""``flangeye export`` and export steps: what is written where, and what is refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye_plugins.export import EXPORTS
from tests.conftest import TOY_RECIPE
from tests.crafted import rewritten

REFUSED = TOY_RECIPE.replace("max_rms: 2 mm", "max_rms: 0.001 mm")


@pytest.fixture
def exporting(flangeye: Any, toy_registry: Any, tmp_path: Path) -> Any:
    """Run a recipe into ``here`` with exports on offer; return the command line."""
    for stage in EXPORTS:
        toy_registry.stages[stage.name] = stage

    def ran(text):
        (tmp_path / "toy.yaml").write_text(text)
        return flangeye("run", "toy.yaml", "--out", "here")

    flangeye.ran = ran
    return flangeye


def test_an_export_is_written_into_the_runs_folder(exporting: Any, tmp_path: Path) -> None:
    assert exporting.ran(TOY_RECIPE)[0] == 0
    code, out, err = exporting("export", "here", "--to", "matrix", "--set", "length=mm")
    assert (code, out, err) == (0, "here/exports/camera.txt: numpy.loadtxt reads it\n", "")
    result = json.loads((tmp_path / "here" / "result.json").read_text())
    wanted = np.array(result["transforms"]["base_T_camera"]["matrix"])
    found = np.loadtxt(tmp_path / "here" / "exports" / "camera.txt")
    assert np.allclose(found[:3, :3], wanted[:3, :3], atol=1e-8)
    assert np.allclose(found[:3, 3], 1e3 * wanted[:3, 3], atol=1e-8)


def test_an_export_is_printed_or_written_elsewhere(exporting: Any, tmp_path: Path) -> None:
    exporting.ran(TOY_RECIPE)
    log = "here/run.mcap"
    code, out, _ = exporting("export", log, "--to", "kuka", "--set", "number=7", "--out", "-")
    assert code == 0
    assert out.startswith("; flangeye: base_T_camera, maps camera to base; verified\n; recipe toy,")
    assert "BASE_DATA[7]={X " in out
    assert exporting("export", log, "--to", "kuka", "--out", "else/b.dat")[0] == 0
    assert "BASE_DATA[1]={X " in (tmp_path / "else" / "b.dat").read_text()


def test_no_export_replaces_the_log_of_a_run(exporting: Any, tmp_path: Path) -> None:
    assert exporting.ran(TOY_RECIPE)[0] == 0
    recorded = (tmp_path / "here" / "run.mcap").read_bytes()
    code, out, err = exporting("export", "here", "--to", "matrix", "--out", "here/run.mcap")
    assert (code, out) == (2, "")
    assert err == (
        "error: here/run.mcap: is the log of a run, which is never replaced; name another file\n"
    )
    assert (tmp_path / "here" / "run.mcap").read_bytes() == recorded


def test_a_refused_calibration_is_not_exported(exporting: Any, tmp_path: Path) -> None:
    assert exporting.ran(REFUSED + "  - export.zivid\n")[0] == 1
    assert not (tmp_path / "here" / "exports").exists()
    code, out, err = exporting("export", "here", "--to", "zivid")
    assert (code, out) == (1, "")
    assert err.startswith("error: the calibration was refused, so nothing is exported: verify.toy:")
    assert err.endswith("; --anyway writes it all the same, and says so in the file\n")
    assert not (tmp_path / "here" / "exports").exists()


def test_a_refused_calibration_says_so_in_the_file(exporting: Any, tmp_path: Path) -> None:
    exporting.ran(REFUSED)
    assert exporting("export", "here", "--to", "zivid", "--anyway")[0] == 0
    text = (tmp_path / "here" / "exports" / "camera.zivid.yaml").read_text()
    assert "# REFUSED, DO NOT USE: verify.toy: " in text


def test_a_calibration_nobody_judged_says_so_in_the_file(exporting: Any, tmp_path: Path) -> None:
    exporting.ran(TOY_RECIPE.replace("  - verify.toy: {max_rms: 2 mm}\n", "  - export.matrix\n"))
    text = (tmp_path / "here" / "exports" / "camera.txt").read_text()
    assert "# NOT VERIFIED: nothing has judged this calibration\n" in text


def test_a_recipe_exports_wherever_the_step_stands(exporting: Any, tmp_path: Path) -> None:
    steps = "  - export.kuka: {name: eye}\n  - export.matrix\n"
    before = TOY_RECIPE.replace("  - verify.toy", steps + "  - verify.toy")
    assert exporting.ran(before)[0] == 0
    files = {p.name: p.read_text() for p in (tmp_path / "here" / "exports").iterdir()}
    assert sorted(files) == ["camera.txt", "eye.kuka.dat"]
    assert all("; verified\n" in text for text in files.values())
    assert json.loads((tmp_path / "here" / "result.json").read_text())["exports"] == files


@pytest.mark.parametrize(
    ("text", "told", "message"),
    [
        (
            TOY_RECIPE + "  - export.matrix\n  - export.matrix: {length: mm}\n",
            (),
            "6.export.matrix: an earlier step writes camera.txt already; give this one another name",
        ),
        (
            TOY_RECIPE,
            ("--to", "kukka"),
            "--to kukka: is not a format; did you mean kuka? 'flangeye export --list' names the formats",
        ),
        (
            TOY_RECIPE,
            ("--to", "ros"),
            "--to ros: is not a format; did you mean ros2_command or ros2_",
        ),
        (
            TOY_RECIPE,
            ("--anyway",),
            "--to: is missing, for example --to ros2_launch; 'flangeye export --list'",
        ),
        (
            TOY_RECIPE,
            ("--to", "kuka", "--set", "number=x"),
            "--set number: must be a whole number, not 'x'",
        ),
        (
            TOY_RECIPE,
            ("--to", "kuka", "--set", "nam=eye"),
            "--set nam: unknown key 'nam'; did you mean 'name'? (allowed: name, number)",
        ),
        (
            TOY_RECIPE,
            ("--to", "matrix", "--set", "name=../../x"),
            "--set name: must match the pattern '^[A-Za-z][A-Za-z0-9_]{0,23}$', not '../../x'",
        ),
    ],
)
def test_what_cannot_be_exported_is_one_line(
    exporting: Any, text: Any, told: tuple[Any, ...], message: str
) -> None:
    code, _, err = exporting.ran(text)
    if told:
        code, _, err = exporting("export", "here", *told)
    assert code == 2
    assert f"error: {message}" in err
    assert "Traceback" not in err


def renamed(name: str) -> Any:
    def edit(result: Any) -> None:
        result["transforms"] = {name: result["transforms"].pop("base_T_camera")}

    return edit


def stretched(result: Any) -> None:
    result["transforms"]["base_T_camera"]["matrix"][0][0] = 2.0


def judged(result: Any) -> None:
    result["status"] = "very verified"


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (renamed("base_T_cam; touch PWNED;"), "'cam; touch PWNED;' is not a valid frame name"),
        (renamed("x"), "'' is not a valid frame name"),
        (renamed("base_T_" + "c" * 99), "is not a valid frame name"),
        (stretched, "base_T_camera is not a rigid transform"),
        (judged, "status: Input should be 'verified', 'unverified', 'refused' or 'incomplete'"),
    ],
)
def test_a_hostile_log_is_one_line(exporting: Any, tmp_path: Path, edit: Any, message: str) -> None:
    exporting.ran(TOY_RECIPE)

    def changed(name: str, data: bytes) -> tuple[str, bytes]:
        if name != "result.json":
            return name, data
        result = json.loads(data)
        edit(result)
        return name, json.dumps(result).encode()

    crafted = rewritten(tmp_path / "here" / "run.mcap", tmp_path / "crafted.mcap", changed)
    code, out, err = exporting("export", crafted, "--to", "ros2_command", "--out", "-")
    assert (code, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1


def test_formats_are_listed_and_found_by_what_they_write(exporting: Any) -> None:
    code, out, _ = exporting("export", "--list")
    assert code == 0
    assert {stage.name.partition(".")[2] for stage in EXPORTS} <= {
        line.split()[0] for line in out.splitlines()
    }
    exporting.ran(TOY_RECIPE)
    code, out, _ = exporting("export", "here", "--to", "URScript", "--out", "-")
    assert code == 0
    assert "camera = p[" in out

"""The command line as a person meets it: output, exit codes, and what stays on disk."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from flangeye import __version__
from flangeye.cli import commands
from flangeye.errors import NothingMoved
from flangeye.types import Rejection
from tests import toy
from tests.conftest import replaced


def test_a_run_leaves_its_folder_and_says_the_result(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path
) -> None:
    code, out, err = flangeye("run", toy_recipe, "--out", "here")
    assert code == 0, err
    assert sorted(p.name for p in (tmp_path / "here").iterdir()) == [
        "calibration.yaml", "recipe.resolved.yaml", "report.html", "result.json", "run.mcap",
    ]  # fmt: skip
    assert "6 of 6 captures used" in out
    assert "Use it    flangeye export here --to ros2_launch" in out
    result = json.loads((tmp_path / "here" / "result.json").read_text())
    assert result["status"] == "verified"
    calibration = yaml.safe_load((tmp_path / "here" / "calibration.yaml").read_text())
    assert calibration["base_T_camera"]["matrix"] == result["transforms"]["base_T_camera"]["matrix"]


def test_by_default_the_folder_is_named_by_time_and_recipe(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path
) -> None:
    assert flangeye("run", toy_recipe)[0] == 0
    assert flangeye("run", toy_recipe)[0] == 0
    folders = [p.name for p in (tmp_path / "runs").iterdir()]
    assert len(folders) == 2
    assert all("_toy" in name for name in folders)


def test_the_resolved_recipe_runs_to_the_same_result(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path
) -> None:
    flangeye("run", toy_recipe, "--out", "a")
    flangeye("run", tmp_path / "a" / "recipe.resolved.yaml", "--out", "b")
    first, second = (json.loads((tmp_path / x / "result.json").read_text()) for x in "ab")
    assert first["transforms"] == second["transforms"]
    assert first["provenance"]["recipe_hash"] == second["provenance"]["recipe_hash"]


def test_refused_is_exit_code_one_with_the_reason(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path
) -> None:
    code, out, _ = flangeye("run", toy_recipe, "--set", "steps.4.max_rms=1 um", "--out", "x")
    assert code == 1
    assert "What is wrong     verify.toy: " in out
    assert (tmp_path / "x" / "report.html").exists()


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["run", "nothing"], "error: no recipe 'nothing'; 'flangeye recipes' lists them"),
        (["run", "toy.yaml", "--at", "solve.toy"],
         "error: --from and --at go together: --from run.mcap --at solve.svd"),
        (["run", "toy.yaml", "--from", "no.mcap", "--at", "solve.toy"],
         "error: no.mcap: cannot be read: No such file or directory"),
        (["run", "toy.yaml", "--set", "steps.2.inlier=3"],
         "error: --set steps.2.fit.toy.inlier: '3' has no unit: a length needs one (mm, m, um, "
         "for example '31.5 mm')"),
        (["run", "toy.yaml", "--set", "steps.0.count=2"],
         "error: solve.toy: 3 poses needed, 2 given"),
        (["run", "toy.yaml", "--out", "."],
         "error: .: already holds files; name a new or empty folder"),
        (["run", "toy.yaml", "--out", "toy.yaml/x"],
         "error: toy.yaml/x: cannot be made: Not a directory"),
        (["show", "toy.yaml"], "error: toy.yaml: is not an MCAP file"),
        (["report", "none.mcap"], "error: none.mcap: cannot be read: No such file or directory"),
        (["stages", "solve.toi"], "error: no stage 'solve.toi'; did you mean solve.toy?"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_exit_code_two(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path, words: list[Any], line: str
) -> None:
    before = sorted(p.name for p in tmp_path.iterdir())
    code, out, err = flangeye(*words)
    assert code == 2
    assert err.splitlines()[-1] == line
    assert "Traceback" not in out + err
    kept = [n for n in sorted(p.name for p in tmp_path.iterdir()) if n != "runs"]
    assert kept == before


def test_from_a_log_without_the_scans(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path
) -> None:
    flangeye("run", toy_recipe, "--out", "a")
    code, _, err = flangeye(
        "run", toy_recipe, "--from", "a/run.mcap", "--at", "solve.toy", "--out", "b"
    )
    assert code == 0, err
    first, second = (json.loads((tmp_path / x / "result.json").read_text()) for x in "ab")
    assert first["transforms"] == second["transforms"]


def test_show_and_report_work_from_the_log_alone(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path
) -> None:
    flangeye("run", toy_recipe, "--set", "steps.0.bad=1", "--out", "a")
    code, out, _ = flangeye("show", "a/run.mcap")
    assert code == 0
    assert "a/run.mcap: complete" in out
    assert "rejected 000: segment.toy: no finite point" in out
    assert "2.fit.toy" in out
    (tmp_path / "a" / "report.html").unlink()
    assert flangeye("report", "a/run.mcap")[0] == 0
    assert (tmp_path / "a" / "report.html").stat().st_size > 1000


@pytest.mark.parametrize(
    "words",
    [
        ["schema", "--out", "nowhere/schema.json"],
        ["report", "done/run.mcap", "--out", "nowhere/report.html"],
        ["new-plugin", "mine", "--kind", "fit", "--into", "nowhere/file"],
    ],
)
def test_a_place_that_cannot_be_written_is_one_line(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path, words: list[Any]
) -> None:
    assert flangeye("run", toy_recipe, "--out", "done")[0] == 0
    (tmp_path / "nowhere").write_text("a file where a folder should be")
    code, _, err = flangeye(*words)
    assert code == 2
    assert err.startswith("error: nowhere/")
    assert " cannot be " in err and err.endswith(": Not a directory\n")


def test_version(flangeye: Callable[..., Any]) -> None:
    assert flangeye("--version") == (0, f"flangeye {__version__}\n", "")


def test_check_stages_plugins_schema(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path
) -> None:
    assert flangeye("check", toy_recipe)[1] == (
        f"{toy_recipe}: ok, 5 steps\n"
        "eye-on-base: [base_T_camera] · camera_T_target = base_T_flange · flange_T_target; "
        "to be found: base_T_camera\n"
    )
    out = flangeye("stages")[1]
    assert "fit: the circle's centre or the marker's pose, with covariance\n  fit.toy" in out
    out = flangeye("stages", "fit.toy")[1]
    assert "  inlier: length = 0.3 mm  (> 0 in SI)\n" in out
    assert "      Largest distance of a rim point from the circle.\n" in out
    out = flangeye("stages", "solve.toy")[1]
    assert "  cost: a cost = toy\n" in out
    assert flangeye("plugins")[0] == 0
    code, out, err = flangeye("schema")
    assert json.loads(out)["title"] == "flangeye recipe"
    assert err == (
        "first line of your recipe: # yaml-language-server: $schema=recipe.schema.json\n"
    )
    assert json.loads(flangeye("schema", "--result")[1])["title"] == "Result"


def test_what_was_measured_before_is_shown_as_that(tmp_path: Path) -> None:
    """Points of a camera that is the base."""
    rows = [(0.1 * k, 0.1 * (k % 3), 0.1 * (k % 2), 0.2 * k, 0.1, 0.1 * k) for k in range(5)]
    (tmp_path / "t.csv").write_text("\n".join(",".join(map(str, r + r[:3])) for r in rows))
    table = (
        "{table: {file: t.csv, rotation: vector, angle: rad, length: m, pose: base_T_flange, "
        "columns: [1, 2, 3, 4, 5, 6], target: {columns: [7, 8, 9], rotation: point, length: m}}}"
    )
    acquire = f"acquire.centres: {{path: ., reader: {table}}}"
    (tmp_path / "points.yaml").write_text(f"title: Points\nsteps:\n  - {acquire}\n  - solve.svd\n")
    run, recipe = str(tmp_path / "run"), str(tmp_path / "points.yaml")
    CliRunner().invoke(commands(), ["run", recipe, "--out", run], catch_exceptions=False)
    shown = CliRunner().invoke(commands(), ["show", run], catch_exceptions=False).output
    assert "5 of 5 measurements went through" in shown.splitlines()


def test_a_folder_is_kept_once_something_was_gathered(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path
) -> None:
    code, _, err = flangeye("run", toy_recipe, "--set", "steps.0.count=2", "--out", "kept")
    assert code == 2
    assert (
        err.splitlines()[0]
        == "the captures recorded so far are in kept/run.mcap; flangeye report kept shows it"
    )
    assert flangeye("show", "kept/run.mcap")[0] == 0


def test_help_and_version_answer_at_once() -> None:
    """Ratios of the processor's time in the same run, so that no busy machine fails it."""
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": ""}

    def cost(*command):
        return min(once(*command) for _ in range(2))  # what else runs can only add to it

    def once(*command):
        before = os.times()
        subprocess.run([sys.executable, *command], capture_output=True, env=environment)
        after = os.times()
        used = after.children_user + after.children_system
        return used - before.children_user - before.children_system

    heavy = cost("-c", "import scipy.optimize, cv2, open3d")
    for words in ("--help", "--version"):
        once("-m", "flangeye.cli", words)  # its bytecode is there now
        assert cost("-m", "flangeye.cli", words) < 0.5 * heavy


def test_light_commands_import_nothing_heavy() -> None:
    code = (
        "import sys; from flangeye import cli; from flangeye.plugin.registry import load_registry; "
        "load_registry(); print([m for m in ('open3d', 'scipy', 'cv2', 'plotly') if m in sys.modules])"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout == "[]\n"


@pytest.mark.parametrize(("told", "threads"), [(None, "1"), ("3", "3")])
def test_matrices_keep_to_one_thread_unless_told_otherwise(told: str | None, threads: str) -> None:
    code = (
        "import os, sys; from flangeye import cli; assert 'numpy' not in sys.modules; "
        "cli.commands = lambda: lambda: print(os.environ['OPENBLAS_NUM_THREADS']); cli.main()"
    )
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    environment |= {"OPENBLAS_NUM_THREADS": told} if told else {}
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert run.stdout == f"{threads}\n"


def test_ctrl_c_keeps_what_was_gathered(
    flangeye: Callable[..., Any], toy_recipe: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = toy.segment.function

    def stopped_at_the_fourth(capture):
        if capture.id == "003":
            raise KeyboardInterrupt
        return plain(capture)

    with replaced(toy.segment, stopped_at_the_fourth):
        code, _, err = flangeye("run", toy_recipe, "--out", "a")
    assert code == 130
    assert err.splitlines()[-3:] == [
        "the captures recorded so far are in a/run.mcap; flangeye report a shows it",
        f"with other parameters: flangeye run {toy_recipe} --from a/run.mcap --at fit.toy --set "
        "PATH=VALUE (to do segment.toy again, record with --set log.clouds=full)",
        "error: stopped by Ctrl-C",
    ]
    assert "3 went through" in flangeye("show", "a/run.mcap")[1]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ((), "error: name a recipe, or --resume RUN, which brings its own"),
        (("toy.yaml", "--resume", "done"),
         "error: name a recipe, or --resume RUN, which brings its own"),
        (("--resume", "done", "--set", "seed=4"),
         "error: --set and --resume: a resumed run keeps the recipe it started with"),
        (("--resume", "nowhere"), "error: nowhere: cannot be read: No such file or directory"),
        (("--resume", "done"),
         "error: done/run.mcap: this run is complete; there is nothing to resume "
         "(--retake ID takes a capture again)"),
        (("--resume", "torn.mcap"), "error: torn.mcap: acquire.toy cannot be resumed"),
    ],
)  # fmt: skip
def test_what_cannot_be_gone_on_with_is_said(
    flangeye: Callable[..., Any],
    toy_recipe: Path,
    tmp_path: Path,
    words: tuple[Any, ...],
    line: str,
) -> None:
    assert flangeye("run", toy_recipe, "--out", "done")[0] == 0
    log = (tmp_path / "done" / "run.mcap").read_bytes()
    (tmp_path / "torn.mcap").write_bytes(log[: len(log) // 2])
    assert flangeye("run", *words)[::2] == (2, f"{line}\n")


def test_a_plan_that_was_not_allowed_to_move_is_no_mistake(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path
) -> None:
    def acquire(seed, params):
        raise NothingMoved("stop 1: here\nnothing moved")

    with replaced(toy.acquire, acquire):
        code, out, err = flangeye("run", toy_recipe, "--out", "here")
    assert (code, out, err) == (0, "stop 1: here\nnothing moved\n", "")
    assert not (tmp_path / "here").exists()


def test_a_source_may_reject_its_own_captures(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path
) -> None:
    plain = toy.acquire.function
    made = []

    def acquire(seed, params):
        captures = plain(seed, params)
        made.append(captures)
        items = captures._items
        captures._items = (
            Rejection(c.id, "acquire.toy", "the arm moved") if c.id == "001" else c for c in items
        )
        return captures

    with replaced(toy.acquire, acquire):
        assert flangeye("run", toy_recipe, "--out", "here")[0] == 0
    result = json.loads((tmp_path / "here" / "result.json").read_text())
    aside = [o for o in result["observations"] if not o["used"]]
    assert [(o["id"], o["reason"]) for o in aside] == [("001", "acquire.toy: the arm moved")]
    outcomes = made[0].outcomes
    assert outcomes["001"] is None
    assert outcomes["000"].id == "000"


def test_a_refusal_says_what_to_do(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path
) -> None:
    code, out, _ = flangeye("run", toy_recipe, "--set", "steps.4.max_rms=1 um", "--out", "x")
    assert code == 1
    assert "Next step         list each pose's error: flangeye show x --outlook" in out


def test_a_refusal_names_the_motion_that_is_missing(
    flangeye: Callable[..., Any], toy_recipe: Path
) -> None:
    far = "workspace={centre: [0 m, 0 m, 5 m], size: [1 m, 1 m, 1 m]}"
    words = ["--set", "steps.4.max_rms=1 um", "--set", far, "--out", "x"]
    code, out, _ = flangeye("run", toy_recipe, *words)
    assert code == 1
    assert "Next step         go to the low end of the work along x" in out


def test_solvers_are_compared_by_exchanging_a_step(
    flangeye: Callable[..., Any], toy_recipe: Path
) -> None:
    code, _, err = flangeye("check", toy_recipe, "--set", "steps.3=solve.toi")
    assert (code, err) == (
        2,
        "error: --set steps.3: no stage 'solve.toi'; did you mean solve.toy?\n",
    )
    assert flangeye("check", toy_recipe, "--set", "verify.toy.max_rms=1 mm")[0] == 0


def test_notes_for_the_record_are_shown_on_request_only(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path
) -> None:
    text = toy_recipe.read_text().replace("  - solve.toy", "  - solve.toy\n  - refine.toy")
    toy_recipe.write_text(text)
    _, out, err = flangeye("run", toy_recipe, "--out", "here")
    assert "refined" not in out + err
    assert "note: refined" in flangeye("show", "here")[1]
    page = (tmp_path / "here" / "report.html").read_text()
    assert page.index("<li>refined</li>") > page.index('id="how"')


def test_a_runs_folder_is_as_good_as_its_log(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path
) -> None:
    flangeye("run", toy_recipe, "--out", "here")
    assert flangeye("show", "here")[1] == flangeye("show", "here/run.mcap")[1]
    (tmp_path / "here" / "report.html").unlink()
    assert flangeye("report", "here") == (0, "here/report.html\n", "")
    page = (tmp_path / "here" / "report.html").read_bytes()
    assert flangeye("report", "here", "--out", "other.html") == (0, "other.html\n", "")
    assert (tmp_path / "other.html").read_bytes() == page
    assert flangeye("show", "--replay", "here") == flangeye("show", "--replay", "here/run.mcap")
    assert flangeye("doctor", "here") == flangeye("doctor", "here/run.mcap")
    assert flangeye("show", "here/calibration.yaml") == flangeye("show", "here")
    assert flangeye("doctor", "here/result.json") == flangeye("doctor", "here")


def test_a_refused_run_writes_no_calibration(
    flangeye: Callable[..., Any], toy_recipe: Path, tmp_path: Path
) -> None:
    toy_recipe.write_text(toy_recipe.read_text().replace("2 mm", "0.001 mm"))
    code, out, _ = flangeye("run", toy_recipe, "--out", "here")
    assert code == 1
    assert not (tmp_path / "here" / "calibration.yaml").exists()
    assert "flangeye export" not in out
    assert "base_T_camera [m]" not in out

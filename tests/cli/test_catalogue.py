"""Lists of what is known, files for what is not, and what the command line offers to complete."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from flangeye.cli import commands
from flangeye.cli.app import complete_recipe
from flangeye.errors import FlangeyeError
from flangeye.models.loading import load_model, model_names
from flangeye.plugin.registry import PluginNotFoundError, load_registry
from flangeye.workflow.recipe.load import load_recipe
from tests.conftest import Call


def flangeye(*words, typed=""):
    done = CliRunner().invoke(commands(), [str(word) for word in words], input=typed)
    if done.exception and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.output


def test_the_lists_name_every_model() -> None:
    for command, kind in (("robots", "robots"), ("scanners", "scanners")):
        listed = [line.split()[0] for line in flangeye(command).splitlines()]
        assert listed == model_names(kind)
    assert "ISO 9409-1-50-4-M6      outer 63, pitch circle 50, centring 31.5 mm" in flangeye(
        "standards"
    )


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("new-robot", "mine"), "joint 1: was not answered; give --joint or --urdf"),
        (("new-scanner", "acme"),
         "minimum working distance, for example 300 mm: was not answered; give --near"),
        (("new-scanner", "acme", "--near", "300 mm"),
         "maximum working distance, for example 900 mm: was not answered; give --far"),
    ],
)  # fmt: skip
def test_who_asks_where_nobody_answers_says_what_to_give_instead(
    words: tuple[str, ...], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FlangeyeError) as refused:
        flangeye(*words)
    assert str(refused.value) == told
    assert not list(tmp_path.iterdir())


RECIPE = "title: T\nrobot: mine.yaml\nscanner: acme.yaml\nsteps: [acquire.archive, segment.flange, fit.rim, solve.svd]\n"


@pytest.mark.parametrize("asked", [False, True])
def test_new_files_pass_check(asked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    joints = ["d: 89.159 mm, alpha: 90 deg", "a: -425 mm", "a: -392.25 mm",
              "d: 109.15 mm, alpha: 90 deg", "d: 94.65 mm, alpha: -90 deg", "d: 82.3 mm"]  # fmt: skip
    words = [word for joint in joints for word in ("--joint", joint)]
    plate = ["--standard", "ISO 9409-1-50-4-M6"]
    if asked:
        told = flangeye("new-robot", "mine", *plate, typed="\n".join([*joints, "", ""]))
        flangeye("new-scanner", "acme", typed="300 mm\n900 mm\n")
    else:
        told = flangeye("new-robot", "mine", *plate, *words)
        flangeye("new-scanner", "acme", "--near", "300 mm", "--far", "900 mm")
    assert "(-817.2, -191.5, -5.5) mm" in told
    (tmp_path / "r.yaml").write_text(RECIPE)
    load_recipe(tmp_path / "r.yaml", load_registry())


def test_a_whole_scanner_can_be_simulated(tmp_path: Path) -> None:
    out = tmp_path / "acme.yaml"
    flangeye("new-scanner", "acme", "--near", "300 mm", "--far", "900 mm", "--principle",
             "structured light", "--pixels", 1280, 1024, "--field", "40 deg", "32 deg",
             "--noise", "0.1 mm", "--error", "0.1 mm", "--out", out)  # fmt: skip
    assert load_model("scanners", str(out)).columns == 1280


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["new-robot", "mine", "--joint", "d: 89, alpha: 90 deg"],
         "error: joints.0.d: '89' has no unit: a length needs one"),
        (["new-robot", "mine", "--joint", "d: 89 mm", "--standard", "50-5-M6"],
         "error: no flange standard '50-5-M6'; known: "),
        (["new-robot", "mine", "--joint", "d: 89 mm", "--out", "r.txt"],
         "error: r.txt: a model's file ends in .yaml"),
        (["new-scanner", "acme", "--near", "3", "--far", "900 mm"],
         "error: acme.yaml:2: near: '3' has no unit: a length needs one"),
        (["new-scanner", "acme", "--near", "900 mm", "--far", "300 mm"],
         "error: acme.yaml:1: near must be below far"),
        (["new-robot", "mine", "--urdf", "nowhere.urdf"], "error: nowhere.urdf: "),
    ],
)  # fmt: skip
def test_a_wrong_value_is_one_line_and_leaves_no_file(
    words: list[Any], line: str, command: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = command(*words)
    assert code == 2
    assert err.startswith(line)
    assert len(err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["new-robot", "new-scanner"])
def test_a_file_that_is_there_is_told_before_anything_is_asked(kind: str, tmp_path: Path) -> None:
    out = tmp_path / "mine.yaml"
    out.touch()
    done = CliRunner().invoke(commands(), [kind, "mine", "--out", str(out)])
    assert str(done.exception) == f"{out}: exists already; choose another name with --out"
    assert not done.output


def test_a_kind_lists_its_stages() -> None:
    assert "solve.svd" in flangeye("stages", "solve")
    with pytest.raises(PluginNotFoundError, match="no kind of stages 'slove'; did you mean solve"):
        flangeye("stages", "slove")
    assert "reader.table" in flangeye("stages", "reader")


def test_the_shell_completes_recipes() -> None:
    assert complete_recipe("ur5_phoxi-m_sa") == ["ur5_phoxi-m_sample"]

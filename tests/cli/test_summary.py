"""What a run prints at its end, line by line, on wide and narrow terminals."""

import io
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from flangeye.cli import commands
from flangeye.cli.app import GROUPS
from flangeye.cli.console import report_errors, wrapped, write
from flangeye.cli.details import print_details
from flangeye.cli.summary import RunProgress, print_refusal, print_summary
from flangeye.errors import RecipeError
from flangeye.types import Rejection, Source, Warn
from flangeye.workflow.result import contract as r

SCALE = {"text": "the target is 1.3 % larger than configured", "fix": "feature.size: 40.52 mm"}


def result(**more: Any) -> r.Result:
    pose = r.TransformResult(
        matrix=np.eye(4).tolist(), covariance=np.eye(6).tolist(), about=[0.0, 0.0, 0.0]
    )
    given: dict[str, Any] = {
        "title": "A cell",
        "status": "verified",
        "simulated": True,
        "transforms": {"base_T_camera": pose},
        "observations": [r.ObservationResult(id="1", used=True)],
        "verifications": {},
        "timing": {},
        "holdout": r.HoldoutResult(
            folds=5, rms=1.63e-4, median=1e-4, p95=2e-4, figures={"limit": 5e-4}
        ),
        "provenance": r.Provenance(
            versions={}, plugins={}, recipe="", recipe_hash="", input_hash="", seed=0, notes=["one"]
        ),
    }
    return r.Result(**given | more)


def printed(found: r.Result, width: int = 0, said: tuple[str, ...] = ()) -> str:
    out = io.StringIO()
    console = Console(file=out, width=width or None, force_terminal=bool(width), no_color=True)
    print_summary(console, found, "runs/now", 20, said)
    return out.getvalue()


def test_a_run_prints_one_screen_and_nothing_else() -> None:
    assert printed(result()).splitlines() == [
        "A cell",
        "VERIFIED (simulated)   1 of 1 captures used",
        "Held-out error   0.16 mm   5 folds, poses that took no part; limit 0.50 mm",
        "base_T_camera [m]",
        "    1.000000    0.000000    0.000000    0.000000",
        "    0.000000    1.000000    0.000000    0.000000",
        "    0.000000    0.000000    1.000000    0.000000",
        "    0.000000    0.000000    0.000000    1.000000",
        "Report    runs/now/report.html",
        "Use it    flangeye export runs/now --to ros2_launch   (20 formats: flangeye export --list)",
        "Details   flangeye show runs/now                      1 note, none needs action",
    ]


def test_a_real_run_is_not_called_simulated() -> None:
    assert "VERIFIED   1 of 1" in printed(result(simulated=False))


def test_a_warning_is_printed_with_what_mends_it() -> None:
    found = result(warnings=[r.WarningResult(**SCALE)])
    text = printed(found)
    assert f"warning: {SCALE['text']}\n  -> {SCALE['fix']}\n" in text
    assert "1 note, 1 warning above" in text
    assert SCALE["text"] not in printed(found, said=(SCALE["text"],))


@pytest.mark.parametrize("width", [60, 80])
def test_no_line_is_wider_than_the_terminal(width: int) -> None:
    found = result(warnings=[r.WarningResult(text="long words " * 12, fix="line " * 20)])
    lines = printed(found, width).replace("\x1b", "\n\x1b").splitlines()
    assert max(len(line.partition("m")[2] if "\x1b" in line else line) for line in lines) <= width


def test_a_file_has_no_colours() -> None:
    assert "\x1b" not in printed(result(status="refused", refused="why"))


def test_a_refused_matrix_is_not_there_to_copy() -> None:
    text = printed(result(status="refused", refused="why"))
    assert "base_T_camera" not in text
    assert "export" not in text


def test_foreign_text_makes_no_line_of_its_own() -> None:
    """A title or a note with line feeds would forge a verdict."""
    forged = "x\nVERIFIED   16 of 16 captures used\u061c"
    found = result(
        title=forged, notes=[forged], refused=forged, status="refused",
        warnings=[r.WarningResult(text=forged, fix=forged)],
    )  # fmt: skip
    out = io.StringIO()
    print_details(Console(file=out), found)
    for text in (printed(found), out.getvalue()):
        assert forged.partition("\n")[2][:8] in text
        assert not [line for line in text.splitlines() if line.startswith("VERIFIED")]
        assert "\u061c" not in text


def test_a_refusal_has_three_parts() -> None:
    out = io.StringIO()
    print_refusal(Console(file=out), "what", "how", ["do this", "or that", "or else"])
    assert [line.split("  ")[0] for line in out.getvalue().splitlines()] == [
        "What is wrong", "How it is known", "Next step", "or", "or",
    ]  # fmt: skip
    out.truncate(0)
    print_refusal(Console(file=out), "what", "how", ["do this", "and that"], "then")
    assert out.getvalue().splitlines()[-1] == "then              and that"


def test_the_details_of_a_refusal_have_its_next_step() -> None:
    out = io.StringIO()
    print_details(Console(file=out), result(status="refused", refused="why", advice="do this"))
    assert "refused: why\nnext step: do this\n" in out.getvalue()


def test_commands_stay_whole_when_lines_are_wrapped() -> None:
    console = Console(file=io.StringIO(), width=20, force_terminal=True)
    assert "--to-a-long-option" in wrapped(console, "flangeye export run --to-a-long-option")


def test_warnings_of_the_source_are_printed_before_the_run() -> None:
    out = io.StringIO()
    progress = RunProgress(Console(file=out), ["0.acquire.toy"])
    with progress:
        progress.flangeye_run_started(
            source=Source(fingerprint="", notes=("record", Warn("wrong", "mend"))), total=3
        )
    assert out.getvalue() == "warning: wrong\n  -> mend\n"
    assert progress.said == ["wrong"]


def test_captures_rejected_for_one_reason_are_told_together() -> None:
    out = io.StringIO()
    with RunProgress(Console(file=out), ["0.acquire.toy"]) as progress:
        for name, why in (
            ("a", "dark, 2 px"),
            ("b", "dark, 3.1 px"),
            ("c", "far"),
            ("d", "dark, 4 px"),
        ):
            progress.flangeye_capture_rejected(rejection=Rejection(name, "fit.toy", why))
    assert out.getvalue().splitlines() == [
        "rejected a: fit.toy: dark, 2 px", "rejected c: fit.toy: far", "rejected for the same reason as a: b, d",
    ]  # fmt: skip


def test_markup_of_others_is_not_followed() -> None:
    out = io.StringIO()
    write(Console(file=out), "[bold]x[/bold] \x1b[31m")
    assert out.getvalue().startswith("[bold]x[/bold] ")
    assert "\x1b" not in out.getvalue()


def test_help_lists_every_command_in_its_group_with_a_whole_sentence() -> None:
    told = CliRunner().invoke(commands(), ["--help"], terminal_width=80).output
    listed = told[told.index("Calibrate:") :]
    assert [title for title in GROUPS if f"{title}:\n" in listed] == list(GROUPS)
    assert "More:" not in listed, "a command without a group"
    assert "..." not in listed


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (RecipeError("\n".join(map(str, range(20_000)))),
         [*(f"error: {i}" for i in range(100)), "error: 19900 lines more"]),
        (RecipeError("x" * 5000), ["error: " + "x" * 4000 + " (1000 characters more)"]),
        (MemoryError("7 PiB"), ["error: not enough memory: 7 PiB"]),
        (MemoryError(), ["error: not enough memory: the machine has no more"]),
    ],
)  # fmt: skip
def test_what_is_said_is_bounded(
    error: Exception, said: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    def fails() -> None:
        raise error

    with pytest.raises(SystemExit, match="2"):
        report_errors(fails)
    assert capsys.readouterr().err.splitlines() == said


@pytest.mark.parametrize("error", [ImportError("a.so: failed to map"), SystemError("a.so")])
def test_a_library_that_does_not_load_is_a_lack_of_memory_where_there_is_none(
    error: Exception, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails() -> None:
        raise error

    with pytest.raises(type(error)):
        report_errors(fails)

    def runs_out() -> None:
        monkeypatch.setattr("flangeye.files.processes.mmap.mmap", no_map)
        raise error

    def no_map(*_: object) -> None:
        raise OSError

    with pytest.raises(SystemExit, match="2"):
        report_errors(runs_out)
    assert capsys.readouterr().err.splitlines() == [
        f"error: not enough memory: {type(error).__name__}: {error}; fewer than 256 MB are left"
    ]

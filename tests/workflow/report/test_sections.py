"""What each section of the page says."""

from __future__ import annotations

import html
import io
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from flangeye import FlangeyeError
from flangeye.cli.details import print_details
from flangeye.workflow.log.read import RunLog, read_run
from flangeye.workflow.report import write_report
from flangeye.workflow.report.facts import facts_of, idle_of, set_aside_of, timings_of
from flangeye.workflow.report.page import render
from flangeye.workflow.report.summary import (
    banner_of,
    evidence_of,
    next_steps_of,
    tiles_of,
    transform_text,
)
from flangeye.workflow.report.units import degrees, duration, figure, figure_name, millimetres
from flangeye.workflow.result.contract import StageTiming

Make = Callable[..., RunLog]


def text_of(log: RunLog) -> str:
    """Return the page as a reader sees it: no scripts, no tags, blanks joined."""
    page = re.sub(r"<(script|style).*?</\1>", "", render(log), flags=re.S)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", page)).split())


def test_a_verified_run_says_so_first(make_run: Make) -> None:
    text = text_of(make_run())
    assert text.startswith("Verified: UR5 and PhoXi M, simulated flangeye calibration report")
    assert "Held-out error 0.312 mm rms, within the limit of 1 mm" in text
    assert "Held-out error 0.31 mm rms, 5 folds, poses that took no part" in text
    assert "Poses used 12 of 12 captures" in text
    assert "Nothing was rejected." in text


def test_the_evidence_carries_units_and_what_they_are_taken_over(make_run: Make) -> None:
    log = make_run()
    result = facts_of(log).result
    shown = {(h.name, h.note): (h.value, h.unit) for h in evidence_of(facts_of(log))}
    assert result.workspace is not None
    assert result.truth is not None
    true = millimetres(result.truth.rms_over_workspace)
    assert shown["True error", "rms over the workspace, known in simulation"] == (true, "mm")


def test_the_matrix_can_be_copied_and_read_back(make_run: Make) -> None:
    log = make_run()
    page = render(log)
    found = re.search(r'<pre id="matrix-1"[^>]*>(.*?)</pre>', page, re.S)
    assert found is not None
    shown = np.array([[float(x) for x in row.split()] for row in found[1].splitlines()])
    matrix = facts_of(log).result.transforms["base_T_camera"].matrix
    np.testing.assert_allclose(shown, matrix, atol=5e-10)
    assert 'data-copies="matrix-1"' in page


def test_the_matrix_in_words_and_other_units() -> None:
    from flangeye.workflow.result.contract import TransformResult

    matrix = np.eye(4)
    matrix[:3, 3] = [0.1, -0.2, 1.0]
    covariance = np.diag([1e-6, 4e-6, 9e-6, 1e-8, 4e-8, 9e-8])
    estimate = TransformResult(
        matrix=matrix.tolist(), covariance=covariance.tolist(), about=[0.4, 0.0, 0.3]
    )
    text = transform_text("base_T_camera", estimate)
    assert text.meaning == (
        "maps points given in the camera to points in the robot's base; "
        "equally, it is the pose of the camera in the robot's base"
    )
    assert text.translation == ["100.000", "-200.000", "1000.000"]
    assert text.rotation == ["0.0000", "0.0000", "0.0000"]
    assert text.quaternion == ["0.0000000", "0.0000000", "0.0000000", "1.0000000"]
    assert text.translation_std == ["0.100", "0.200", "0.300"]
    assert text.rotation_std == ["0.0573", "0.1146", "0.1719"]
    assert text.about == ["400.0", "0.0", "300.0"]


def test_a_refusal_comes_first_and_its_matrix_is_not_offered(make_run: Make) -> None:
    log = make_run(verified=False, refused="held-out error 3.1 mm rms, above the limit of 1 mm")
    text = text_of(log)
    assert text.startswith("Refused: ")
    assert "REFUSED Held-out error 3.1 mm rms, above the limit of 1 mm" in text
    assert "Refused: use these numbers to find the cause, not to drive the arm." in text
    assert "data-copies=" not in render(log).partition("<main>")[2].partition("<script>")[0]


def test_a_refusal_says_what_to_do_next(make_run: Make) -> None:
    facts = facts_of(make_run(solved=False, refused="the arm stood still"))
    known = facts.result.model_copy(update={"advice": "move it too"})
    told = [banner_of(replace(facts, result=each)).sentence for each in (facts.result, known)]
    assert told == ["The arm stood still", "The arm stood still. Next step: move it too"]


def test_refused_before_solving_shows_no_residuals(make_run: Make) -> None:
    log = make_run(solved=False, refused="the flange's centres lie on a line")
    text = text_of(log)
    assert "There is no matrix: the solver gave none." in text
    assert "There is no estimate, so there are no residuals." in text
    assert "Circles measured 12 of 12 captures" in text
    assert "Nothing was rejected." in text


def test_without_a_verify_step_it_says_what_that_means(make_run: Make) -> None:
    verdict = banner_of(facts_of(make_run(verified=None)))
    assert (verdict.label, verdict.sentence) == (
        "Not verified",
        "No verify step checked this calibration; check it before anything relies on it",
    )


def test_a_simulated_run_says_so_in_its_first_line(make_run: Make) -> None:
    facts = facts_of(make_run())
    real, simulated = (
        facts.result.model_copy(update={"simulated": said}) for said in (False, True)
    )
    assert "SIMULATED" not in banner_of(replace(facts, result=real)).figures
    assert "SIMULATED" in banner_of(replace(facts, result=simulated)).figures


def test_what_to_do_next_depends_on_the_verdict(make_run: Make) -> None:
    good = [command.split()[1] for _, command in next_steps_of(facts_of(make_run()))]
    assert good == ["export", "touch", "monitor"]
    bad = next_steps_of(facts_of(make_run(verified=False, refused="3 mm")))
    assert [command.split()[1] for _, command in bad] == ["doctor"]
    torn = next_steps_of(facts_of(make_run(finished=False)))
    assert [command.split()[1] for _, command in torn] == ["show", "run"]


def test_captures_kept_for_verification_are_counted(make_run: Make) -> None:
    log = make_run()
    log.poses["pose-03"]["role"] = "verification"
    assert tiles_of(facts_of(log))[-1].note == "of 12 captures, 1 kept for verification"


def test_what_was_rejected_is_counted_and_listed(make_run: Make) -> None:
    log = make_run(
        rejected={
            "pose-03": "segment.flange: the plane holds 812 points, at least 2000 are needed",
            "pose-05": "segment.flange: the plane holds 1301 points, at least 2000 are needed",
        },
        outliers={"pose-08": "residual 41.2 mm is beyond the gate"},
    )
    found = set_aside_of(facts_of(log))
    assert found.counts == [
        (
            2,
            "segment.flange",
            "the plane holds 812 points, at least 2000 are needed; the others alike",
        ),
        (1, "solve.svd", "residual 41.2 mm is beyond the gate"),
    ]
    assert [(x.id, x.stage, x.reason) for x in found.rows][2] == (
        "pose-08", "solve.svd", "residual 41.2 mm is beyond the gate",
    )  # fmt: skip
    text = text_of(log)
    expected = "3 of 12 captures were not used: 2 rejected before solving, 1 by the solver."
    assert expected in text


@pytest.mark.parametrize(
    ("reason", "other", "kinds"),
    [
        ("812 points, limit 2000", "12 points, limit 2000", 1),
        ("rms 3.1e-4 m > 0.25 mm", "rms 2.5e-4 m > 0.25 mm", 1),
        ("tilt -12.5° of 30°", "tilt 32.5° of 30°", 1),
        ("the M6 thread of ur5", "the M5 thread of ur5", 2),
    ],
)
def test_reasons_that_differ_in_numbers_only_are_one_reason(
    make_run: Make, reason: str, other: str, kinds: int
) -> None:
    log = make_run(rejected={"pose-03": f"fit.rim: {reason}", "pose-05": f"fit.rim: {other}"})
    assert len(set_aside_of(facts_of(log)).counts) == kinds


def test_timing_is_in_the_order_of_the_recipe(make_run: Make) -> None:
    facts = facts_of(make_run(finished=False))
    found = {x.step: (x.total, x.calls, x.each) for x in timings_of(facts)}
    assert list(found) == [
        "0.acquire.simulated", "1.segment.flange", "2.fit.rim", "3.solve.svd", "4.verify.holdout",
    ]  # fmt: skip
    assert found["0.acquire.simulated"] == ("1.20 s", 12, "100 ms")


def test_an_arm_that_waited_says_how_long(make_run: Make) -> None:
    facts = facts_of(make_run())
    assert idle_of(facts) == ""
    facts.result.timing["0.acquire.live"] = StageTiming(seconds=9.0, calls=3, idle=0.123)
    assert idle_of(facts) == "12.3%"
    out = io.StringIO()
    print_details(Console(file=out, width=120), facts.result)
    assert "  arm idle           12.3% of its session" in out.getvalue()


def test_notes_provenance_and_recipe_are_there(make_run: Make) -> None:
    text = text_of(make_run())
    for part in ("two scans were empty", "sha256:0123", "Seed 7", "flangeye 0.1.0, numpy 2.0"):
        assert part in text
    assert "2001-09-09 01:46:40 to 2001-09-09 01:46:51 UTC" in text
    assert "workspace: {centre: [450 mm, 0 mm, 400 mm]" in text


def test_a_run_from_centres_has_no_clouds_but_all_else(make_run: Make) -> None:
    log = make_run(clouds=False, truth=False)
    text = text_of(log)
    assert "True error" not in text
    assert 'id="figure-cell"' in render(log)
    assert 'id="figure-cloud-1"' not in render(log)


def test_a_killed_run_shows_what_there_is(make_run: Make) -> None:
    log = make_run(finished=False, solved=False)
    text = text_of(log)
    assert (
        "INCOMPLETE The run ended before its result was written: 12 of 12 captures were finished, "
        "the solver had not finished; this is what the log holds"
    ) in text
    assert "Incomplete: A test" in text
    assert "figure-cloud-3" in render(log)


def test_a_run_killed_after_the_solver_equals_the_finished_one(
    make_run: Make, tmp_path: Path
) -> None:
    finished = facts_of(make_run()).result
    killed = facts_of(make_run(finished=False)).result
    assert killed.status == "incomplete"
    for part in ("transforms", "observations", "workspace", "holdout", "truth", "verifications"):
        assert getattr(killed, part) == getattr(finished, part), part


def test_every_shorter_log_gives_a_page(make_run: Make, tmp_path: Path) -> None:
    log = make_run(points=300, ids=("a", "b", "c", "d"))
    whole = log.path.read_bytes()
    for share in (0.9, 0.6, 0.3, 0.1):
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(whole[: int(share * len(whole))])
        try:
            shorter = read_run(cut)
        except FlangeyeError:
            continue  # nothing was logged yet
        assert "Incomplete" in text_of(shorter)


def test_no_text_from_the_data_becomes_markup(make_run: Make) -> None:
    evil = "<img src=x onerror=alert(1)>"
    log = make_run(
        ids=(f"{evil}a", f"{evil}b", "</script><script>alert(2)</script>", "a&b", "'\"", "e", "f"),
        title=f"{evil}title",
        recipe=f"title: '{evil}'\n",
        rejected={f"{evil}a": f"segment.flange: {evil}"},
        outliers={f"{evil}b": f"{evil} too far"},
    )
    page = render(log)
    assert evil not in page
    assert "<script>alert" not in page
    figures = re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', page, re.S)
    for drawn in figures:
        assert "<" not in drawn
        for text in _texts(json.loads(drawn)):
            assert "<img" not in text  # plotly reads markup in its texts
    assert "&lt;img" in page


def _texts(node: Any) -> list[str]:
    if isinstance(node, str):
        return [node]
    children = node.values() if isinstance(node, dict) else node if isinstance(node, list) else []
    return [text for child in children for text in _texts(child)]


def test_a_file_that_cannot_be_written_is_said_in_one_line(make_run: Make, tmp_path: Path) -> None:
    (tmp_path / "missing").write_text("a file where a folder is meant")
    path = tmp_path / "missing" / "report.html"
    with pytest.raises(FlangeyeError) as error:
        write_report(make_run(), path)
    assert str(error.value) == f"{path}: cannot be written: Not a directory"


def test_numbers_for_people() -> None:
    assert [millimetres(x) for x in (0.0003123, -0.0123, 0.4)] == ["0.312", "-12.30", "400.0"]
    assert degrees(np.pi / 180) == "1.0000"
    shown = [duration(x) for x in (0.0, 0.0000123, 0.0312, 1.2, 119.0, 180.0)]
    assert shown == ["0 ms", "0.0123 ms", "31.2 ms", "1.20 s", "119.00 s", "3.0 min"]


@pytest.mark.parametrize(
    ("name", "value", "shown"),
    [
        ("p95", 0.000245721, "95 % below 0.246 mm"),
        ("corrected_p95", 0.0, "corrected 95 % below 0.000 mm"),
        ("rms_all", 3e-4, "rms with outliers 0.300 mm"),
        ("slide", -2e-4, "slide -0.200 mm"),
        ("camera_x", 2e-4, "camera x 0.200 mm"),
        ("clocking", 0.01, "clocking 0.5730 \N{DEGREE SIGN}"),
        ("overlap", 0.93, "overlap 93%"),
        ("scale", -12e-6, "scale -12 ppm"),
        ("folds", 5.0, "folds 5"),
        ("acme_index", 0.25, "acme index 0.25"),
    ],
)
def test_a_check_s_figures_have_words_and_units(name: str, value: float, shown: str) -> None:
    assert f"{figure_name(name)} {figure(name, value)}".replace("\N{NO-BREAK SPACE}", " ") == shown


@pytest.mark.parametrize(
    ("unit", "shown"),
    [("m", "1.000 mm"), ("rad", "0.0573 °"), ("share", "0%"), ("relative", "+1000 ppm"),
     ("", "0.001")],
)  # fmt: skip
def test_a_figure_has_the_unit_that_its_check_declares(unit: str, shown: str) -> None:
    """Whatever its name is: a slide in radians, or an index in metres."""
    for name in ("slide", "acme_index"):
        assert figure(name, 1e-3, {name: unit}).replace("\N{NO-BREAK SPACE}", " ") == shown
    assert figure("slide", 1e-3, {"other": unit}).endswith("mm")

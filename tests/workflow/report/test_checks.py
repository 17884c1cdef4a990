"""What verify steps drew stands in the report, with what they said."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flangeye import types as t
from flangeye.workflow.log.read import read_notes, read_run
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.report.facts import facts_of
from flangeye.workflow.report.page import drawings_of, render
from tests.conftest import TOY_RECIPE


def drawn(path: Path) -> Path:
    """Write the log of a run whose two verify steps drew something."""
    recorder = Recorder(path, {"recipe.yaml": TOY_RECIPE}, False)
    recorder.flangeye_run_started(t.Source("x"), None)
    pixels = np.full((12, 12, 3), 200, np.uint8)
    recorder.flangeye_noted("4.verify.stitch", "spread", t.Image(pixels, np.eye(3)))
    points = {"along x": [[1, 0.5], [2, 0.25]], "along <y>": [[1, -0.1], [2, 0.0]]}
    told = {"x": "point", "y": "predicted less actual [mm]", "series": points}
    recorder.flangeye_noted("5.verify.touch", "comparison", told)
    recorder.flangeye_noted("0.acquire.toy", "comparison", told)  # no check: not drawn
    for step, reason in (("4.verify.stitch", "views agree"), ("5.verify.touch", "0.5 mm off")):
        found = t.Verification(True, reason, {})
        recorder.flangeye_stage_finished(step, None, found, 0.1)
    recorder.close()
    return path


def test_pictures_and_comparisons_are_shown_with_what_the_step_said(tmp_path: Path) -> None:
    log = read_run(drawn(tmp_path / "run.mcap"))
    picture, figure = drawings_of(facts_of(log))
    assert (picture.step, picture.summary) == ("4.verify.stitch", "views agree")
    assert picture.picture.startswith("data:image/jpeg;base64,")
    assert figure.figure is not None
    assert [trace["name"] for trace in figure.figure["data"]] == ["along x", "along &lt;y&gt;"]
    assert figure.figure["data"][0]["y"] == [0.5, 0.25]
    page = render(log)
    assert "What the checks saw" in page
    assert "5.verify.touch: 0.5 mm off" in page


def test_only_the_notes_of_the_named_steps_are_read(tmp_path: Path) -> None:
    path = drawn(tmp_path / "run.mcap")
    assert [n.step for n in read_notes(path, {"5.verify.touch"})] == ["5.verify.touch"]
    assert len(list(read_notes(path))) == 3

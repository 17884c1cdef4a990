"""The planned seam in the report and in the terminal."""

import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from rich.console import Console

from flangeye import types as t
from flangeye.cli.details import print_details
from flangeye.workflow.log.read import read_run
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.report.facts import Facts
from flangeye.workflow.report.page import render
from flangeye.workflow.report.weld import seam_view
from flangeye.workflow.result import contract as r
from flangeye.workflow.result.sections import seam_result

LINE = np.column_stack([np.linspace(0.5, 0.7, 41), np.zeros(41), np.full(41, 0.27)])
SEAM = t.Seam(
    LINE + [0.0, 1e-4, 0.0],
    np.tile([0.0, 0.0, 1.0], (41, 1)),
    np.tile(np.diag([4e-8, 1e-8, 1e-8]), (41, 1, 1)),
    half_angle=np.radians(40),
    half_width=0.0084,
    source="CAD plate on a scan",
    figures={"seen": 0.97},
    cloud=t.PointCloud(t.BASE, np.float32(LINE + [0.0, 0.01, 0.01])),
)
assert SEAM.cloud is not None
SCAN = t.WorkpieceScan(SEAM.cloud, "a scan", (), {"groove": LINE})
TUBE = 1e-4 * np.sqrt(5.9915)


@pytest.fixture
def log(tmp_path: Path) -> Any:
    recorder = Recorder(tmp_path / "run.mcap", {"recipe.yaml": "title: T"}, full_clouds=False)
    recorder.flangeye_run_started(source=t.Source("hash"), total=0)
    for step, value in (("5.scan.file", SCAN), ("6.seam.cad", SEAM)):
        recorder.flangeye_stage_finished(step=step, capture=None, value=value, seconds=0.1)
    recorder.close()
    return read_run(tmp_path / "run.mcap")


def test_the_report_shows_cloud_seam_tube_and_truth(log: Any) -> None:
    view = seam_view(Facts(log, cast(r.Result, SimpleNamespace(seam=None)), ""))
    assert [trace["name"] for trace in view.space["data"]] == [
        "scan", "tube, 95 % × 25", "planned seam", "towards the torch", "start", "true seam",
    ]  # fmt: skip
    assert [trace["name"] for trace in view.profile["data"]] == ["tube, 95 %", "true error"]
    assert view.summary.startswith("CAD plate on a scan: 200.0 mm long. With 95 % probability")
    assert ("Half angle of the groove", "40.0°") in view.facts


def test_the_page_has_the_section_even_of_a_run_that_did_not_end(log: Any) -> None:
    page = render(log)
    assert '<h2 id="seam">The planned seam</h2>' in page


def test_the_result_has_the_tube_and_the_true_error() -> None:
    told = seam_result(SEAM, SCAN)
    assert told.tube == pytest.approx([TUBE] * 41, rel=1e-4)
    assert told.truth.rms == pytest.approx(1e-4)
    assert told.truth.inside == 1.0
    assert seam_result(None, None) is None
    assert seam_result(SEAM, None).truth is None


def test_the_terminal_tells_the_seam() -> None:
    result = r.Result(
        title="T", status="verified", transforms={}, observations=[], verifications={},
        seam=seam_result(SEAM, SCAN), timing={},
        provenance=r.Provenance(versions={}, plugins={}, recipe="", recipe_hash="", input_hash="",
                                seed=0, notes=[]),
    )  # fmt: skip
    out = io.StringIO()
    print_details(Console(file=out, width=120), result)
    assert out.getvalue().splitlines()[3:] == [
        "seam: CAD plate on a scan",
        "  from (500.0, 0.1, 270.0) to (700.0, 0.1, 270.0) mm in base, 200.000 mm along",
        "  tube               95 % within 0.245 mm of the plan",
        "  true error         0.100 mm rms, 0.100 mm at most, 100% of it inside the tube",
    ]

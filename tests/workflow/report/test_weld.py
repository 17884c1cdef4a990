"""The weld in the report: what is drawn is what was done."""

import base64
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flangeye import types as t
from flangeye.maths.seam_geometry import off_line
from flangeye.workflow.log.read import read_run
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.report.facts import Facts
from flangeye.workflow.report.page import render
from flangeye.workflow.report.weld import weld_drawing
from flangeye.workflow.result.contract import Result

TIME = np.linspace(0.0, 40.0, 401)
LINE = np.column_stack([np.linspace(0.5, 0.7, 201), np.zeros(201), np.full(201, 0.27)])
PHASES = ("seeking",) * 50 + ("following",) * 150 + ("bridging",) * 50 + ("ending",) * 151


def path(start, off):
    """Along x from ``start`` on at 5 mm/s, so far to the left [m]."""
    return np.column_stack([start + 5e-3 * TIME, np.full(401, off), np.full(401, 0.27)])


WELD = t.WeldReport(
    mode="tactile", completed=True, reason="", planned=LINE, refined=LINE + [0.0, 1e-3, 0.0],
    openings=np.tile([0.0, 0.0, 1.0], (201, 1)), time=TIME, tip=path(0.5, 1e-3), torch=path(0.46, 1.2e-3),
    robot=path(0.5, 3e-3), deflection=np.full(401, 2e-3), wanted=np.full(401, 2e-3),
    speed=np.full(401, 5e-3), turn=np.full(401, 0.1), along=5e-3 * TIME - 0.04, phases=PHASES,
    figures={"images": 600.0, "images_with_tag": 590.0},
    loop={"cycles": 20000.0, "computing_median": 2e-4, "computing_p99": 4.2e-4,
          "answering_median": 3e-4, "answering_p99": 6.1e-4,
          "period_median": 2e-3, "period_p99": 2.3e-3},
)  # fmt: skip
SCAN = t.WorkpieceScan(
    t.PointCloud(t.CAMERA, np.float32(LINE)), "a scan", (), {"groove": LINE + [0.0, 1.1e-3, 0.0]}
)


def facts(log):
    """Facts of a log alone."""
    return Facts(log, cast(Result, SimpleNamespace(weld=None)), "")


@pytest.fixture
def logged(tmp_path: Path) -> Callable[..., Any]:
    def write(weld, scan=SCAN):
        recorder = Recorder(tmp_path / "run.mcap", {"recipe.yaml": "title: T"}, False)
        recorder.flangeye_run_started(source=t.Source("hash"), total=0)
        for step, value in (("5.scan.file", scan), ("7.weld.tactile", weld)):
            if value is not None:
                recorder.flangeye_stage_finished(step=step, capture=None, value=value, seconds=0.1)
        recorder.close()
        return read_run(tmp_path / "run.mcap")

    return write


def numbers(packed):
    """The array that a trace carries."""
    return np.frombuffer(base64.b64decode(packed["bdata"]), dtype=packed["dtype"])


def traces(figure):
    return {trace["name"]: (numbers(trace["x"]), numbers(trace["y"])) for trace in figure["data"]}


def test_the_paths_are_those_of_plan_seam_robot_tip_and_torch(logged: Callable[..., Any]) -> None:
    drawn = traces(weld_drawing(facts(logged(WELD))).paths)
    assert list(drawn) == ["planned", "felt (refined)", "robot", "tip", "torch"]
    x, y = drawn["torch"]
    np.testing.assert_allclose([x[0], x[-1]], [-40.0, 160.0], atol=1e-3)
    np.testing.assert_allclose(y, 1.2, atol=1e-3)
    np.testing.assert_allclose(drawn["robot"][1], 3.0, atol=1e-3)


def test_the_deviation_is_the_torch_s_beside_the_seam(logged: Callable[..., Any]) -> None:
    drawn = traces(weld_drawing(facts(logged(WELD))).deviation)
    x, y = drawn["estimated torch, from the estimated seam"]
    assert x.min() >= 0.0
    np.testing.assert_allclose(y, 0.2, atol=1e-3)
    np.testing.assert_allclose(drawn["true torch, from the true seam"][1], 0.1, atol=1e-3)
    alone = traces(weld_drawing(facts(logged(WELD, scan=None))).deviation)
    assert list(alone) == ["estimated torch, from the estimated seam"]


def test_the_phases_are_bands_over_the_deflection(logged: Callable[..., Any]) -> None:
    layout = weld_drawing(facts(logged(WELD))).contact["layout"]
    assert [note["text"] for note in layout["annotations"]] == ["seeking", "bridging", "ending"]
    seeking, bridging, ending = [(band["x0"], band["x1"]) for band in layout["shapes"]]
    assert seeking == pytest.approx((0.0, 5.0))
    assert bridging == pytest.approx((20.0, 25.0))
    assert ending == pytest.approx((25.0, 40.0))


def test_speeds_and_the_loop_are_told_in_people_s_units(logged: Callable[..., Any]) -> None:
    drawing = weld_drawing(facts(logged(WELD)))
    speeds = traces(drawing.speeds)
    np.testing.assert_allclose(speeds["robot [mm/s]"][1], 5.0, rtol=1e-5)
    np.testing.assert_allclose(speeds["turning [deg/s]"][1], 5.73, rtol=1e-3)
    assert ("computing, 99 % below", "0.42 ms") in drawing.loop
    assert ("cycle start to command sent, 99 % below", "0.61 ms") in drawing.loop
    assert ("with the tag", "590") in drawing.loop


def test_the_page_says_why_a_weld_was_stopped(logged: Callable[..., Any]) -> None:
    stopped = replace(WELD, completed=False, reason="no tag was seen for 500 ms")
    page = render(logged(stopped))
    assert "The weld was stopped: no tag was seen for 500 ms." in page
    for name in ("paths", "offsets", "deviation", "contact", "speeds"):
        assert f"figure-weld-{name}" in page


def test_a_weld_that_felt_nothing_is_still_drawn(logged: Callable[..., Any]) -> None:
    nothing = replace(WELD, refined=np.zeros((0, 3)), mode="vision", loop={})
    drawing = weld_drawing(facts(logged(nothing)))
    assert list(traces(drawing.deviation)) == ["true torch, from the true seam"]
    assert [name for name, _ in drawing.loop] == ["images read", "with the tag"]


def test_a_run_without_a_weld(logged: Callable[..., Any]) -> None:
    assert weld_drawing(facts(logged(None))) is None


def test_a_line_goes_on_beyond_its_ends() -> None:
    corner = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    along, across = off_line(corner, np.array([[-0.5, 0.1], [0.5, -0.2], [0.9, 0.5], [1.1, 1.5]]))
    np.testing.assert_allclose(along, [-0.5, 0.5, 1.5, 2.5])
    np.testing.assert_allclose(across, [0.1, -0.2, 0.1, -0.1])


def test_believed_and_true_torch_are_shown_with_the_band(logged: Callable[..., Any]) -> None:
    band = np.full(len(WELD.torch), 0.3e-3)
    drawn = traces(
        weld_drawing(
            facts(logged(replace(WELD, band=band, true_torch=path(0.46, 1.4e-3))))
        ).deviation
    )
    np.testing.assert_allclose(drawn["estimated torch, from the estimated seam"][1], 0.2, atol=1e-3)
    np.testing.assert_allclose(drawn["true torch, from the true seam"][1], 0.3, atol=1e-3)
    np.testing.assert_allclose(drawn["95 % band"][1], 0.3, atol=1e-3)
    np.testing.assert_allclose(drawn["95 % band, right"][1], -0.3, atol=1e-3)

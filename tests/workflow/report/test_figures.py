"""The figures: accepted by plotly, true to the numbers, small enough."""

from __future__ import annotations

import json
import re
from base64 import b64decode
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye import types as t
from flangeye.models.bodies import load_body
from flangeye.types.geometry import rigid
from flangeye.workflow.log.read import RunLog
from flangeye.workflow.report import write_report
from flangeye.workflow.report.cell import cell_drawing, cloud_panels, found_body
from flangeye.workflow.report.facts import Facts, facts_of
from flangeye.workflow.report.page import render
from flangeye.workflow.report.plot import (
    box_edges,
    figure3d,
    joined,
    packed,
    plain,
    round_up,
    scatter3d,
)
from flangeye.workflow.report.residuals import errors_of, residual_figure
from flangeye.workflow.report.space import workspace_drawing

Make = Callable[..., RunLog]


def unpacked(values: Any) -> Any:
    return np.frombuffer(b64decode(values["bdata"]), dtype="<f4")


def test_plotly_accepts_every_figure(make_run: Make) -> None:
    import plotly.graph_objects as go

    log = make_run(outliers={"pose-08": "too far"})
    page = render(log)
    figures = re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', page, re.S)
    assert len(figures) == 6
    for figure in figures:
        go.Figure(json.loads(figure))  # raises at the first unknown or wrong attribute


def test_the_page_is_small(make_run: Make, tmp_path: Path) -> None:
    log = make_run(ids=[f"pose-{i}" for i in range(60)], points=4500)
    path = tmp_path / "report.html"
    write_report(log, path)
    assert path.stat().st_size < 8_000_000


def test_the_page_holds_at_most_20000_points(make_run: Make) -> None:
    log = make_run(ids=[f"pose-{i}" for i in range(10)], points=9000)
    figures = re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', render(log), re.S)
    count = sum(
        len(unpacked(trace["x"]))
        for figure in figures
        for trace in json.loads(figure)["data"]
        if trace["type"] == "scatter3d" and "markers" in trace["mode"]
    )
    assert 15_000 < count <= 20_000


def test_the_same_log_gives_the_same_page(make_run: Make) -> None:
    log = make_run(points=6000)
    assert render(log) == render(log)


def test_bars_are_the_residuals_in_mm_in_the_order_of_capture(make_run: Make) -> None:
    errors = errors_of(facts_of(make_run(outliers={"pose-08": "too far"})))
    figure = residual_figure(errors)
    assert figure is not None
    used, unused, held = figure["data"]
    assert used["x"] == [f"pose-{i:02}" for i in range(12) if i != 8]
    np.testing.assert_allclose(used["y"], [1e3 * errors.residuals[i] for i in used["x"]], atol=1e-6)
    assert unused["x"] == ["pose-08"]
    assert len(held["x"]) == 12


def test_a_bar_that_dwarfs_the_others_is_cut_and_says_its_length(make_run: Make) -> None:
    errors = errors_of(facts_of(make_run(outliers={"pose-08": "too far"})))
    figure = residual_figure(errors)
    assert figure is not None
    assert figure["layout"]["yaxis"]["range"][1] < 1.0
    (note,) = figure["layout"]["annotations"]
    assert note["x"] == "pose-08"
    assert 39 < float(note["text"].removesuffix("↑")) < 41
    assert errors.summary.endswith("cut off and labelled with their length.")


def test_long_ids_that_start_alike_keep_labels_of_their_own(make_run: Make) -> None:
    ids = [f"tool0_{'1' * 30}{i}_{'2' * 30}" for i in range(5)]
    figure = residual_figure(errors_of(facts_of(make_run(ids=ids))))
    assert figure is not None
    assert len(set(figure["layout"]["xaxis"]["categoryarray"])) == 5


def test_predicted_errors_are_those_of_the_covariance(make_run: Make) -> None:
    from flangeye.types.geometry import covariance_at

    facts = facts_of(make_run())
    drawing = workspace_drawing(facts)
    assert drawing is not None
    estimate = facts.result.transforms["base_T_camera"]
    grid = drawing.figure["data"][0]
    at = np.stack([unpacked(grid[axis]) for axis in "xyz"], axis=1) * 1e-3
    expected = covariance_at(np.array(estimate.covariance), np.array(estimate.about), at)
    colours = unpacked(grid["marker"]["color"])
    sigma = np.sqrt(np.trace(expected, axis1=1, axis2=2))
    np.testing.assert_allclose(colours, sigma * 1e3, rtol=1e-4)


def test_true_errors_point_from_where_points_are_to_where_they_are_mapped(make_run: Make) -> None:
    facts = facts_of(make_run())
    drawing, truth, matrix = workspace_drawing(facts), facts.result.truth, facts.base_T_camera
    assert drawing is not None
    assert truth is not None
    assert matrix is not None
    arrows = drawing.figure["data"][-1]
    scale = float(arrows["name"].rpartition(" ")[2])
    xyz = np.stack([unpacked(arrows[axis]) for axis in "xyz"], axis=1).reshape(-1, 3, 3) * 1e-3
    start, end = xyz[:, 0], xyz[:, 1]
    seen = (start - np.array(truth.base_T_camera)[:3, 3]) @ np.array(truth.base_T_camera)[:3, :3]
    mapped = seen @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose((end - start) / scale, mapped - start, atol=1e-6)
    assert np.isnan(xyz[:, 2]).all()  # the gap between one line and the next


def test_panels_show_the_best_the_median_and_the_worst(make_run: Make) -> None:
    facts = facts_of(make_run(outliers={"pose-08": "too far"}))
    panels = cloud_panels(facts)
    ranked = sorted(facts.residuals, key=lambda i: facts.residuals[i])
    assert [p.id for p in panels] == [ranked[0], ranked[6], "pose-08"]
    assert [p.why for p in panels] == ["smallest residual", "median residual", "largest residual"]
    shown = dict(panels[0].facts)
    assert shown["Points"] == "3\u202f000 (3\u202f000 shown)"
    assert shown["Radius, rim"] == "30.50 mm"


def test_panels_are_in_the_axes_of_the_circle(make_run: Make) -> None:
    cloud, fit = cloud_panels(facts_of(make_run()))[0].figure["data"]
    xyz = np.stack([unpacked(cloud[axis]) for axis in "xyz"], axis=1)
    assert np.abs(xyz[:, 2]).mean() < 0.5  # mm off the plane
    radius = np.linalg.norm(xyz[:, :2], axis=1)
    assert 16 < radius.min() < radius.max() < 31
    np.testing.assert_array_equal(unpacked(cloud["marker"]["color"]), xyz[:, 2])
    assert np.nanmax(unpacked(fit["z"])) > 29  # the normal, towards the scanner


def test_one_capture_is_one_panel(make_run: Make) -> None:
    log = make_run(ids=("only",), solved=False, refused="fewer than three poses")
    assert [p.why for p in cloud_panels(facts_of(log))] == ["the only capture"]


def test_the_cell_holds_scan_flanges_circles_and_both_frames(make_run: Make) -> None:
    drawing = cell_drawing(facts_of(make_run()))
    assert drawing is not None
    names = [trace.get("name") for trace in drawing.figure["data"]]
    assert {"flange, used", "flange clouds", "scan pose-00", "fitted circles"} <= set(names)
    labels = [trace["text"][0] for trace in drawing.figure["data"] if trace["mode"] == "text"]
    assert labels == ["base", "camera"]


def test_scales_are_equal_and_the_longest_side_fills_the_view() -> None:
    xyz = np.array([[0.0, 0.0, 0.0], [0.1, 0.2, 1.0]])
    scene = figure3d([scatter3d(xyz, "markers")])["layout"]["scene"]
    ranges = np.array([np.ptp(scene[f"{axis}axis"]["range"]) for axis in "xyz"])
    ratio = np.array([scene["aspectratio"][axis] for axis in "xyz"])
    np.testing.assert_allclose(ranges / ratio, ranges[0] / ratio[0])
    assert ratio.max() == 1.25


def test_pieces() -> None:
    np.testing.assert_array_equal(unpacked(packed([1.5, 2.5])), [1.5, 2.5])
    assert plain("<b>a&b</b>") == "&lt;b&gt;a&amp;b&lt;/b&gt;"
    assert plain("0123456789", 6) == "012…89"
    assert joined([]).shape == (0, 3)
    edges = box_edges(np.zeros(3), np.array([1.0, 2.0, 3.0]))
    lengths = [float(np.linalg.norm(b - a)) for a, b in edges]
    assert sorted(lengths) == [1.0] * 4 + [2.0] * 4 + [3.0] * 4
    assert [round_up(x) for x in (0.9, 1.0, 1.1, 2.3, 7.0, 120.0)] == [1, 1, 2, 5, 10, 200]


def test_a_body_is_drawn_where_it_was_found_first() -> None:
    body, pose = load_body("gripper", None, Path()), rigid(np.eye(3), np.array([0.1, 0.2, 0.9]))
    feature = t.PoseFeature(t.Transform(t.CAMERA, t.TARGET, pose), 1e-8 * np.eye(6))
    flange = {t.FLANGE: t.Transform(t.BASE, t.FLANGE, np.eye(4))}
    seen = [t.Observation(name, feature, flange) for name in ("03", "04")]
    log: Any = SimpleNamespace(observations=lambda: seen, models={})
    result: Any = None
    found = found_body(Facts(log, result, "target: {body: gripper, at: flange}"))
    assert found is not None
    assert (found.name, found.capture) == ("gripper", "03")
    extent = np.ptp(found.edges.reshape(-1, 3), axis=0)
    assert extent == pytest.approx(np.ptp(body.vertices, axis=0), rel=0.02)
    assert found.edges.reshape(-1, 3).mean(axis=0) == pytest.approx(pose[:3, 3], abs=body.size)
    other = Facts(log, result, "target: {body: of-another-version, at: flange}")
    assert found_body(other) is None

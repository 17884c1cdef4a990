"""Finding the flange in simulated cells, and saying why when it cannot be found."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.plugin.registry import load_registry
from flangeye.workflow.recipe.load import parse_recipe
from flangeye_plugins.segment.discs import in_box
from flangeye_plugins.segment.flange import SegmentParams, segment_flange
from flangeye_plugins.segment.grid import coarse_view
from tests.plugins.fixed import fixed

RECIPE = """\
title: Segmentation
robot: {model: ur5}
scanner: {model: phoxi-m}
steps:
  - acquire.simulated: {resolution: 0.4, arm: {quality: exact}, verification: 0, outliers: OUT}
  - segment.flange
  - fit.rim
  - solve.svd
"""


@pytest.fixture(scope="module")
def cell() -> Any:
    """Six scans of a simulated cell, the flange to look for, and the camera's true pose."""
    return scans(0.0, 6)


def scans(outliers, count):
    recipe = parse_recipe(RECIPE.replace("OUT", str(outliers)), "r", load_registry())
    step = recipe.steps[0]
    asked = {n: recipe.context.get(need) for n, need in step.stage.needs.items()}
    stream = step.stage(**asked, params=step.params)
    captures = [capture for _, capture in zip(range(count), stream, strict=False)]
    flange = next(v for k, v in recipe.context.items() if k.__name__ == "Flange")
    return captures, flange, stream.source.truth.camera


def found(capture, flange, **params):
    return segment_flange(capture, flange, fixed(SegmentParams, **params))


def test_the_flange_is_found_where_it_is(cell: Any) -> None:
    captures, flange, base_T_camera = cell
    for capture in captures:
        cloud = found(capture, flange)
        assert isinstance(cloud, t.FlangeCloud), cloud
        truth = base_T_camera.inverse().apply(capture.base_T_flange.translation)
        assert np.linalg.norm(cloud.centre - truth) < 3e-3
        assert cloud.normal @ cloud.centre < 0
        reach = np.linalg.norm(cloud.cloud.xyz - cloud.centre, axis=1).max()
        assert reach < flange.outer + 6e-3


def test_an_unorganised_scan_gives_the_same_disc(cell: Any) -> None:
    captures, flange, _ = cell
    capture = captures[0]
    loose = replace(capture, cloud=t.PointCloud(t.CAMERA, capture.cloud.points()))
    first, second = found(capture, flange), found(loose, flange)
    assert np.linalg.norm(first.centre - second.centre) < 1e-3


def test_a_segmented_flange_is_found_again(cell: Any) -> None:
    captures, flange, _ = cell
    cloud = found(captures[0], flange)
    again = found(replace(captures[0], cloud=cloud.cloud), flange)
    assert isinstance(again, t.FlangeCloud)
    assert np.linalg.norm(cloud.centre - again.centre) < 1e-3


def test_it_is_the_same_every_time(cell: Any) -> None:
    captures, flange, _ = cell
    first, second = found(captures[1], flange), found(captures[1], flange)
    assert np.array_equal(first.cloud.xyz, second.cloud.xyz)


def test_a_covered_flange_is_not_mistaken_for_another_disc() -> None:
    captures, flange, base_T_camera = scans(1.0, 4)
    for capture in captures:
        cloud = found(capture, flange)
        if isinstance(cloud, t.FlangeCloud):
            truth = base_T_camera.inverse().apply(capture.base_T_flange.translation)
            assert np.linalg.norm(cloud.centre - truth) < 5e-3
        else:
            assert cloud.reason


def test_the_reasons(cell: Any) -> None:
    captures, flange, _ = cell
    capture = captures[0]
    nothing = replace(capture, cloud=t.PointCloud(t.CAMERA, np.full((50, 60, 3), np.nan)))
    assert found(nothing, flange).reason == "no finite point"
    assert found(capture, flange, far="150 mm").reason.startswith(
        "no point between near 100 mm and far 150 mm: depths from "
    )
    steep = found(capture, flange, max_incidence=np.radians(0.5)).reason
    assert "incidence" in steep
    table = np.stack(
        [
            *np.meshgrid(np.linspace(-0.3, 0.3, 300), np.linspace(-0.3, 0.3, 300)),
            np.ones((300, 300)),
        ],
        axis=-1,
    )
    plane = replace(capture, cloud=t.PointCloud(t.CAMERA, table))
    assert "mm" in found(plane, flange).reason


def test_millimetres_are_named(cell: Any) -> None:
    captures, flange, _ = cell
    far_off = t.PointCloud(t.CAMERA, 1e3 * captures[0].cloud.xyz)
    with pytest.raises(StageError, match="millimetres"):
        found(replace(captures[0], cloud=far_off), flange)


def test_only_the_window_about_the_disc_is_read_and_nothing_is_missed(cell: Any) -> None:
    captures, flange, _ = cell
    for capture in captures:
        view = coarse_view(capture.cloud.xyz, flange.rim / 15)
        cloud = found(capture, flange)
        near = np.linalg.norm(view.xyz - cloud.centre, axis=-1)
        row, column = map(int, np.unravel_index(np.nanargmin(near), near.shape))
        reach = flange.outer + 2e-3
        window = view.about((row, column), cloud.centre, reach, capture.cloud.xyz)
        whole = capture.cloud.xyz.reshape(-1, 3)
        assert len(window) < 0.5 * len(whole)
        assert np.array_equal(
            in_box(window, cloud.centre, reach), in_box(whole, cloud.centre, reach)
        )

"""A planned seam: its log, its frames, its tube."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import types as t
from flangeye.maths.seam_geometry import (
    distances_to_line,
    seam_frames,
    torch_deviation,
    tube_radii,
    tube_rings,
)
from flangeye.workflow.log.read import _messages, read_run
from flangeye.workflow.log.record import Recorder


def a_seam():
    """A curved seam of 5 points with a cloud around it."""
    along = np.linspace(0.0, 0.1, 5)
    points = np.column_stack([0.5 + along, along**2, 0.3 + 0 * along])
    covariance = np.tile(np.diag([1e-8, 4e-8, 9e-8]), (5, 1, 1))
    cloud = t.PointCloud(t.BASE, np.float32(points))
    up = np.tile([0.0, 0.0, 1.0], (5, 1))
    return t.Seam(points, up, covariance, 0.7, 0.008, "test", {"rms": 1e-4}, ("note",), cloud)


def test_a_seam_is_read_back_as_it_was(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mcap", {"recipe.yaml": ""}, full_clouds=False)
    seam, scan = a_seam(), t.WorkpieceScan(a_seam().cloud, "file", (), {"V": np.eye(3)})
    for step, value in (("5.scan.file", scan), ("6.seam.cad", seam)):
        recorder.flangeye_stage_finished(step=step, capture=None, value=value, seconds=0.1)
    recorder.close()
    log = read_run(tmp_path / "run.mcap")
    again = log.last(t.Seam)
    for name in ("points_in_base", "openings_in_base", "covariance"):
        assert np.array_equal(getattr(again, name), getattr(seam, name))
    assert (again.half_angle, again.half_width, again.source) == (0.7, 0.008, "test")
    assert again.cloud.frame == t.BASE
    assert np.array_equal(again.cloud.xyz, seam.cloud.xyz)
    assert np.array_equal(log.last(t.WorkpieceScan).truth["V"], np.eye(3))
    schemas = {m.channel.topic: m.channel.schema for m in _messages(tmp_path / "run.mcap")}
    assert schemas["/scene"] == "foxglove.SceneUpdate"
    assert schemas["/seam"] == "foxglove.PosesInFrame"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points_in_base": np.zeros((5, 3))}, "each at another place than the last"),
        ({"openings_in_base": 2 * a_seam().openings_in_base}, "are not unit vectors"),
        ({"covariance": np.zeros((5, 2))}, "Seam.covariance has shape"),
    ],
)
def test_a_seam_that_is_none_is_not_made(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(a_seam(), **change)


def test_the_frames_of_a_seam_are_right_handed_and_look_into_the_groove() -> None:
    seam = a_seam()
    frames = seam_frames(seam)
    assert np.allclose(frames @ frames.transpose(0, 2, 1), np.eye(3))
    assert np.allclose(np.linalg.det(frames), 1.0)
    assert np.allclose(frames[:, :, 0], seam.tangents)
    assert (frames[:, 2, 2] < -0.99).all()


def test_a_tube_is_as_wide_as_the_uncertainty_across_the_seam() -> None:
    straight = np.column_stack([np.linspace(0, 1, 3), np.zeros(3), np.zeros(3)])
    seam = a_seam()
    seam = replace(seam, points_in_base=straight, openings_in_base=seam.openings_in_base[:3],
                   covariance=np.tile(np.diag([1.0, 4e-8, 1e-8]), (3, 1, 1)))  # fmt: skip
    assert tube_radii(seam) == pytest.approx(2e-4 * np.sqrt(5.991), rel=1e-3)
    rings = tube_rings(seam)
    assert np.allclose(np.linalg.norm(rings - straight[:, None], axis=2), tube_radii(seam)[0])


def test_the_distance_from_a_line_is_that_from_its_nearest_piece() -> None:
    line = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    points = np.array([[0.5, 0, 0.2], [2, 0.5, 0], [-3, 0, 4]])
    assert distances_to_line(points, line) == pytest.approx([0.2, 1.0, 5.0])


def test_the_torch_is_measured_across_the_opening_and_only_beside_the_seam() -> None:
    line = np.array([[0.0, 0, 0], [0.1, 0, 0]])
    points = np.array([[-0.01, 0, 0], [0.05, 2e-3, 7e-3], [0.2, 0, 0]])
    found = torch_deviation(points, line, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(found, [2e-3])

"""A stored calibration, and later runs of the same cell with something moved."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from flangeye import types as t
from flangeye.types.geometry import rigid, rotation_exp
from flangeye.workflow.log.record import Recorder
from tests.workflow.report.conftest import RECIPE, TRUTH, WORKSPACE, Script, _pose, scripted

STATIONS = [_pose(np.random.default_rng(k)) for k in (11, 12, 13)]


def calibrate(folder: Path, recipe: str = RECIPE) -> Path:
    """Record a calibration and return its folder."""
    folder.mkdir()
    ids = tuple(f"{i:02}" for i in range(30))
    scripted(Script(points=50, ids=ids, recipe=recipe), folder / "run.mcap")
    return folder


def check(
    folder: Path, seed: int, shift=(0.0, 0.0, 0.0), noise: float = 4e-5, misfit: float = 0.0,
    recipe: str = "title: x", began_ns: int = 10**18,
) -> Path:  # fmt: skip
    """Record a check: three scans, the scanner shifted by ``shift`` in base [m].

    In the second one something else was found, by ``misfit`` aside [m]. The first check ever began
    at ``began_ns``; 0: no time is known.
    """
    folder.mkdir()
    rng = np.random.default_rng(seed)
    recorder = Recorder(folder / "run.mcap", {"recipe.resolved.yaml": recipe}, False)
    recorder.flangeye_run_started(source=t.Source("sha256:0"), total=3)
    camera = t.Transform(t.BASE, t.CAMERA, rigid(np.eye(3), np.array(shift)) @ TRUTH.matrix)
    for i, pose in enumerate(STATIONS):
        name = f"scan-{i}"
        cloud = t.PointCloud(t.CAMERA, np.zeros((1, 3), np.float32))
        when = began_ns + seed * 8 * 3600 * 10**9 + i if began_ns else 0
        capture = t.Capture(name, cloud, t.by_frame(pose), time_ns=when)
        circle = _circle(camera.inverse() @ pose, rng, noise)
        if i == 1:
            circle = replace(circle, centre=circle.centre + [misfit, 0.0, 0.0])
        recorder.flangeye_captured(step="0.acquire.live", capture=capture, seconds=0.1)
        recorder.flangeye_stage_finished(step="2.fit.rim", value=circle, capture=name, seconds=0.0)
        recorder.flangeye_capture_finished(capture=name)
    recorder.close()
    return folder


def part_of_sample(folder: Path, ids: range) -> Path:
    """Copy some of the sample's scans and their poses."""
    sample = Path(__file__).parents[4] / "data" / "samples" / "ur5_phoxi-m"
    head, *rows = (sample / "poses.csv").read_text().splitlines()
    folder.mkdir()
    (folder / "poses.csv").write_text("\n".join([head, *(rows[i] for i in ids)]))
    for i in ids:
        shutil.copy(sample / f"{i:04}.pcd", folder)
    return folder


def _circle(seen: t.Transform, rng: np.random.Generator, noise: float) -> t.CircleFeature:
    normal = rotation_exp(rng.normal(0, 3e-4, 3)) @ seen.rotation[:, 2]
    across = np.eye(3) - np.outer(normal, normal)
    return t.CircleFeature(
        seen.translation + rng.normal(0, noise, 3), normal, {}, noise**2 * np.eye(3),
        9e-8 * across, 0.9,
    )  # fmt: skip


__all__ = ["STATIONS", "TRUTH", "WORKSPACE", "calibrate", "check", "part_of_sample"]

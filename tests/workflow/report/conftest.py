"""Small runs, logged by the engine's own recorder and read back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import types as t
from flangeye.types.geometry import (
    basis_of_plane,
    kabsch,
    kabsch_covariance,
    rigid,
    rotation_from_rpy,
)
from flangeye.workflow.log.read import RunLog, read_run
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.result import contract as r
from flangeye.workflow.result import sections

RIM, BORE = 0.0305, 0.0164
TRUTH = t.Transform(
    t.BASE, t.CAMERA, rigid(rotation_from_rpy(np.pi - 0.2, 0.1, 0.5), np.array([0.5, -0.1, 1.1]))
)
WORKSPACE = t.Box(np.array([0.45, 0.0, 0.4]), np.array([0.3, 0.3, 0.2]))
RECIPE = """title: A test
workspace: {centre: [450 mm, 0 mm, 400 mm], size: [300 mm, 300 mm, 200 mm]}
seed: 7
steps: [acquire.simulated, segment.flange, fit.rim, solve.svd, verify.holdout]
"""


@dataclass
class Script:
    """What happens in a run; change what a test is about."""

    ids: Sequence[str] = tuple(f"pose-{i:02}" for i in range(12))
    title: str = "UR5 and PhoXi M, simulated"
    recipe: str = RECIPE
    rejected: dict[str, str] = field(default_factory=dict)
    outliers: dict[str, str] = field(default_factory=dict)
    clouds: bool = True
    solved: bool = True
    verified: bool | None = True
    refused: str | None = None
    truth: bool = True
    finished: bool = True
    points: int = 3000
    note: str = "two scans were empty"


def scripted(script: Script, path: Path) -> RunLog:
    """Log the run and read it back."""
    recorder = Recorder(path, {"recipe.resolved.yaml": script.recipe}, full_clouds=False)
    truth = t.Truth(TRUTH) if script.truth else None
    source = t.Source(
        "sha256:0123",
        (script.note,),
        WORKSPACE,
        truth,
    )
    recorder.flangeye_run_started(source=source, total=len(script.ids))
    observations, rejections = _captures(script, recorder)
    calibration = _solve(script, observations, recorder)
    verifications = _verify(script, calibration, recorder)
    if script.finished:
        result = _result(script, source, calibration, observations, rejections, verifications)
        recorder.flangeye_run_finished(result=result.model_dump(mode="json"))
    else:
        recorder.close()
    return read_run(path)


def _captures(script: Script, recorder: Recorder) -> tuple[list[t.Observation], list[t.Rejection]]:
    rng = np.random.default_rng(1)
    observations, rejections = [], []
    for i, capture_id in enumerate(script.ids):
        pose = _pose(rng)
        circle, cloud = _seen(pose, rng, script.points)
        if capture_id in script.outliers:
            circle = _moved(circle, [0.0, 0.04, 0.0])
        capture = t.Capture(
            capture_id, _scan(cloud, rng), t.by_frame(pose), time_ns=10**18 + i * 10**9
        )
        if script.clouds:
            recorder.flangeye_captured(step="0.acquire.simulated", capture=capture, seconds=0.1)
        if capture_id in script.rejected:
            stage, _, reason = script.rejected[capture_id].partition(": ")
            rejections.append(t.Rejection(capture_id, stage, reason))
            recorder.flangeye_capture_rejected(rejection=rejections[-1])
        else:
            observations.append(t.Observation(capture_id, circle, t.by_frame(pose)))
            _log_observation(script, recorder, observations[-1], cloud)
        recorder.flangeye_capture_finished(capture=capture_id)
    return observations, rejections


def _log_observation(
    script: Script, recorder: Recorder, found: t.Observation, cloud: t.PointCloud
) -> None:
    given: dict[str, Any] = {"capture": found.id, "seconds": 0.02}
    if not script.clouds:
        recorder.flangeye_stage_finished(step="0.acquire.archive", value=found, **given)
        return
    assert found.circle.normal is not None
    flange = t.FlangeCloud(cloud, found.circle.centre, found.circle.normal)
    recorder.flangeye_stage_finished(step="1.segment.flange", value=flange, **given)
    recorder.flangeye_stage_finished(step="2.fit.rim", value=found.circle, **given)


def _pose(rng: np.random.Generator) -> t.Transform:
    down = rotation_from_rpy(*rng.uniform(-0.3, 0.3, 3))
    at = WORKSPACE.centre + rng.uniform(-0.5, 0.5, 3) * WORKSPACE.size
    return t.Transform(t.BASE, t.FLANGE, rigid(down, at))


def _seen(
    pose: t.Transform, rng: np.random.Generator, n: int
) -> tuple[t.CircleFeature, t.PointCloud]:
    """Return circle and cloud of a flange with bore and four holes, with noise."""
    camera_T_flange = TRUTH.inverse() @ pose
    radius = np.sqrt(rng.uniform(BORE**2, RIM**2, 2 * n))
    angle = rng.uniform(0, 2 * np.pi, 2 * n)
    disc = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    holes = 0.025 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) / np.sqrt(2)
    clear = (np.linalg.norm(disc[:, None] - holes, axis=2) > 0.0033).all(axis=1)
    disc = disc[clear][:n]
    xyz = np.column_stack([disc, rng.normal(0, 5e-5, len(disc))])
    centre = camera_T_flange.translation + rng.normal(0, 1.5e-4, 3)
    normal = camera_T_flange.rotation[:, 2]
    axes = basis_of_plane(normal)
    spread = axes.T @ np.diag([1, 1, 0]) @ axes
    circle = t.CircleFeature(
        centre, normal, {"rim": RIM, "bore": BORE}, 1e-8 * np.eye(3), 1e-6 * spread, 0.93
    )
    return circle, t.PointCloud(t.CAMERA, camera_T_flange.apply(xyz).astype(np.float32))


def _scan(flange: t.PointCloud, rng: np.random.Generator) -> t.PointCloud:
    """Return the flange with a piece of table behind it."""
    table = np.column_stack([rng.uniform(-0.3, 0.3, (4000, 2)), np.full(4000, 1.0)])
    return t.PointCloud(t.CAMERA, np.concatenate([flange.xyz, table.astype(np.float32)]))


def _moved(circle: t.CircleFeature, by: Any) -> t.CircleFeature:
    return t.CircleFeature(
        circle.centre + by, circle.normal, circle.radii, circle.covariance,
        circle.normal_covariance, circle.arc_coverage,
    )  # fmt: skip


def _solve(
    script: Script, observations: Sequence[t.Observation], recorder: Recorder
) -> t.HandEye | None:
    if not script.solved:
        return None
    good = [o for o in observations if o.id not in script.outliers]
    centres = np.array([o.circle.centre for o in good])
    tcps = np.array([o.tcp_in_base for o in good])
    pose = t.Transform(t.BASE, t.CAMERA, rigid(*kabsch(centres, tcps)))
    pairs = tuple(
        t.Pair(o, pose.apply(o.circle.centre) - o.tcp_in_base, o in good, script.outliers.get(o.id))
        for o in observations
    )
    estimate = t.TransformEstimate(pose, kabsch_covariance(tcps, 2e-4), tcps.mean(axis=0))
    calibration = t.HandEye(estimate, pairs, "solve.svd", ("the solver is content",))
    recorder.flangeye_stage_finished(
        step="3.solve.svd", capture=None, value=calibration, seconds=0.001
    )
    return calibration


def _verify(
    script: Script, calibration: t.HandEye | None, recorder: Recorder
) -> dict[str, t.Verification]:
    if calibration is None or script.verified is None:
        return {}
    errors = {p.observation.id: 1.2 * float(np.linalg.norm(p.residual)) for p in calibration.pairs}
    figures = {"folds": 5.0, "rms": 3.12e-4, "median": 2.4e-4, "p95": 5.51e-4, "max": 6.1e-4}
    reason = "held-out error 0.312 mm rms, within the limit of 1 mm"
    found = t.Verification(script.verified, reason, figures, errors)
    recorder.flangeye_stage_finished(
        step="4.verify.holdout", capture=None, value=found, seconds=0.03
    )
    return {"4.verify.holdout": found}


def _result(
    script: Script,
    source: t.Source,
    calibration: t.HandEye | None,
    observations: Sequence[t.Observation],
    rejections: Sequence[t.Rejection],
    verifications: dict[str, t.Verification],
) -> r.Result:
    unsolved = [
        t.Pair(o, np.zeros(3), used=False, reason="refused before solving") for o in observations
    ]
    pairs = calibration.pairs if calibration else unsolved
    status = "refused" if script.refused else "verified" if script.verified else "unverified"
    return r.Result(
        title=script.title,
        status=status,
        refused=script.refused,
        method=calibration.method if calibration else None,
        transforms=sections.transforms_result(calibration),
        observations=sections.observations_result(pairs, rejections),
        workspace=sections.workspace_result(WORKSPACE) if calibration else None,
        holdout=sections.holdout_result(verifications),
        verifications={
            k: r.VerificationResult(
                passed=v.passed, reason=v.reason, figures=dict(v.figures), errors=dict(v.errors)
            )
            for k, v in verifications.items()
        },
        truth=sections.truth_result(calibration, t.Truth(TRUTH), WORKSPACE)
        if calibration and source.truth
        else None,
        timing={"2.fit.rim": r.StageTiming(seconds=0.36, calls=12)},
        provenance=r.Provenance(
            versions={"flangeye": "0.1.0", "numpy": "2.0"}, plugins={"builtin": "0.1.0"},
            recipe="test", recipe_hash="ab" * 32, input_hash=source.fingerprint, seed=7,
            notes=[*source.notes],
        ),
    )  # fmt: skip


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., RunLog]:
    """Return a function that logs a run; keywords are the fields of :class:`Script`."""

    def make(**changes: Any) -> RunLog:
        return scripted(Script(**changes), tmp_path / "run.mcap")

    return make

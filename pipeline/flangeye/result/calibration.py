"""The sections that tell of the calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flangeye import types as t
from flangeye.geometry import covariance_at, rotation_log
from flangeye.result.contract import (
    CorrectionResult,
    HoldoutResult,
    ObservationResult,
    TransformErrorResult,
    TransformResult,
    TruthResult,
    VerificationResult,
    WorkspaceResult,
)


def transforms_result(calibration: t.HandEye | None) -> dict[str, TransformResult]:
    """Return the section ``transforms``."""
    if calibration is None:
        return {}
    return {name: _transform(x) for name, x in calibration.transforms.items()}


def _transform(estimate: t.TransformEstimate) -> TransformResult:
    return TransformResult(
        matrix=estimate.transform.matrix.tolist(),
        covariance=estimate.covariance.tolist(),
        about=estimate.about.tolist(),
        unobservable=estimate.unobservable.tolist() if len(estimate.unobservable) else None,
    )


def correction_result(calibration: t.HandEye | None) -> CorrectionResult | None:
    """Return the section ``correction``."""
    correction = calibration.correction if calibration else None
    if correction is None:
        return None
    offsets = correction.joint_offsets
    return CorrectionResult(
        tool_offset=correction.tool_offset.tolist(),
        joint_offsets=None if offsets is None else offsets.tolist(),
    )


def observations_result(
    pairs: Sequence[t.Pair], rejections: Sequence[t.Rejection]
) -> list[ObservationResult]:
    """Return the section ``observations``: every capture, those set aside early included."""
    early = [
        ObservationResult(id=r.id, used=False, reason=f"{r.stage}: {r.reason}") for r in rejections
    ]
    return sorted([*map(_observation, pairs), *early], key=lambda o: o.id)


def _observation(pair: t.Pair) -> ObservationResult:
    feature = pair.observation.feature
    circle = feature if isinstance(feature, t.CircleFeature) else None
    return ObservationResult(
        id=pair.observation.id,
        centre_in_camera=feature.centre.tolist(),
        normal_in_camera=None if feature.normal is None else feature.normal.tolist(),
        radii=dict(circle.radii) if circle else None,
        covariance=feature.centre_covariance.tolist(),
        arc_coverage=circle.arc_coverage if circle else None,
        clocking=circle.clocking if circle else None,
        tcp_in_base=pair.observation.tcp_in_base.tolist(),
        residual=float(np.linalg.norm(pair.residual)),
        residual_in_base=pair.residual.tolist(),
        used=pair.used,
        reason=pair.reason,
    )


def workspace_result(calibration: t.HandEye, box: t.Box) -> WorkspaceResult:
    """Return the error to expect over ``box``, from the estimate's covariance alone."""
    estimate = calibration.camera
    covariances = covariance_at(estimate.covariance, estimate.about, box.grid())
    return WorkspaceResult(
        centre=box.centre.tolist(),
        size=box.size.tolist(),
        predicted_rms=float(np.sqrt(np.trace(covariances, axis1=1, axis2=2).mean())),
        predicted_p95=_p95_of_gaussians(covariances),
    )


def _p95_of_gaussians(covariances: t.Array, draws: int = 400) -> float:
    """Return the 95th percentile of |x| over zero-mean Gaussians (N, 3, 3), by fixed draws."""
    unit = np.random.default_rng(0).standard_normal((draws, 3))
    values, vectors = np.linalg.eigh(covariances)
    roots = vectors * np.sqrt(np.maximum(values, 0))[:, None, :]
    return float(np.quantile(np.linalg.norm(roots @ unit.T, axis=1), 0.95))


def truth_result(calibration: t.HandEye, truth: t.Truth, box: t.Box) -> TruthResult:
    """Return how far the estimate maps points of the workspace from where they are.

    What is marked as unobservable does not count.
    """
    error = calibration.camera.transform.matrix @ truth.camera.inverse().matrix
    known = {x.name: x for x in (truth.camera, *truth.others)}
    free = calibration.camera.unobservable[:, 3:]
    found = calibration.transforms
    return TruthResult(
        base_T_camera=truth.camera.matrix.tolist() if truth.camera.parent == t.BASE else None,
        transforms={name: x.matrix.tolist() for name, x in known.items()},
        errors={name: _error(found[name], known[name]) for name in found if name in known},
        error_at_centroid=float(_displacement(error, box.centre, free)),
        rms_over_workspace=float(np.sqrt((_displacement(error, box.grid(), free) ** 2).mean())),
        rotation_error=float(np.linalg.norm(rotation_log(error[:3, :3]))),
    )


def _error(estimate: t.TransformEstimate, truth: t.Transform) -> TransformErrorResult:
    """Return how far off one transform is, unobservable directions aside."""
    error = estimate.transform.matrix @ truth.inverse().matrix
    shift = error[:3, :3] @ estimate.about + error[:3, 3] - estimate.about
    twist = np.concatenate([rotation_log(error[:3, :3]), shift])
    twist -= estimate.unobservable.T @ (estimate.unobservable @ twist)
    return TransformErrorResult(
        rotation=float(np.linalg.norm(twist[:3])), translation=float(np.linalg.norm(twist[3:]))
    )


def _displacement(error: t.Array, points: Any, free: t.Array) -> Any:
    """Return how far points are moved across the rows of ``free``, which do not count."""
    moved = points @ error[:3, :3].T + error[:3, 3] - points
    return np.linalg.norm(moved - moved @ free.T @ free, axis=-1)


def holdout_result(verifications: Mapping[str, t.Verification]) -> HoldoutResult | None:
    """Return the section ``holdout`` from the step that computed one."""
    wanted = {"folds", "rms", "median", "p95"}
    for verification in verifications.values():
        figures = dict(verification.figures)
        if wanted <= figures.keys():
            core = {name: figures.pop(name) for name in wanted}
            return HoldoutResult(
                folds=int(core["folds"]), rms=core["rms"], median=core["median"], p95=core["p95"],
                figures=figures,
            )  # fmt: skip
    return None


def verifications_result(found: Mapping[str, t.Verification]) -> dict[str, VerificationResult]:
    """Return the section ``verifications``."""
    return {
        step: VerificationResult(
            passed=v.passed, reason=v.reason, figures=dict(v.figures), errors=dict(v.errors)
        )
        for step, v in found.items()
    }

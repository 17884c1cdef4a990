"""``result.json``: the public contract of a run. SI units and radians throughout.

The models below are its definition; ``flangeye schema --result`` prints them as JSON Schema. Runs
of the same recipe, input and seed give the same document bit for bit, ``timing`` aside.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from flangeye import __version__
from flangeye import types as t
from flangeye.geometry import covariance_at, rotation_log
from flangeye.seamline import errors_from, torch_deviation, tube_radii

Vector = list[float]
Matrix = list[list[float]]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", defer_build=True)


class TransformResult(_Part):
    """An estimated transform."""

    matrix: Matrix = Field(description="4x4, maps child coordinates to parent coordinates.")
    covariance: Matrix = Field(
        description="6x6, order (rotation [rad], translation [m]), of a left perturbation in the "
        "parent frame, the translation taken at `about`."
    )
    about: Vector = Field(description="Point in the parent frame [m].")
    unobservable: Matrix | None = Field(
        None,
        description="Directions (rotation, translation), about the same point, along which the "
        "estimate is arbitrary and the covariance says nothing.",
    )


class ObservationResult(_Part):
    """One capture and what became of it; measured values are null when it was set aside early."""

    id: str
    centre_in_camera: Vector | None = None
    normal_in_camera: Vector | None = None
    radii: dict[str, float] | None = None
    covariance: Matrix | None = Field(None, description="3x3, of the centre [m^2].")
    arc_coverage: float | None = Field(None, description="Share of the rim that was seen.")
    clocking: float | None = Field(None, description="Angle of the hole pattern [rad], if seen.")
    tcp_in_base: Vector | None = None
    residual: float | None = Field(None, description="Distance of mapped centre and TCP [m].")
    residual_in_base: Vector | None = Field(None, description="Mapped centre minus TCP [m].")
    used: bool
    reason: str | None = Field(None, description="Why it was not used.")


class HoldoutResult(_Part):
    """Errors on poses that took no part in the estimate."""

    folds: int
    rms: float
    median: float
    p95: float
    figures: dict[str, float] = Field(description="Everything else verify.holdout reports.")


class VerificationResult(_Part):
    """One verify step."""

    passed: bool
    reason: str
    figures: dict[str, float]
    errors: dict[str, float] = Field(description="Per pose, by observation id [m].")


class WorkspaceResult(_Part):
    """Where errors are reported, and the error to expect there."""

    centre: Vector
    size: Vector
    predicted_rms: float = Field(description="Root mean square over the box, from the covariance.")
    predicted_p95: float = Field(description="95 % of the errors over the box are below [m].")


class TransformErrorResult(_Part):
    """Simulation only: how far one transform is off."""

    rotation: float = Field(description="[rad]")
    translation: float = Field(description="Of the point its covariance is taken about [m].")


class TruthResult(_Part):
    """Simulation only: what the calibration is really worth."""

    base_T_camera: Matrix | None = Field(None, description="Where the camera is, if it stands.")
    transforms: dict[str, Matrix] = Field(
        default_factory=dict, description="Every unknown, as it really is."
    )
    errors: dict[str, TransformErrorResult] = Field(
        default_factory=dict, description="Of every unknown, where its covariance is taken."
    )
    error_at_centroid: float = Field(description="At the workspace's centre [m].")
    rms_over_workspace: float = Field(description="Over the workspace box [m].")
    rotation_error: float = Field(description="[rad]")


class SeamTruthResult(_Part):
    """Simulation only: how far the planned seam is from the true one."""

    rms: float = Field(description="Distance of the planned points from the true seam [m].")
    max: float
    inside: float = Field(description="Share of the planned points whose tube holds it.")


class SeamResult(_Part):
    """The planned seam, in the base."""

    source: str
    length: float = Field(description="[m]")
    points: Matrix = Field(description="(N, 3) along the root of the groove [m].")
    openings: Matrix = Field(description="(N, 3) unit vectors towards the torch.")
    covariance: list[Matrix] = Field(description="(N, 3, 3) of the points [m^2].")
    tube: Vector = Field(description="(N) with 95 % the seam is not further off than this [m].")
    half_angle: float | None = Field(None, description="Of the groove [rad].")
    half_width: float | None = Field(None, description="Of the groove at its shoulders [m].")
    figures: dict[str, float] = Field(description="What the seam step reports.")
    notes: list[str]
    truth: SeamTruthResult | None = None


class WeldTruthResult(_Part):
    """Simulation only: how far the torch was from the true seam, across it, after the lead-in."""

    rms: float = Field(description="[m]")
    max: float


class WeldResult(_Part):
    """What the torch did."""

    mode: str
    completed: bool
    reason: str = Field(description="Why it ended early; empty when it did not.")
    seconds: float = Field(description="From the first cycle to the last.")
    correction_rms: float | None = Field(
        None, description="From the plan to the seam as it was felt, across it [m]."
    )
    phases: dict[str, float] = Field(description="Time in each phase of the controller [s].")
    figures: dict[str, float]
    truth: WeldTruthResult | None = None


class CorrectionResult(_Part):
    """What is wrong with where the arm says its flange is, estimated with the transforms."""

    tool_offset: Vector = Field(description="The circle's centre in the flange frame [m].")
    joint_offsets: Vector | None = Field(None, description="To add to the joint angles [rad].")


class StageTiming(_Part):
    """What one step took, the steps it pulled from excluded."""

    seconds: float
    calls: int


class Provenance(_Part):
    """What made this result."""

    versions: dict[str, str]
    plugins: dict[str, str]
    recipe: str
    recipe_hash: str = Field(description="SHA-256 of recipe.resolved.yaml.")
    input_hash: str = Field(description="Of everything the captures are made from.")
    seed: int
    notes: list[str] = Field(description="What the source and the solver want people to know.")


class Result(_Part):
    """The whole document."""

    format: int = Field(1, description="Version of this contract.")
    title: str
    status: str = Field(description="verified, unverified (no verify step) or refused.")
    refused: str | None = Field(None, description="Why.")
    method: str | None = Field(None, description="The solve step.")
    transforms: dict[str, TransformResult]
    correction: CorrectionResult | None = Field(
        None, description="The transforms hold for the arm so corrected; null: as it reports."
    )
    observations: list[ObservationResult]
    workspace: WorkspaceResult | None = None
    holdout: HoldoutResult | None = None
    verifications: dict[str, VerificationResult]
    truth: TruthResult | None = None
    seam: SeamResult | None = None
    weld: WeldResult | None = None
    timing: dict[str, StageTiming]
    provenance: Provenance


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


def seam_result(seam: t.Seam | None, scan: t.WorkpieceScan | None) -> SeamResult | None:
    """Return the section ``seam``."""
    if seam is None:
        return None
    return SeamResult(
        source=seam.source,
        length=float(seam.arc_length[-1]),
        points=seam.points_in_base.tolist(),
        openings=seam.openings_in_base.tolist(),
        covariance=seam.covariance.tolist(),
        tube=tube_radii(seam).tolist(),
        half_angle=seam.half_angle,
        half_width=seam.half_width,
        figures=dict(seam.figures),
        notes=list(seam.notes),
        truth=_seam_truth(seam, list(scan.truth.values())) if scan and scan.truth else None,
    )


def _seam_truth(seam: t.Seam, true_seams: list[t.Array]) -> SeamTruthResult:
    """Compare with the true seam that is nearest: a workpiece may have several."""
    errors = min((errors_from(seam, truth) for truth in true_seams), key=lambda e: float(e.max()))
    return SeamTruthResult(
        rms=float(np.sqrt(np.mean(errors**2))),
        max=float(errors.max()),
        inside=float(np.mean(errors <= tube_radii(seam))),
    )


def work_of(calibration: t.HandEye, source: t.Source, given: t.Box | None) -> t.Box | None:
    """Return where the work is, in the frame that carries the camera.

    That of :func:`workspace_of` where it is the base; where the robot moves the camera, the box
    around what it looked at.
    """
    if calibration.camera.transform.parent == t.BASE:
        return workspace_of(source, given, calibration.pairs)
    seen = np.array([pair.observation.feature.centre for pair in calibration.pairs])
    return _around(calibration.camera.transform.apply(seen.reshape(-1, 3)))


def weld_result(weld: t.WeldReport | None, scan: t.WorkpieceScan | None) -> WeldResult | None:
    """Return the section ``weld``."""
    if weld is None:
        return None
    ticks = np.diff(weld.time, append=weld.time[-1:])
    names = np.array(weld.phases)
    correction = torch_deviation(weld.refined, weld.planned, weld.opening)
    return WeldResult(
        mode=weld.mode,
        completed=weld.completed,
        reason=weld.reason,
        seconds=float(weld.time[-1]) if len(weld.time) else 0.0,
        correction_rms=_rms(correction) if len(correction) else None,
        phases={name: float(ticks[names == name].sum()) for name in dict.fromkeys(weld.phases)},
        figures=dict(weld.figures),
        truth=_weld_truth(weld, list(scan.truth.values())) if scan and scan.truth else None,
    )


def _weld_truth(weld: t.WeldReport, true_seams: list[t.Array]) -> WeldTruthResult | None:
    """Compare with the true seam that is nearest, where the torch was between its ends."""
    found = [torch_deviation(weld.torch, truth, weld.opening) for truth in true_seams]
    errors = min((e for e in found if len(e)), key=lambda e: float(e.max()), default=None)
    return None if errors is None else WeldTruthResult(rms=_rms(errors), max=float(errors.max()))


def _rms(values: t.Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def workspace_of(source: t.Source, given: t.Box | None, pairs: Sequence[t.Pair]) -> t.Box | None:
    """Return the recipe's box, or the source's, or the box around the flange's centres."""
    if given or source.workspace:
        return given or source.workspace
    if not pairs:
        return None
    return _around(np.array([pair.observation.tcp_in_base for pair in pairs]))


def _around(points: t.Array) -> t.Box | None:
    if not len(points):
        return None
    low, high = points.min(axis=0), points.max(axis=0)
    return t.Box((low + high) / 2, high - low)


def sha256(text: str) -> str:
    """Return the hash of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


def library_versions() -> dict[str, str]:
    """Return the versions of everything that computes."""
    names = ("numpy", "scipy", "open3d-cpu", "open3d", "opencv-python-headless", "pydantic", "mcap")
    found = {"flangeye": __version__, "python": platform.python_version()}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found

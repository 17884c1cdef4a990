"""A plugin small enough to know every answer: a point cloud is four points around a centre."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field

from flangeye import BoundPart, Choose, Params, StageError, hookimpl, part, stage
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    Box,
    Capture,
    Captures,
    CircleFeature,
    ExpectedError,
    FlangeCloud,
    HandEye,
    Look,
    Observations,
    Pair,
    PointCloud,
    PoseError,
    Rejected,
    Role,
    Seam,
    Seed,
    Solver,
    Source,
    Transform,
    TransformEstimate,
    Truth,
    Verification,
    VerifiedHandEye,
    Views,
    WeldReport,
    WorkpieceScan,
    by_frame,
)  # fmt: skip
from flangeye.types.geometry import kabsch, rigid, rotation_from_rpy
from flangeye.units import Length, param

BASE_T_CAMERA = Transform(BASE, CAMERA, rigid(rotation_from_rpy(3.0, 0.1, -1.5), [0.6, 0, 1]))
CROSS = 0.01 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=float)
acquired: list[str] = []


class AcquireParams(Params):
    count: int = Field(6, ge=0)
    """How many captures."""
    noise: Length = param("0 mm", ge=0)
    """Standard deviation of a centre."""
    bad: int = 0
    """How many captures show nothing."""
    verification: int = 0
    """How many are kept from the solver."""


@stage("acquire.toy")
def acquire(seed: Seed, params: AcquireParams) -> Captures:
    """Make captures whose truth is known."""
    rng = np.random.default_rng(seed)
    acquired.clear()

    def captures() -> Iterator[Capture]:
        for i in range(params.count):
            acquired.append(f"{i:03d}")
            pose = rigid(rotation_from_rpy(*rng.uniform(-0.3, 0.3, 3)), rng.uniform(-0.2, 0.2, 3))
            centre = BASE_T_CAMERA.inverse().apply(pose[:3, 3]) + rng.normal(0, params.noise, 3)
            xyz = np.full((4, 3), np.nan) if i < params.bad else centre + CROSS
            role: Role = "verification" if i < params.verification else "calibration"
            flange = Transform(BASE, FLANGE, pose)
            yield Capture(f"{i:03d}", PointCloud(CAMERA, xyz), by_frame(flange), None, i, role)

    source = Source(
        "toy", ("made of four points",), Box(np.zeros(3), np.full(3, 0.4)), Truth(BASE_T_CAMERA)
    )

    def look(_bodies: object) -> PointCloud:
        return PointCloud(CAMERA, CROSS)

    return Captures(captures(), source, params.count, look)


@stage("segment.toy")
def segment(capture: Capture) -> FlangeCloud | Rejected:
    """Keep the finite points."""
    points = capture.cloud.points()
    if not len(points):
        return Rejected("no finite point")
    return FlangeCloud(PointCloud(CAMERA, points), points.mean(axis=0), np.array([0, 0, -1.0]))


class FitParams(Params):
    inlier: Length = param("0.3 mm", gt=0)
    """Largest distance of a rim point from the circle."""


@stage("fit.toy")
def fit(cloud: FlangeCloud, params: FitParams) -> CircleFeature:
    """Take the mean as the centre."""
    centre = cloud.cloud.xyz.mean(axis=0, dtype=float)
    cov = params.inlier**2 * np.eye(3)
    return CircleFeature(centre, np.array([0, 0, -1.0]), {"rim": 0.01}, cov, 1e-6 * np.eye(3), 1.0)


@part("cost.toy")
def toy_cost(error: PoseError) -> float:
    """Return the shift of the origin."""
    return float(np.linalg.norm(error.motion[:3, 3]))


class ScaledParams(Params):
    radius: Length = param("300 mm")
    """Work radius."""


@part("cost.scaled")
def scaled_cost(error: PoseError, params: ScaledParams) -> float:
    """Scale the shift of the origin by the work radius."""
    return float(np.linalg.norm(error.motion[:3, 3])) * params.radius


class SolveParams(Params):
    at_most: int = 100
    """Stop pulling after so many."""
    cost: Annotated[BoundPart, Choose("cost")] = param({"toy": {}})
    """What to minimise."""


@stage("solve.toy")
def solve(observations: Observations, params: SolveParams) -> HandEye:
    """Register the centres."""
    pulled = [o for _, o in zip(range(params.at_most), observations, strict=False)]
    if len(pulled) < 3:
        raise StageError(f"solve.toy: 3 poses needed, {len(pulled)} given")
    camera = np.array([o.feature.centre for o in pulled])
    base = np.array([o.tcp_in_base for o in pulled])
    transform = Transform(BASE, CAMERA, rigid(*kabsch(camera, base)))
    residuals = transform.apply(camera) - base
    pairs = tuple(Pair(o, r) for o, r in zip(pulled, residuals, strict=True))
    estimate = TransformEstimate(transform, 1e-8 * np.eye(6), base.mean(axis=0))
    return HandEye(estimate, pairs, "solve.toy", expected=ExpectedError(1e-4, 2e-4))


@stage("refine.toy")
def refine(calibration: HandEye) -> HandEye:
    """Note that it was here."""
    return replace(calibration, notes=("refined",))


class VerifyParams(Params):
    max_rms: Length = param("1 mm", gt=0)
    """Largest root mean square residual."""


@stage("verify.toy")
def verify(calibration: HandEye, solve: Solver, views: Views, params: VerifyParams) -> Verification:
    """Solve again without the first pose."""
    again = solve([p.observation for p in calibration.pairs[1:]])
    rms = float(np.sqrt(np.mean([p.residual @ p.residual for p in again.pairs])))
    figures = {"folds": 1, "rms": rms, "median": rms, "p95": rms, "views": len(views)}
    reason = f"verify.toy: {rms * 1e3:.3f} mm rms held out, limit {params.max_rms * 1e3:g} mm"
    return Verification(rms <= params.max_rms, reason, figures, {"001": rms})


@stage("scan.toy")
def scan(look: Look | None) -> WorkpieceScan:
    """See four points and know more."""
    if look is None:
        raise StageError("scan.toy: nothing is simulated")
    return WorkpieceScan(look([]), "toy", ("scanned",), {"seam": np.eye(3)[:2]})


@stage("seam.toy")
def seam(calibration: VerifiedHandEye, scan: WorkpieceScan | None) -> Seam:
    """Weld along a line."""
    if scan is not None and scan.truth:
        raise StageError("seam.toy: the truth must stay with the runner")
    return Seam(
        np.eye(3)[:2], np.tile([0.0, 0.0, 1.0], (2, 1)), 1e-8 * np.tile(np.eye(3), (2, 1, 1))
    )


@stage("weld.toy")
def weld(calibration: VerifiedHandEye, seam: Seam) -> WeldReport:
    """Weld nothing."""
    none = np.zeros(0)
    return WeldReport(
        mode="toy", completed=True, reason="", planned=seam.points_in_base, refined=none,
        openings=seam.openings_in_base, time=none, tip=none, torch=none, robot=none,
        deflection=none, wanted=none, speed=none, turn=none, along=none, phases=(),
    )  # fmt: skip


@hookimpl
def flangeye_stages():
    return (acquire, segment, fit, solve, refine, verify, scan, seam, weld)


@hookimpl
def flangeye_parts():
    return (toy_cost, scaled_cost)

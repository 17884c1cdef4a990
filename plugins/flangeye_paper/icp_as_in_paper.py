"""Equation (11) as the authors' scripts computed it, and Algorithm 1 judged by it."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from flangeye import BoundPart, Choose, Params, StageError, part, stage
from flangeye.models.targets import Flange
from flangeye.types import Floats, HandEye, Observation, PoseError, Transform, Verification, Views
from flangeye.types.geometry import rpy_from_rotation
from flangeye.units import param
from flangeye_paper.open3d_0_7 import IcpFit, IcpStop, Normals, icp
from flangeye_paper.published import PublishedView
from flangeye_plugins.solve.iterative import SearchState, improve_pool, solve_pool
from flangeye_plugins.solve.observations import residuals_of


class PaperIcpParams(Params):
    """How the verification cloud is registered with the CAD cloud."""

    normals: Normals = "open3d_0_7_normals"
    """Normals of the CAD cloud: as Open3D up to 0.7 computed them, with its defect on flat faces,
    or sound ones."""
    iterations: int = Field(30, ge=1, le=10_000)
    """Iterations of ICP at most; 30 was the default."""
    change: float = Field(1e-6, ge=0)
    """Stop once share and rms of the matches change by less. The default of 1e-6 is in the file's
    unit: a micrometre for clouds in m, a nanometre for those in mm."""
    distance: float = Field(1.0, gt=0)
    """Pairs further apart do not match, in the file's unit (m or mm)."""


@part("error.icp_as_in_paper")
def error_icp_as_in_paper(
    base_T_camera: Transform,
    kept: Sequence[Observation],
    views: Views,
    flange: Flange | None,
    params: PaperIcpParams,
) -> PoseError | None:
    """Equation (11) as the authors' scripts computed it, on their verification cloud.

    Raises:
        StageError: No verification cloud was published for this recording.
    """
    view = published_view(views)
    fit = register_as_in_paper(base_T_camera, view, params)
    return None if fit is None else _pose_error(base_T_camera, view, fit)


@stage("verify.icp_as_in_paper")
def verify_icp_as_in_paper(
    calibration: HandEye, views: Views | None, params: PaperIcpParams
) -> Verification:
    """Register the published verification cloud as the authors' scripts did, to see their numbers.

    It measures and does not judge: it passes whenever ICP comes to an end.

    Figures [m, rad], in ``camera``: ``x, y, z`` at the camera's origin, as the paper prints them,
    ``roll, pitch, yaw``; ``flange_x, flange_y, flange_z`` at the flange; ``rms``, ``share`` and
    ``iterations`` of ICP.

    Raises:
        StageError: No verification cloud was published for this recording.
    """
    view = published_view(views or Views())
    transform = calibration.base_T_camera.transform
    fit = register_as_in_paper(transform, view, params)
    if fit is None:
        return Verification(False, "ICP failed: too few points match, the error is infinite", {})
    error = _pose_error(transform, view, fit)
    figures = {**figures_of(error), "rms": fit.rms / view.per_metre, "share": fit.share}
    figures["iterations"] = float(fit.iterations)
    return Verification(True, _summary(figures), figures)


def published_view(views: Views) -> PublishedView:
    """Return the published verification cloud.

    Raises:
        StageError: There is none.
    """
    for view in views:
        if isinstance(view, PublishedView):
            return view
    raise StageError(
        "no published verification cloud: acquire.published_centres has one of the Aubo and of "
        "the Kinect; those of the UR5, UR10e and Franka were never published"
    )


def register_as_in_paper(
    base_T_camera: Transform, view: PublishedView, params: PaperIcpParams
) -> IcpFit | None:
    """Register a published view with its CAD cloud, in the unit of their files."""
    camera_T_shape = _in_file_unit(base_T_camera.inverse().matrix, view) @ (
        _in_file_unit(view.base_T_flange.matrix, view) @ view.flange_T_shape
    )
    rotation, shift = camera_T_shape[:3, :3], camera_T_shape[:3, 3]
    target = view.shape @ rotation.T + shift
    normals = view.normals(params.normals) @ rotation.T
    stop = IcpStop(params.iterations, params.change)
    return icp(view.measured, target, normals, params.distance, stop)


def figures_of(error: PoseError) -> dict[str, float]:
    """Return an error as the paper prints it, and at the work; SI units."""
    turn = error.motion[:3, :3]
    at_work = turn @ error.at + error.motion[:3, 3] - error.at
    return {
        **dict(zip("xyz", error.motion[:3, 3].tolist(), strict=True)),
        **dict(zip(("roll", "pitch", "yaw"), rpy_from_rotation(turn).tolist(), strict=True)),
        **dict(zip(("flange_x", "flange_y", "flange_z"), at_work.tolist(), strict=True)),
    }


def _pose_error(base_T_camera: Transform, view: PublishedView, fit: IcpFit) -> PoseError:
    motion = fit.motion.copy()
    motion[:3, 3] /= view.per_metre
    at = base_T_camera.inverse().apply(view.base_T_flange.translation)
    return PoseError(motion, at, base_T_camera.rotation)


def _in_file_unit(matrix: Floats, view: PublishedView) -> Floats:
    scaled = matrix.copy()
    scaled[:3, 3] *= view.per_metre
    return scaled


def _summary(figures: dict[str, float]) -> str:
    shift = ", ".join(f"{figures[axis] * 1e3:+.3f}" for axis in "xyz")
    turn = ", ".join(f"{np.degrees(figures[axis]):+.3f}" for axis in ("roll", "pitch", "yaw"))
    return (
        f"ICP as in the paper moved the view by ({shift}) mm and ({turn}) deg at the camera's "
        f"origin, in {figures['iterations']:.0f} iterations"
    )


class ByIterationParams(Params):
    """Parameters of ``verify.algorithm_1_by_iteration``: those of ``solve.iterative``."""

    pool: int = Field(4, ge=3, le=1000)
    """Number of poses in the pool."""
    error: Annotated[BoundPart, Choose("error")] = param({"icp_as_in_paper": {}})
    """Measure of a candidate's error."""
    cost: Annotated[BoundPart, Choose("cost")] = param({"translation": {"at": "camera"}})
    """Cost of that error, to be minimised."""


@stage("verify.algorithm_1_by_iteration")
def verify_by_iteration(
    calibration: HandEye, views: Views | None, flange: Flange | None, params: ByIterationParams
) -> Verification:
    """Run Algorithm 1 over the calibration's poses in order and report its error by pose.

    It measures and does not judge: every run passes. The calibration itself stays as it is.

    Figures [m, rad]: ``x_05``, ``yaw_05``, ... the measured error once five poses have been seen,
    in ``camera`` at its origin; ``x``, ..., ``yaw`` after the last; ``others_rms``: residual of
    the last answer on the poses outside its pool, which its cost never saw.
    """
    poses = [pair.observation for pair in calibration.pairs]
    measured: dict[float, PoseError] = {}

    def evaluate(candidate: Transform) -> float:
        error = params.error(candidate, [], views or Views(), flange)
        if error is None:
            return float("inf")
        cost = float(params.cost(error))
        measured[cost] = error
        return cost

    first, rest = poses[: params.pool], iter(poses[params.pool :])
    search = improve_pool(first, rest, evaluate, required=0.0, k_max=len(poses))
    figures = _figures(search, measured, len(first))
    figures["others_rms"] = _rms_outside(search, poses)
    last = search.cost * 1e3
    return Verification(True, f"Algorithm 1 ends at a cost of {last:.3f} mm", figures)


def _figures(search: SearchState, measured: dict[float, PoseError], first: int) -> dict[str, float]:
    """Return the error after each pose; poses before the first finite cost have none."""
    figures: dict[str, float] = {}
    for seen, cost in enumerate(search.history, first):
        if np.isfinite(cost):
            figures |= {f"{k}_{seen:02d}": v for k, v in figures_of(measured[cost]).items()}
    return figures | (figures_of(measured[search.cost]) if np.isfinite(search.cost) else {})


def _rms_outside(search: SearchState, poses: Sequence[Observation]) -> float:
    inside = {o.id for o in search.pool}
    answer = solve_pool(search.pool)
    others = [o for o in poses if o.id not in inside]
    residuals = residuals_of(others, answer.rotation, answer.translation)
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))

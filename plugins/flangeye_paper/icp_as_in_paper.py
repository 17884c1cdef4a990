"""Equation (11) as the authors' scripts computed it: ``error.`` and ``verify.icp_as_in_paper``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from flangeye import Params, StageError, part, stage
from flangeye.maths.geometry import rpy_from_rotation
from flangeye.models.targets import Flange
from flangeye.types import Floats, HandEye, Observation, PoseError, Transform, Verification, Views
from flangeye_paper.open3d_0_7 import IcpFit, Normals, Stop, icp
from flangeye_paper.published import PublishedView


class PaperIcpParams(Params):
    """How the verification cloud is registered with the CAD cloud."""

    normals: Normals = Field(
        "open3d_0_7_normals",
        description="Normals of the CAD cloud: as Open3D up to 0.7 computed them, with its defect "
        "on flat faces, or sound ones.",
    )
    iterations: int = Field(30, ge=1, description="Iterations of ICP at most; 30 was the default.")
    change: float = Field(
        1e-6,
        ge=0,
        description="Stop once share and rms of the matches change by less. The default of 1e-6 "
        "is in the file's unit: a micrometre for clouds in m, a nanometre for those in mm.",
    )
    distance: float = Field(
        1.0, gt=0, description="Pairs further apart do not match, in the file's unit (m or mm)."
    )


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
    stop = Stop(params.iterations, params.change)
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

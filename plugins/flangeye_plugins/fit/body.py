"""The pose of a body of known shape, with its covariance, from a scan around it."""

from __future__ import annotations

from flangeye import Params, stage
from flangeye.models.bodies import TargetBody
from flangeye.types import CAMERA, TARGET, FlangeCloud, PoseFeature, Rejected, Transform
from flangeye.units import Length, param


class FitBodyParams(Params):
    """Parameters of ``fit.body``."""

    model_error: Length = param(
        "0.1 mm",
        ge=0,
        description="Standard deviation of each face of the body against its CAD: make, coating, "
        "play; added to the covariance.",
    )
    scanner_error: Length = param(
        "0.06 mm",
        ge=0,
        description="Standard deviation along each axis of the scanner's own distortion, which a "
        "single scan cannot show; added to the covariance, and to the turn over the body's size.",
    )
    max_rms: Length = param(
        "4 mm", gt=0, description="Largest robust deviation of the scan from the body's surface."
    )


@stage("fit.body")
def fit_body(cloud: FlangeCloud, body: TargetBody, params: FitBodyParams) -> PoseFeature | Rejected:
    """Lay a body on the scan around it: surface on points, and ends of faces on the scan's edges.

    Every point of the scan is compared with the body along the scanner's own ray, so that only
    visible faces count, and robustly. A scanner loses the outermost points of an edge, by how much
    is fitted along. Neighbouring points err together: they count as patches. What a symmetric body
    does not show keeps a variance as large as the body.
    """
    from flangeye_plugins.body.dense import fitted
    from flangeye_plugins.body.looks import prepared

    if cloud.camera_T_target is None:
        return Rejected("nothing says where the body is; segment.body comes before fit.body")
    fit = fitted(cloud.cloud.xyz, prepared(body)[0], cloud.camera_T_target)
    if fit is None:
        return Rejected("too few points on the body")
    if fit.noise > params.max_rms:
        return Rejected(
            f"the scan is {fit.noise * 1e3:.2f} mm off {body.name}'s surface (limit "
            f"{params.max_rms * 1e3:g} mm): does it move against its mesh, as a gripper's jaws do?"
        )
    covariance = fit.covariance(params.model_error, params.scanner_error)
    figures = {
        "points": float(fit.points),
        "edges": float(fit.edges),
        "noise_m": fit.noise,
        "freedoms": float(fit.freedoms),
    }
    return PoseFeature(Transform(CAMERA, TARGET, fit.pose), covariance, figures)

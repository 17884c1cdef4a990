"""``fit.body``: pose of a body of known shape, with covariance, from the scan points around it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from flangeye import Params, stage
from flangeye.estimation.effects.scanner import DistortionField
from flangeye.maths.statistics import chi2_quantile
from flangeye.models.bodies import TargetBody
from flangeye.models.configuration import Configuration
from flangeye.models.scanners import ScannerModel
from flangeye.models.targets import Flange
from flangeye.types import (
    CAMERA,
    TARGET,
    Capture,
    CircleFeature,
    FlangeCloud,
    Floats,
    PointCloud,
    PoseFeature,
    Rejected,
    Singles,
    Transform,
)
from flangeye.types.geometry import basis_of_plane, hat, rotation_exp
from flangeye.units import Length, param

if TYPE_CHECKING:
    from flangeye_plugins.body.dense import BodyFit
    from flangeye_plugins.body.looks import Symmetry


class FitBodyParams(Params):
    """Parameters of ``fit.body``."""

    model_error: Length = param("0.1 mm", ge=0)
    """Standard deviation of the body's surface against its CAD along each axis, smooth over it:
    make, coating, play; added to the covariance."""
    scanner_error: Length = param("0.06 mm", ge=0)
    """Standard deviation along each axis of the scanner's own distortion, which a single scan
    cannot show; added to the covariance. Where the recipe names the scanner's model, its
    calibration error over its volume counts instead."""
    max_rms: Length = param("4 mm", gt=0)
    """Largest robust deviation of the scan from the body's surface."""


@stage("fit.body")
def fit_body(  # noqa: PLR0913  what it asks the runner for
    cloud: FlangeCloud,
    body: TargetBody,
    params: FitBodyParams,
    scanner: ScannerModel | None = None,
    capture: Capture | None = None,
    flange: Flange | None = None,
    configuration: Configuration | None = None,
) -> PoseFeature | CircleFeature | Rejected:
    """Fit a body to the scan around it: its surface to points, its faces' ends to the scan's edges.

    Every scan point is compared with the body along the scanner's ray, so that only visible faces
    count, with robust weights. A scanner loses the outermost points at edges and rounds curved
    surfaces; both effects are estimated with the pose. Errors of neighbouring points are
    correlated, so they count as patches. The covariance includes two smooth fields that no scan
    shows: the body's deviation from its CAD, and the scanner's distortion.

    If the flange shows beside a tool that is drawn in the flange's frame, its rim counts too.

    Returns:
        The body's pose. Of a body of revolution a point of its axis and the axis, as of a circle;
        of a ball its centre.
    """
    from flangeye_plugins.body.dense import fitted
    from flangeye_plugins.body.looks import prepared

    if cloud.camera_T_target is None:
        return Rejected("nothing says where the body is; segment.body comes before fit.body")
    if len(cloud.others):
        return Rejected(
            f"{1 + len(cloud.others)} poses of {body.name} explain the scan, and a single scan "
            "does not show which is right; FlangeCloud.alone gives each of them"
        )
    body = body.at(capture.joints if capture else None)
    shape = prepared(body)
    fit = fitted(cloud.cloud.xyz, shape, cloud.camera_T_target)
    if fit is None:
        return Rejected("too few points on the body")
    alone = partial(_somewhere, params.scanner_error)
    distortion = DistortionField(scanner).at if scanner else alone
    if refused := _unlike(fit, body.name, params, distortion):
        return refused
    covariance = fit.covariance(params.model_error, distortion)
    if shape.symmetry.freedoms < 6:
        return _round(fit.pose, covariance, shape.symmetry)
    figures = {
        "points": float(fit.points),
        "edges": float(fit.edges),
        "noise_m": fit.noise,
    }
    found = PoseFeature(Transform(CAMERA, TARGET, fit.pose), covariance, figures)
    if not (capture and flange and configuration and configuration.drawn_in_flange):
        return found
    own = fit.covariance(params.model_error, lambda patches: np.zeros((len(patches), 3, 1)))
    return _with_rim(found, own, capture.cloud.points(), flange)


def _with_rim(found: PoseFeature, own: Floats, points: Singles, flange: Flange) -> PoseFeature:
    """Return a tool's pose, combined with the flange's rim if a scan shows it where it belongs.

    Args:
        found: Pose of the tool, drawn in the flange's frame.
        own: (6, 6) its covariance without the scanner's distortion, which moves the rim alike.
        points: (N, 3) the scan.
        flange: The flange, whose bore the tool covers.
    """
    from flangeye_plugins.fit.rim import RimParams, circle_of

    centre, axis = found.centre, found.normal
    near = points[np.linalg.norm(points - centre, axis=1) < 1.5 * flange.outer]
    seen = FlangeCloud(PointCloud(CAMERA, near), centre - flange.behind * axis, axis)
    undistorted = RimParams().model_copy(update={"scanner_error": 0.0})
    circle = circle_of(seen, flange, {"rim": flange.rim}, undistorted)
    if isinstance(circle, Rejected) or circle.normal is None or circle.normal_covariance is None:
        return found
    # A turn phi moves the normal n by phi x n, seen along two axes across it
    across = basis_of_plane(axis)[:2]
    moved = np.block([[np.zeros((3, 3)), np.eye(3)], [-across @ hat(axis), np.zeros((2, 3))]])
    off = np.r_[circle.centre - centre, across @ circle.normal]
    noise = block_diag(circle.covariance, across @ circle.normal_covariance @ across.T)
    spread = moved @ own @ moved.T + noise
    if off @ np.linalg.solve(spread, off) > chi2_quantile(0.99, len(off)):
        return found  # the rim of something else, such as an adapter
    gain = np.linalg.solve(spread, moved @ own).T
    step = gain @ off
    camera_T_body = found.camera_T_target.matrix.copy()
    camera_T_body[:3, :3] = rotation_exp(step[:3]) @ camera_T_body[:3, :3]
    camera_T_body[:3, 3] += step[3:]
    covariance = found.covariance - gain @ moved @ own
    figures = {**found.figures, "flange_arc": circle.arc_coverage}
    return PoseFeature(
        Transform(CAMERA, TARGET, camera_T_body), (covariance + covariance.T) / 2, figures
    )


def _round(pose: Floats, covariance: Floats, symmetry: Symmetry) -> CircleFeature:
    """Return what a scan shows of a body of revolution, or of a ball.

    Args:
        pose: (4, 4) ``camera_T_body``; its turn about the axis has no meaning.
        covariance: (6, 6) covariance of that pose.
        symmetry: Symmetry of the body.
    """
    arm, axis = pose[:3, :3] @ symmetry.centre, pose[:3, :3] @ symmetry.axis
    # A turn phi of the pose moves the point at an arm from the body's origin by phi x arm.
    moved = np.hstack([-hat(arm), np.eye(3)])
    ball = symmetry.freedoms == 3
    turned = hat(axis)
    # Drawn along its frame's z the frame is the body's own, else one with its origin on the axis
    own = ball or symmetry.axis[2] > 1.0 - 1e-6
    return CircleFeature(
        centre=arm + pose[:3, 3],
        normal=None if ball else axis,
        radii={},
        covariance=moved @ covariance @ moved.T,
        normal_covariance=None if ball else turned @ covariance[:3, :3] @ turned.T,
        arc_coverage=0.0,
        centre_in_flange=symmetry.centre if own else np.zeros(3),
    )


def _unlike(
    fit: BodyFit, name: str, params: FitBodyParams, distortion: Callable[[Floats], Floats]
) -> Rejected | None:
    """Return a rejection if the scan does not match the fitted body; None if it does."""
    if fit.noise > params.max_rms:
        return Rejected(
            f"the scan is {fit.noise * 1e3:.2f} mm off {name}'s surface (limit "
            f"{params.max_rms * 1e3:g} mm): does it move against its mesh, as a gripper's jaws do?"
        )
    # Of good scans this share shows edges as its scanner does; others may rest on wrong edges
    if fit.odd > chi2_quantile(0.99, len(fit.lost) + 1):
        low, high = fit.lost.min() * 1e3, fit.lost.max() * 1e3
        return Rejected(
            f"the scan's edges are {low:+.1f} to {high:+.1f} mm off the ends of {name}, more than "
            f"a scanner loses at edges: the fit used edges of another object, or the mesh "
            "is another body's; scan from where more of its ends are seen"
        )
    larger, unsure = fit.oversize, fit.unsure(params.model_error, distortion)
    if (larger / unsure) ** 2 > chi2_quantile(0.99, 1):
        return Rejected(
            f"the scan shows {name} in another size than its mesh has: the mesh's scale is wrong, "
            "or another object was found",
            f"{'larger' if larger > 0 else 'smaller'} by at least {abs(larger):.1%}, standard "
            f"deviation {unsure:.1%}",
        )
    return None


def _somewhere(error: float, points: Floats) -> Floats:
    """Return a distortion field at points (P, 3), linear in 12 random weights (P, 3, 12) [m].

    It is linear about the points' centre; its slope is that of a field which changes sign over half
    the distance.
    """
    middle = points.mean(axis=0)
    arms = (points - middle) / (np.linalg.norm(middle) / 2)
    weights = np.column_stack([np.ones(len(points)), arms])
    return np.asarray(error * np.einsum("pj,ik->pikj", weights, np.eye(3)).reshape(-1, 3, 12))

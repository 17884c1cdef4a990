"""The default fit: the flange's face as a plane, its rim and bore as concentric circles in it."""

from __future__ import annotations

from flangeye import stage
from flangeye.models.targets import Flange
from flangeye.types import CircleFeature, FlangeCloud, Rejected
from flangeye_plugins.fit.rim_params import RimParams


@stage("fit.rim")
def fit_rim(cloud: FlangeCloud, flange: Flange, params: RimParams) -> CircleFeature | Rejected:
    """Fit the flange's rim and bore as concentric circles in its face.

    A robust plane gives depth and normal; the outermost and innermost points of the face, sector
    by sector, give two circles with one centre and free radii. The covariance has the edges'
    scatter in the face, where neighbouring points err together, and the plane's across it. There
    is no randomness. For a wrist circle the centre is moved along the normal by the plate's
    thickness, to where the robot's flange frame has its origin.
    """
    from flangeye_plugins.fit.face_and_rings import face_and_rings

    return face_and_rings(cloud, flange, params)

"""A vendor's plugin: a circle fit of its own, offered to recipes as fit.acme_hull."""

import numpy as np

from acme_flangeye.cost import cost_largest_axis
from acme_flangeye.scanner import scanner_acme
from flangeye import Params, hookimpl, stage
from flangeye.models.targets import Flange
from flangeye.types import CircleFeature, FlangeCloud, Rejected
from flangeye.types.geometry import basis_of_plane
from flangeye.units import Length, param


class HullParams(Params):
    tolerance: Length = param("1 mm", gt=0)
    """Largest error of the rim's radius."""


@stage("fit.acme_hull")
def fit_hull(cloud: FlangeCloud, flange: Flange, params: HullParams) -> CircleFeature | Rejected:
    """Fit the rim as the middle of the cloud's extent; quick, and rough."""
    axes = basis_of_plane(cloud.normal)
    local = (cloud.cloud.points() - cloud.centre) @ axes.T
    low, high = np.percentile(local[:, :2], [0.1, 99.9], axis=0)
    radius = float(np.mean(high - low) / 2)
    if abs(radius - flange.rim) > params.tolerance:
        return Rejected(f"rim radius {radius * 1e3:.2f} mm, expected {flange.rim * 1e3:.2f} mm")
    middle = np.array([*(low + high) / 2, np.median(local[:, 2])])
    covariance = (params.tolerance / 3) ** 2 * np.eye(3)
    return CircleFeature(
        centre=cloud.centre + middle @ axes,
        normal=None,  # the rough one is not worth a covariance
        radii={"rim": radius},
        covariance=covariance,
        normal_covariance=None,
        arc_coverage=1.0,
    )


@hookimpl
def flangeye_stages():
    return [fit_hull]


@hookimpl
def flangeye_parts():
    return [cost_largest_axis, scanner_acme]

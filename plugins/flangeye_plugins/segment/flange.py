"""Find the flange in a scan of the whole cell."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from flangeye import stage
from flangeye.models.targets import Flange
from flangeye.types import Capture, FlangeCloud, PointCloud, Rejected
from flangeye_plugins.segment.scale import RangeParams, check_scale

if TYPE_CHECKING:
    from flangeye_plugins.segment.grid import Grid


class SegmentParams(RangeParams):
    """Parameters of ``segment.flange``."""

    # Largest angle between the flange's normal and the view [rad]
    max_incidence: ClassVar[float] = float(np.radians(55))
    # Smallest share of the rim, and of the bore, to be seen
    min_coverage: ClassVar[float] = 0.3
    # How much depth bends from one coarse point to the next where a surface ends; five times the
    # scan's noise if that is more [m]
    crease: ClassVar[float] = 0.8e-3
    # Distance from the face, and beyond its circle, up to which points are kept [m]
    margin: ClassVar[float] = 2e-3


@stage("segment.flange")
def segment_flange(
    capture: Capture, flange: Flange, params: SegmentParams
) -> FlangeCloud | Rejected:
    """Find the flange by its size, flatness, rim, bore and holes, and cut it out.

    The steps of the paper's section 2.1.4, on a coarse view of the scan: pass-through, removal
    of stray points and clustering (smooth, connected pieces), plane, size, incidence. What is
    left is compared with the flange's rim and bore, by likelihood with a disc of any other size,
    and, where two discs or a blank one are left, with its holes. Only then the full resolution is
    touched, around the one disc found.

    Raises:
        StageError: The cloud is in millimetres, or otherwise a thousand times off.
    """
    from flangeye_plugins.segment.discs import DiscLimits, crop
    from flangeye_plugins.segment.grid import coarse_view
    from flangeye_plugins.segment.search import choose, find_discs

    view = coarse_view(capture.cloud.xyz, flange.rim / 15)
    if view is None:
        return Rejected("no finite point")
    check_scale(view.xyz, capture.id)
    inside = _pass_through(view, params)
    if inside is None:
        return Rejected(_nothing_inside(view, params))
    limits = DiscLimits(params.max_incidence, params.min_coverage, params.crease)
    discs = find_discs(inside, flange, limits)
    cut = partial(crop, capture.cloud.xyz, inside, radius=flange.outer, margin=params.margin)
    found = choose(discs, cut, flange)
    if isinstance(found, str):
        return Rejected(found)
    disc, points = found
    cloud = PointCloud(capture.cloud.frame, points)
    return FlangeCloud(cloud, disc.centre, disc.plane.normal, ratio=disc.ratio)


def _pass_through(view: Grid, params: SegmentParams) -> Grid | None:
    """Return the view without points too near or too far; None if there are none between."""
    depth = view.xyz[..., 2]
    outside = (depth < params.near) | (depth > params.far)
    if not outside.any():
        return view
    xyz = np.where(outside[..., None], np.float32(np.nan), view.xyz)
    return view._replace(xyz=xyz) if np.isfinite(xyz[..., 2]).any() else None


def _nothing_inside(view: Grid, params: SegmentParams) -> str:
    depth = view.xyz[..., 2]
    return (
        f"no point between near {params.near * 1e3:g} mm and far {params.far * 1e3:g} mm: "
        f"depths from {np.nanmin(depth) * 1e3:.0f} to {np.nanmax(depth) * 1e3:.0f} mm"
    )

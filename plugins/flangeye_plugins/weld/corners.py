"""Sharp corners of a plan: each leg between two is welded on its own, or the corners are rounded.

Without rounding the torch stops at a corner: the weld of one leg ends, and the tool is lifted,
turned and set down for the next. The finger runs ahead of the torch, straight beyond the end of its
leg, and the torch starts behind the next leg. Both have room only where the upright plate of a
fillet or lap joint ends at the corner.

With ``corner_radius`` tip and torch go round the corner, to either side: an arc replaces the plan's
corner, and touch measures the seam's offset from that arc. The tip stays pressed against the wall,
whether the next wall turns away from it or towards it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from flangeye.errors import StageError
from flangeye.types import Floats, Seam
from flangeye.types.geometry import arc_lengths, rows_at
from flangeye_plugins.weld.frame import flattened
from flangeye_plugins.weld.path import CHORD
from flangeye_plugins.weld.settings import WeldTactileParams


class Corner(NamedTuple):
    """A corner of a polyline.

    Attributes:
        point: Index of the corner's point.
        along: Arc length there [m].
        turn: Angle of the turn, positive to the left [rad].
    """

    point: int
    along: float
    turn: float


def corners_of(points: Floats) -> list[Corner]:
    """Return the corners of a polyline (N, 3) in the plane of the work, in their order."""
    planar = points[:, :2]
    along = arc_lengths(planar)
    turns = np.array([_turn(planar, along, s) for s in along])
    found: list[Corner] = []
    # A plan that turns by more than 35 degrees within two chords has a corner.
    for index in np.flatnonzero(np.abs(turns) > np.radians(35.0)).tolist():
        corner = Corner(index, float(along[index]), float(turns[index]))
        if found and corner.along - found[-1].along < 2 * CHORD:
            found[-1] = max(found[-1], corner, key=lambda each: abs(each.turn))
        else:
            found.append(corner)
    return found


def _turn(planar: Floats, along: Floats, s: float) -> float:
    """Return a polyline's turn to the left at an arc length [rad]; 0 near its ends."""
    if not CHORD <= s <= along[-1] - CHORD:
        return 0.0
    before, here, after = rows_at(s + np.array([-CHORD, 0.0, CHORD]), along, planar)
    (ax, ay), (bx, by) = here - before, after - here
    return float(np.arctan2(ax * by - ay * bx, ax * bx + ay * by))


def leg_of(seam: Seam, params: WeldTactileParams) -> Seam:
    """Return the leg of a plan to weld: the whole plan if it has no corner to stop at.

    Raises:
        StageError: The plan has corners but neither leg nor radius is set, or both are, or the leg
            does not exist, or there is no room for the tool at a corner or for the arc.
    """
    corners = corners_of(flattened(seam.points_in_base, seam.openings_in_base))
    if params.corner_radius is not None:
        return _rounded(seam, corners, params, params.corner_radius)
    if params.leg is None:
        if corners:
            raise StageError(
                f"weld.tactile: the seam has sharp corners ({_listed(corners)}), at which the "
                f"torch has to stop: write a step weld.tactile for each leg, leg: 1 to "
                f"{len(corners) + 1}; or corner_radius: 5 mm leads it round them"
            )
        return seam
    if params.leg > len(corners) + 1:
        raise StageError(
            f"weld.tactile: leg {params.leg} of a seam with {len(corners) + 1}; its sharp corners: "
            f"{_listed(corners) or 'none'}"
        )
    ends = corners[max(params.leg - 2, 0) : params.leg]
    for corner in ends:
        _require_room(corner, seam, params)
    bounds = [0, *(corner.point for corner in corners), len(seam.points_in_base) - 1]
    kept = slice(bounds[params.leg - 1], bounds[params.leg] + 1)
    return replace(
        seam,
        points_in_base=seam.points_in_base[kept],
        openings_in_base=seam.openings_in_base[kept],
        covariance=seam.covariance[kept],
    )


def _rounded(seam: Seam, corners: list[Corner], params: WeldTactileParams, radius: float) -> Seam:
    """Return the plan with each corner replaced by an arc of this radius [m]."""
    if params.leg is not None:
        raise StageError(
            "weld.tactile: with corner_radius the seam is welded in one go, without legs; leave "
            "out 'corner_radius' or 'leg'"
        )
    points = seam.points_in_base
    along = arc_lengths(points)
    ends = [0.0, *(along[each.point] for each in corners), along[-1]]
    pieces, kept = [], np.full(len(along), True)
    for corner, before, here, after in zip(corners, ends, ends[1:], ends[2:], strict=False):
        # From the corner to where an arc of this radius touches its legs
        cut = radius * np.tan(abs(corner.turn) / 2.0)
        room = min(here - before, after - here) / 2.0
        if cut > room:
            allowed = radius * room / cut
            raise StageError(
                f"weld.tactile: the corner {_listed([corner])} has no room for a corner_radius of "
                f"{radius * 1e3:.3g} mm, at most {allowed * 1e3:.3g} mm"
            )
        kept &= np.abs(along - here) >= cut
        pieces.append(_arc(points, along, here, cut, corner.turn))
    at = np.concatenate([along[kept], *(ticks for ticks, _ in pieces)])
    order = np.argsort(at)
    return replace(
        seam,
        points_in_base=np.concatenate([points[kept], *(arc for _, arc in pieces)])[order],
        openings_in_base=rows_at(at[order], along, seam.openings_in_base),
        covariance=rows_at(at[order], along, seam.covariance),
    )


def _arc(
    points: Floats, along: Floats, here: float, cut: float, turn: float
) -> tuple[Floats, Floats]:
    """Return the arc (K, 3) that rounds a corner, and its arc lengths (K,) on the plan.

    A rational quadratic Bezier curve with weight cos(turn / 2) is a circular arc (Piegl and Tiller
    1997, section 7.3).
    """
    first, corner, last = rows_at(here + cut * np.array([-1.0, 0.0, 1.0]), along, points)
    t = np.linspace(0.0, 1.0, 40)[:, None]
    weights = np.hstack([(1 - t) ** 2, 2 * t * (1 - t) * np.cos(turn / 2.0), t**2])
    arc = weights @ np.stack([first, corner, last]) / weights.sum(axis=1, keepdims=True)
    return here + cut * np.linspace(-1.0, 1.0, 40), arc


def _require_room(corner: Corner, seam: Seam, params: WeldTactileParams) -> None:
    outside = (params.side == "left") == (corner.turn > 0.0)
    one_wall = params.joint in ("fillet", "lap") and seam.half_angle is None
    if not (one_wall and outside):
        raise StageError(
            f"weld.tactile: at the corner {_listed([corner])} the finger ahead of the torch would "
            "run into a wall: room is only round the outside of the upright plate of a fillet or "
            "lap joint; press that plate ('side'), go round it with corner_radius, or end the "
            "plan before the corner"
        )


def _listed(corners: list[Corner]) -> str:
    return ", ".join(
        f"{np.degrees(each.turn):+.0f} deg at {each.along * 1e3:.0f} mm" for each in corners
    )

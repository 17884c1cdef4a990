"""The flange as a mesh, exact to a micrometre, in ``flange``: face at z = 0, z outwards."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from flangeye.errors import StageError
from flangeye.models.robots import Recess
from flangeye.models.targets import Flange
from flangeye.types import Floats
from flangeye_emulators.world.mesh import Mesh, circle, disc, lathe, merged, region, wall

HOLE_SEGMENTS = 120


@lru_cache(maxsize=8)
def flange_mesh(flange: Flange) -> Mesh:
    """Return the plate: face, chamfers, centring bore, threaded holes, pin hole, recesses.

    Chamfers fall at 45 degrees, as those of the published CAD models do. Recesses belong to the
    plate a robot is made with, and no other that a recipe puts on it.

    Raises:
        StageError: The holes run into the bore or the rim.
    """
    details = flange.details
    recesses = details.recesses if flange.name == details.standard else ()
    slots = [recess_outline(recess) for recess in recesses]
    places = _hole_places(flange)
    openings = [circle(radius, HOLE_SEGMENTS, centre) for centre, radius in places]
    bore = [circle(flange.bore, 720)] if flange.bore else []
    parts = [region(circle(flange.rim, 720), [*bore, *openings, *slots], 0.0), _edge(flange)]
    parts += [_hole(centre, radius, flange) for centre, radius in places]
    for slot, recess in zip(slots, recesses, strict=True):
        parts += [wall(slot, 0.0, -recess.depth), region(slot, [], -recess.depth)]
    return merged(parts + ([_bore(flange, flange.bore)] if flange.bore else []))


def wrist_mesh(flange: Flange) -> Mesh:
    """Return the housing behind the plate: a cylinder with a flat front."""
    details = flange.details
    outer, back = details.wrist / 2, -details.thickness
    front = [] if outer <= flange.outer else [(flange.outer * 0.98, back)]
    return lathe([*front, (outer, back), (outer, -details.wrist_length)])


def recess_outline(recess: Recess) -> Floats:
    """Return the (N, 2) closed outline of a slot that follows a circle, with round ends."""
    half, span = recess.width / 2, recess.half_span
    along = np.linspace(-span, span, 61)
    inner = _polar(recess.radius - half, along)
    outer = _polar(recess.radius + half, along[::-1])
    cap = np.linspace(0, np.pi, 62)[1:-1]
    end = _polar(recess.radius, np.array([span])) + _polar(half, span + np.pi - cap)
    start = _polar(recess.radius, np.array([-span])) + _polar(half, -span - cap)
    turn = np.array(
        [[np.cos(recess.angle), np.sin(recess.angle)],
         [-np.sin(recess.angle), np.cos(recess.angle)]]
    )  # fmt: skip
    return np.asarray(np.concatenate([inner, end, outer, start]) @ turn)


def _polar(radius: float, angle: Floats) -> Floats:
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _hole_places(flange: Flange) -> list[tuple[tuple[float, float], float]]:
    angles = [(angle, flange.hole) for angle in flange.holes]
    if flange.pin is not None:
        angles.append((flange.pin, flange.pin_hole))
    pitch, widest = flange.pitch, max((radius for _, radius in angles), default=0.0)
    if not (flange.bore or 0.0) < pitch - widest < pitch + widest < flange.rim:
        raise StageError(
            f"flange {flange.name}: holes of {2e3 * widest:.2f} mm on a pitch circle of "
            f"{2e3 * pitch:.2f} mm do not fit between its bore and its rim"
        )
    return [((pitch * float(np.cos(a)), pitch * float(np.sin(a))), r) for a, r in angles]


def _edge(flange: Flange) -> Mesh:
    chamfer = flange.outer - flange.rim
    corners = [(flange.rim, 0.0), (flange.outer, -chamfer)]
    return lathe([*corners, (flange.outer, -flange.details.thickness)])


def _bore(flange: Flange, edge: float) -> Mesh:
    details = flange.details
    radius, bottom = edge - details.bore_chamfer, -details.bore_depth
    side = lathe([(edge, 0.0), (radius, -details.bore_chamfer), (radius, bottom)])
    return merged([side, disc(radius, bottom)])


def _hole(centre: tuple[float, float], edge: float, flange: Flange) -> Mesh:
    sink, depth = flange.details.countersink, flange.details.hole_depth
    profile = [(edge, 0.0), (edge - sink, -sink), (edge - sink, -depth), (0.0, -depth)]
    return lathe(profile, HOLE_SEGMENTS, centre)

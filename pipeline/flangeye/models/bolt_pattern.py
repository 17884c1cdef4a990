"""Where the threaded holes and the pin hole are: the flange's angle about its own axis."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flangeye.maths.circles import distances
from flangeye.models.targets import Flange
from flangeye.types import Floats

TICKS = 720
"""Half a degree: 0.2 mm on the pitch circle of the most common flange."""


class HoleMatch(NamedTuple):
    """The rotation at which the empty places of a face are most like the flange's holes.

    Attributes:
        angle: From the first axis to the flange's x axis, about the normal [rad], in (-pi, pi].
        score: How much emptier the pattern's holes are than the rest of the ring, at most 1.
        rival: The best score elsewhere.
    """

    angle: float
    score: float
    rival: float


def match_holes(flat: Floats, flange: Flange) -> HoleMatch | None:
    """Return the angle of the hole pattern in a face, or None if no pattern is recognised.

    The face is empty where a hole is. How empty a ring about the pitch circle is, by angle, is
    compared with the known pattern at every rotation.

    Args:
        flat: (N, 2) points of the face about its centre, in the axes of ``basis_of_plane`` [m].
        flange: Whose pattern to look for; one without holes has none.
    """
    if not flange.holes:
        return None
    empty = emptiness(flat, flange.pitch, 0.5 * flange.hole)
    if empty is None:
        return None
    scores = _correlate(empty, hole_pattern(flange))
    best = int(np.argmax(scores))
    apart = np.abs((np.arange(TICKS) - best + TICKS // 2) % TICKS - TICKS // 2)
    rival = float(scores[apart > TICKS / (4 * len(flange.holes))].max())
    angle = 2 * np.pi * (best + _vertex(scores, best)) / TICKS
    return HoleMatch(float(_wrap(angle)), float(scores[best]), rival)


def roll_angle(flat: Floats, flange: Flange) -> float | None:
    """Return the angle of the flange's x axis in the face's own axes, or None if not visible.

    The pin hole tells apart the rotations that the threads alone leave equal. On the published
    clouds the right rotation scores 0.77 to 0.91, the next best 0.62 to 0.69; where the pin hole
    is out of sight both are equal, and there is no answer.

    Args:
        flat: See :func:`match_holes`.
        flange: Whose pattern to look for.
    """
    match = match_holes(flat, flange) if flange.pin is not None else None
    if match is None or match.score < 0.5 or match.rival > 0.9 * match.score:
        return None
    return match.angle


def emptiness(flat: Floats, pitch: float, half_width: float) -> Floats | None:
    """Return how empty a ring is at each of ``TICKS`` angles, 0 (as full as most) to 1 (empty).

    Args:
        flat: (N, 2) points about the centre [m].
        pitch: Radius of the ring [m].
        half_width: Half its width [m].

    Returns:
        (TICKS,), or None when there are too few points to see a hole.
    """
    x, y = flat.T.compress(np.abs(distances(flat) - pitch) < half_width, axis=1)
    turn = np.arctan2(y, x) / (2 * np.pi) * TICKS
    count = np.bincount(np.floor(turn).astype(np.intp) % TICKS, minlength=TICKS).astype(float)
    # As narrow a window as the points allow, half a hole wide at most.
    for reach in range(2, max(3, int(half_width / pitch * TICKS / (2 * np.pi)) + 1)):
        smooth = sum(np.roll(count, k) for k in range(-reach, reach + 1))
        usual = float(np.percentile(smooth, 75))
        # Points a place that is no hole must hold, for an empty place to mean anything
        if usual >= 5:
            return np.asarray(np.clip(1.0 - smooth / usual, 0.0, 1.0))
    return None


def hole_pattern(flange: Flange) -> Floats:
    """Return (TICKS,) ones where the flange's own ring is empty, zeros elsewhere."""
    angles = (np.arange(TICKS) + 0.5) / TICKS * 2 * np.pi
    pattern = np.zeros(TICKS)
    for middle, half in _openings(flange):
        pattern[np.abs(_wrap(angles - middle)) < half] = 1.0
    return pattern


def _openings(flange: Flange) -> list[tuple[float, float]]:
    """Return the middle and half width [rad] of every opening on the pitch circle."""
    openings = [(hole, np.arcsin(flange.hole / flange.pitch)) for hole in flange.holes]
    if flange.pin is not None:
        openings.append((flange.pin, np.arcsin(flange.pin_hole / flange.pitch)))
    for recess in flange.details.recesses:
        across = (recess.width / 2) ** 2 - (flange.pitch - recess.radius) ** 2
        if across > 0:
            openings.append((recess.angle, recess.half_span + np.sqrt(across) / recess.radius))
    return openings


def _correlate(empty: Floats, pattern: Floats) -> Floats:
    """Return, for every rotation, the emptiness inside the pattern less that outside it."""
    spectrum = np.fft.rfft(empty) * np.conj(np.fft.rfft(pattern))
    inside = np.fft.irfft(spectrum, TICKS)
    holes = pattern.sum()
    return np.asarray(inside / holes - (empty.sum() - inside) / (TICKS - holes))


def _vertex(scores: Floats, best: int) -> float:
    """Return how far from ``best`` the peak's centre of mass lies, in ticks."""
    near = np.arange(-6, 7)
    height = scores[(best + near) % len(scores)]
    height = np.clip(height - height.min(), 0.0, None)
    return float(near @ height / height.sum()) if height.sum() > 0 else 0.0


def _wrap(angle: Floats | float) -> Floats:
    return np.asarray(np.pi - (np.pi - angle) % (2 * np.pi))

"""Which of the discs in a scene is the flange, or why none is. Arrays only."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flangeye.models.bolt_pattern import match_holes
from flangeye.models.targets import Flange
from flangeye.types import Singles
from flangeye_plugins.segment.discs import Disc

BLANK = 0.2
"""A face without holes scores near 0, the published faces with five holes 0.77 and more, one
with large recesses besides its holes 0.35."""


def choose(
    discs: list[Disc], cut: Callable[[Disc], Singles], flange: Flange
) -> tuple[Disc, Singles] | str:
    """Return the disc that is the flange with its points, or why there is none.

    Args:
        discs: All flat parts of the scene.
        cut: Gives a disc's points at full resolution; asked for discs that fit.
        flange: What to look for.
    """
    fitting = _distinct([disc for disc in discs if disc.flaw is None], flange.rim)
    if not fitting:
        return _why_none(discs, flange)
    # A wrist circle has no holes to tell it by; what is seen of its rim has to do.
    cuts = [cut(disc) for disc in fitting]
    scores = [
        _hole_score(disc, points, flange) if flange.holes else disc.seen
        for disc, points in zip(fitting, cuts, strict=True)
    ]
    # A disc that scores less than this share of another's is not mistaken for it
    enough = max(BLANK, 0.6 * max(scores))
    marked = [k for k, score in enumerate(scores) if score >= enough]
    if not marked:
        return f"a disc {fitting[0].across * 1e3:.0f} mm across with a bore has no threaded holes"
    if len(marked) > 1:
        return _ambiguous([fitting[k] for k in marked])
    return fitting[marked[0]], cuts[marked[0]]


def _distinct(discs: list[Disc], apart: float) -> list[Disc]:
    """Return discs at different places, of those at one place the one seen best."""
    kept: list[Disc] = []
    for disc in sorted(discs, key=lambda d: -d.seen):
        if all(np.linalg.norm(disc.centre - other.centre) > apart for other in kept):
            kept.append(disc)
    return kept


def _hole_score(disc: Disc, cut: Singles, flange: Flange) -> float:
    """Return how well a disc's holes match the flange's; BLANK if undecidable."""
    points = cut.astype(np.float64)
    on_face = np.abs(disc.plane.heights(points)) < 3 * disc.plane.sigma + 1e-6
    face = points.compress(on_face, axis=0)
    flat = disc.plane.flatten(face) - disc.plane.flatten(disc.centre[None])
    match = match_holes(flat, flange)
    return BLANK if match is None else match.score


def _ambiguous(discs: list[Disc]) -> str:
    places = " and ".join(
        "(" + ", ".join(f"{c * 1e3:.0f}" for c in disc.centre) + ") mm" for disc in discs
    )
    return f"{len(discs)} discs look like the flange: at {places}; hide one or narrow near and far"


def _why_none(discs: list[Disc], flange: Flange) -> str:
    """Return the flaw of the disc that came nearest to being the flange."""
    if not discs:
        return "no flat surface in sight"
    best = max(discs, key=lambda d: (d.rank, d.seen))
    if best.rank > 0:
        return str(best.flaw)
    nearest = min(discs, key=lambda d: abs(np.log(d.across / (2 * flange.rim))))
    return (
        f"no plane of the flange's size: nearest candidate {nearest.flaw}, "
        f"flange {2e3 * flange.rim:.0f} mm"
    )

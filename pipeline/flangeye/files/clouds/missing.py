"""Missing points that a scanner's program wrote as numbers: zeros, -10000, or one far value."""

from __future__ import annotations

import numpy as np

from flangeye.files.clouds.table import Points

SAMPLE = 4096
"""Points among which such a number is looked for."""
SHARE = 0.01
"""Of the points at least: measured points are not equal to the last bit so often."""
FARTHER = 3.0
"""How many times farther than all others points of one depth are, whose x and y differ."""


def mark_missing(xyz: Points) -> str:
    """Set the points that stand for none to NaN, in place.

    A point that is repeated is none where it is the scanner's own origin, or farther than all
    others; so are points of one depth that is :data:`FARTHER` than all others.

    Args:
        xyz: (N, 3) in the file's own unit.

    Returns:
        What was taken for missing and how often, for people; empty where nothing was.
    """
    some = xyz[:: max(1, len(xyz) // SAMPLE)]
    some = some[np.isfinite(some).all(axis=1)]
    depths, counts = np.unique(some[:, 2], return_counts=True)
    # Points at least: fewer do no harm, and small tables may repeat what was measured
    if not len(depths) or counts.max() < max(SHARE * len(some), 100):
        return ""
    depth = depths[counts.argmax()]
    alike, others = some[some[:, 2] == depth], some[some[:, 2] != depth]
    point = alike[0]
    repeated = (alike == point).all(axis=1).mean() > 0.5
    if repeated and (not point.any() or _beyond(np.abs(point).max(), np.abs(others), 1.0)):
        gone, called = (xyz == point).all(axis=1), f"({', '.join(f'{x:g}' for x in point)})"
    elif _beyond(abs(depth), np.abs(others[:, 2]), FARTHER):
        gone, called = xyz[:, 2] == depth, f"a depth of {depth:g}"
    else:
        return ""
    xyz[gone] = np.nan
    return f"{np.count_nonzero(gone)} of {len(xyz)} points have {called}: taken as missing"


def _beyond(value: float, others: Points, times: float) -> bool:
    return bool(others.size) and value > times * float(others.max())

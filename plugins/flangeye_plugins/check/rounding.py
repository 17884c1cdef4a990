"""Positions that were written with too few decimals for what is asked of them."""

from __future__ import annotations

import numpy as np

from flangeye import part
from flangeye.doctor.diagnosis import Finding, Findings, RecordedSession
from flangeye.types import Floats

STEPS = (0.1, 1e-2, 1e-3, 1e-4, 1e-5)
"""Last decimals of positions in metres, millimetres and so on [m]."""
WHOLE = 1e-3
"""By what share of the step a position may miss a multiple of it."""
SHARE = 0.5
"""Rounding to a step moves a place by half of it, rms; this share of the limit is too much."""


@part("check.rounding")
def rounding(session: RecordedSession) -> Findings:
    """Positions are rounded as coarsely as the error that the recipe asks for."""
    seen = session.centres[session.seen]
    for whose, places in (("the arm", session.poses[:, :3, 3]), ("the target", seen)):
        step = _step(places)
        if step is not None and step / 2 >= SHARE * session.limit:
            what = (
                f"positions of {whose} are whole multiples of {1e3 * step:g} mm, and the recipe "
                f"asks for {1e3 * session.limit:g} mm; if they were rounded, that alone is "
                f"{1e3 * step / 2:.2g} mm"
            )
            fix = f"write positions with {1 + round(-np.log10(step))} or more decimals of a metre"
            yield Finding("rounded", what, fix, note=True)


def _step(places: Floats) -> float | None:
    """Return the coarsest step [m] that all coordinates are multiples of; None for none."""
    for step in STEPS:
        multiples = places / step
        if len(places) and np.abs(multiples - np.round(multiples)).max() < WHOLE:
            return step
    return None

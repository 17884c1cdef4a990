"""Poses that belong to other samples: shifted by some, or read too early or too late."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from flangeye import part
from flangeye.diagnosis import Finding, Findings, Floats, Mask, Session
from flangeye.mending import delayed, shifted
from flangeye_plugins.doctoring.asis import variants
from flangeye_plugins.doctoring.equations import equations_of
from flangeye_plugins.doctoring.fitting import fit
from flangeye_plugins.doctoring.significance import Evidence, best_of

SHIFTS = (1, -1, 2, -2, 3, -3)
FEWEST = 5
"""Samples with a target that an alternative must leave."""
DELAYS = 24
"""Delays tried on each side of none, up to the time between samples three times over."""


@part("check.order")
def order(session: Session) -> Findings:
    """Each scan belongs to the pose before or after its own, from the start or from some scan."""
    tried = list(_shifts(session))
    evidence = _evidence(session, [shifted(session.poses, *each) for each in tried])
    if evidence is None or evidence.probability == 1:
        return
    by, start = tried[evidence.which]
    which = "later" if by > 0 else "earlier"
    since = f" from '{session.ids[start]}' on" if start else ""
    what = f"each scan belongs to the pose {abs(by)} {which}{since}"
    where = {"shift_from": session.ids[start]} if start else {}
    poses, known = shifted(session.poses, by, start)
    mended = session.corrected(poses, shift=by, **where).where(known)
    yield Finding("shifted poses", what, mended.step(), (), *evidence[1:], mended)


def _shifts(session: Session) -> Iterator[tuple[int, int]]:
    """Give (by, start)."""
    yield from ((by, 0) for by in SHIFTS)
    yield from ((by, start) for by in (1, -1) for start in range(1, len(session) - 1))


@part("check.clock")
def clock(session: Session) -> Findings:
    """The poses were taken some time before or after the scans, while the arm moved."""
    times = session.times
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        return
    step = float(np.median(np.diff(times)))
    coarse = step * 3 * np.linspace(-1, 1, 2 * DELAYS)
    found = _delays(session, coarse)
    if found is None:
        return
    near = coarse[found.which] + np.linspace(-1, 1, 17) * step * 3 / DELAYS
    finer = _delays(session, near)
    if finer is None or finer.probability == 1:
        return
    delay = float(near[finer.which])
    which = "after" if delay > 0 else "before"
    what = f"the arm was at the scans' poses {abs(delay) * 1e3:.0f} ms {which} they were recorded"
    poses, known = delayed(session.poses, times, delay)
    mended = session.corrected(poses, delay=f"{delay * 1e3:.1f} ms").where(known)
    yield Finding("time offset", what, mended.step(), (), *finer[1:], mended)


def _delays(session: Session, delays: Floats) -> Evidence | None:
    poses = [delayed(session.poses, session.times, float(delay)) for delay in delays]
    return _evidence(session, poses, further=1)


def _evidence(
    session: Session, others: Sequence[tuple[Floats, Mask]], further: int = 0
) -> Evidence | None:
    """Hold other poses against those given, on the samples that have both."""
    known = np.array([mask for _, mask in others])
    enough = (known & session.seen).sum(axis=1) >= FEWEST
    if not enough.any():
        return None
    poses = np.array([poses for poses, _ in others])
    # Those with too few samples are put in as the session is, which is no better than itself.
    poses[~enough], known[~enough] = session.poses, True
    given = equations_of(session).without(~known)
    return best_of(fit(given), fit(variants(session, poses).without(~known)), further)

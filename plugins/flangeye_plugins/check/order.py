"""Poses that belong to other samples: shifted by some, or read too early or too late."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from flangeye import part
from flangeye.doctor.diagnosis import Arms, Findings, NotApplicable, RecordedSession
from flangeye.maths.pose_corrections import delaying, shifted
from flangeye.maths.streams import later, pose_at
from flangeye.types import Floats, Mask
from flangeye_plugins.check.equations import equations_of
from flangeye_plugins.check.fitting import fit
from flangeye_plugins.check.significance import Significance, best_of, helps

SHIFTS = (1, -1, 2, -2, 3, -3)
FEWEST = 5
"""Samples with a target that an alternative must leave."""
DELAYS = 24
"""Delays tried on each side of none, up to the time between samples three times over."""


Change = Callable[[Floats], tuple[Floats, Mask]]
"""Gives poses (N, 4, 4), and the samples (N,) that have one."""
Later = Callable[[float], tuple[Floats, Mask]]
"""Gives an arm's poses after a delay [s], and the samples that have one."""


_OF: dict[Arms, str] = {
    "both": "both arms", "first": "the first arm", "second": "the second arm",
}  # fmt: skip


class Alternative(NamedTuple):
    """Poses of other moments: the session with them, and the samples that have one."""

    session: RecordedSession
    known: Mask
    arms: Arms


@part("check.order")
def order(session: RecordedSession) -> Findings:
    """Scans are paired with the pose before or after their own, from the start or some scan."""
    session.require_samples()
    tried = list(_shifts(session))
    others = [_shifted(session, *each) for each in tried]
    evidence = _evidence(session, others)
    if evidence is None or evidence.probability == 1:
        return
    arms, by, start = tried[evidence.which]
    which = "later" if by > 0 else "earlier"
    since = f" from '{session.ids[start]}' on" if start else ""
    of = "" if session.seconds is None else f" of {_OF[arms]}"
    what = f"each scan belongs to the pose{of} {abs(by)} {which}{since}"
    corrected_session = others[evidence.which].session.where(others[evidence.which].known)
    if not helps(session.where(others[evidence.which].known), corrected_session):
        return
    yield evidence.finding("shifted poses", what, corrected_session)


def _shifts(session: RecordedSession) -> Iterator[tuple[Arms, int, int]]:
    """Give (arms, by, start)."""
    yield from ((arms, by, 0) for arms in session.arms for by in SHIFTS)
    yield from (("both", by, start) for by in (1, -1) for start in range(1, len(session) - 1))


def _shifted(session: RecordedSession, arms: Arms, by: int, start: int) -> Alternative:
    where = {"shift_from": session.ids[start]} if start else {}

    def change(poses: Floats) -> tuple[Floats, Mask]:
        return shifted(poses, by, start)

    return _at_other_times(session, change, arms, shift=by, **where)


def _at_other_times(
    session: RecordedSession, change: Change, arms: Arms, **correction: Any
) -> Alternative:
    """Return the session with what the controllers said at other times, the links with it."""
    moved, known = change(session.poses)

    def alike(poses: Floats) -> Floats:
        return moved if poses is session.poses else change(poses)[0]

    read = session.corrected(alike, arms, **correction)
    if session.links is not None:
        read = replace(read, links=alike(session.links))
    return Alternative(read, known, arms)


@part("check.clock")
def clock(session: RecordedSession) -> Findings:
    """The poses were taken some time before or after the scans, while the arm moved."""
    session.require_samples()
    times = session.times
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise NotApplicable("the samples have no times, or these do not rise")
    step = float(np.median(np.diff(times)))
    coarse = step * 3 * np.linspace(-1, 1, 2 * DELAYS)
    found = _evidence(session, _delays(session, coarse, session.arms), further=1)
    if found is None:
        return
    arms, middle = session.arms[found.which // len(coarse)], coarse[found.which % len(coarse)]
    near = middle + np.linspace(-1, 1, 17) * step * 3 / DELAYS
    others = _delays(session, near, [arms])
    finer = _evidence(session, others, further=1)
    if finer is None or finer.probability == 1:
        return
    delay = float(near[finer.which])
    which = "after" if delay > 0 else "before"
    whose = "the arm was" if session.seconds is None else f"{_OF[arms]} was"
    what = f"{whose} at the scans' poses {abs(delay) * 1e3:.0f} ms {which} they were recorded"
    corrected_session = others[finer.which].session.where(others[finer.which].known)
    if not helps(session.where(others[finer.which].known), corrected_session):
        return
    yield finer.finding("time offset", what, corrected_session)


def _delays(session: RecordedSession, delays: Floats, arms: Sequence[Arms]) -> list[Alternative]:
    made: dict[int, Later] = {}

    def later_of(poses: Floats) -> Later:
        if id(poses) not in made:
            made[id(poses)] = delaying(poses, session.times)
        return made[id(poses)]

    return [_delayed(session, later_of, each, float(delay)) for each in arms for delay in delays]


def _delayed(
    session: RecordedSession, later_of: Callable[[Floats], Later], arms: Arms, delay: float
) -> Alternative:
    def change(poses: Floats) -> tuple[Floats, Mask]:
        if session.motions is None or poses is not session.poses:
            return later_of(poses)(delay)
        known = np.array([later(each, delay) is not None for each in session.motions])
        return np.array([pose_at(each, delay) for each in session.motions]), known

    return _at_other_times(session, change, arms, delay=f"{delay * 1e3:.1f} ms")


def _evidence(
    session: RecordedSession, others: Sequence[Alternative], further: int = 0
) -> Significance | None:
    """Hold poses of other moments against those given, on the samples that have both."""
    known = np.array([other.known for other in others])
    enough = (known & session.seen).sum(axis=1) >= FEWEST
    if not enough.any():
        return None
    # Those with too few samples are put in as the session is, which is no better than itself.
    known[~enough] = True
    tried = [o.session if kept else session for o, kept in zip(others, enough, strict=True)]
    chosen, against = np.unique(known, axis=0, return_inverse=True)
    given = fit(equations_of(session).without(~chosen))
    others_fit = fit(equations_of(*tried).without(~known))
    return best_of(given, others_fit, further, against=against.reshape(-1))

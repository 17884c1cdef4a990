"""A plan as it is shown before anything moves: a row for each stop, and for each place left out."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from flangeye.maths.geometry import angle_between
from flangeye.motion.planning import PlannedPose
from flangeye.motion.reach import Refusal
from flangeye.types import Floats

LISTED = 12
"""Places left out of a plan that are listed, at most."""


@dataclass(frozen=True)
class PlanRow:
    """A line of the plan that is shown without motion; fields as in its JSON.

    Attributes:
        id: Identifier of the capture; None where no pose is possible.
        role: What it is for: verification, calibration, or ``left out``.
        place: Of the flange in ``base`` [m].
        tilt: Of the flange against the line of sight [rad].
        path: ``direct`` or ``by home``; None where nobody knows, or there is none.
        seconds: What the motion takes [s].
        why_not: Why the arm cannot get there.
    """

    id: str | None
    role: str
    place: list[float]
    tilt: float | None = None
    path: str | None = None
    seconds: float = 0.0
    why_not: str | None = None

    def line(self) -> str:
        """Return it for people."""
        place = " ".join(f"{1e3 * x:7.1f}" for x in self.place)
        if self.id is None or self.tilt is None:
            return f"{'-':4}  {self.role:12}  {place}           {self.why_not}"
        way = f"barred: {self.why_not}" if self.why_not else "not known"
        if self.path:
            way = f"{self.path:8}  {self.seconds:4.1f} s"
        return f"{self.id}  {self.role:12}  {place}  {np.degrees(self.tilt):3.0f} deg  {way}"


def row_at(id_: str, role: str, pose: PlannedPose, eye: Floats) -> PlanRow:
    """Return the row of a stop, without its path; the scanner stands at ``eye`` (3,) [m]."""
    place, normal = pose.base_T_flange[:3, 3], pose.base_T_flange[:3, 2]
    return PlanRow(id_, role, list(_place(place)), float(angle_between(normal, eye - place)))


def left_out(refusals: Iterable[Refusal], poses: Iterable[PlannedPose]) -> list[PlanRow]:
    """Return a row for each place at which no pose is possible, a few of every reason first."""
    reasons = defaultdict[tuple[float, ...], Counter[str]](Counter)
    for refusal in refusals:
        reasons[_place(refusal.place)][refusal.reason] += 1
    for pose in poses:
        reasons.pop(_place(pose.base_T_flange[:3, 3]), None)
    rows, nth = [], Counter[str]()
    for place, counts in reasons.items():
        ((why, _),) = counts.most_common(1)
        nth[why] += 1
        rows.append((nth[why], PlanRow(None, "left out", list(place), why_not=why)))
    rows.sort(key=lambda row: row[0])
    return [row for _, row in rows]


def seconds_of(rows: Iterable[PlanRow]) -> float:
    """Return what the motion takes [s]."""
    return sum(row.seconds for row in rows)


def as_plan(
    head: str, rows: Sequence[PlanRow], without: Sequence[PlanRow]
) -> tuple[str, dict[str, Any]]:
    """Return a plan for people, below its first line, and for programs."""
    more = len(without) - LISTED
    lines = [
        head,
        "stop  for           flange at (mm, base)    tilt  path      time",
        *(row.line() for row in [*rows, *without[:LISTED]]),
        *([f"and {more} more places"] if more > 0 else []),
    ]
    plan = {"seconds": seconds_of(rows), "rows": [asdict(row) for row in [*rows, *without]]}
    return "\n".join(lines), plan


def _place(point: Floats) -> tuple[float, ...]:
    """Return a point [m] rounded to 0.1 mm, the resolution at which the plan compares places."""
    return tuple(round(float(x), 4) + 0.0 for x in point)

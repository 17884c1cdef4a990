"""The account of the run: what was set aside, what the time went into, what made the result."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime

from flangeye.report.facts import Facts
from flangeye.report.units import duration


@dataclass(frozen=True)
class RejectedRow:
    """One capture that was not used."""

    id: str
    stage: str
    reason: str


@dataclass(frozen=True)
class SetAside:
    """What was not used, and why.

    Attributes:
        rows: One each.
        counts: (how many, stage, reason with the numbers left out), most frequent first.
        early: Set aside before the solver.
        late: Set aside by the solver.
    """

    rows: list[RejectedRow] = field(default_factory=list)
    counts: list[tuple[int, str, str]] = field(default_factory=list)
    early: int = 0
    late: int = 0


def set_aside_of(facts: Facts) -> SetAside:
    """Return every capture that was not used, by reason and one by one."""
    stages = {x.id: x.stage for x in facts.log.rejections}
    solver = facts.result.method or "solver"
    rows = []
    for each in facts.set_aside:
        stage = stages.get(each.id, solver)
        reason = (each.reason or "no reason was given").removeprefix(f"{stage}: ")
        rows.append(RejectedRow(each.id, stage, reason))
    kinds = Counter((x.stage, without_numbers(x.reason)) for x in rows)
    counts = [(n, stage, reason) for (stage, reason), n in kinds.most_common()]
    early = sum(x.id in stages for x in rows)
    return SetAside(rows, counts, early, len(rows) - early)


def without_numbers(reason: str) -> str:
    """Return a reason with every number as an ellipsis, so that equal reasons count as one."""
    return re.sub(r"(?<![\w.])[-+]?\d+(?:[.,]\d+)*(?:e[-+]?\d+)?(?!\w)", "…", reason)


@dataclass(frozen=True)
class Timing:
    """What one step took; ``share`` of the slowest, for a bar."""

    step: str
    total: str
    calls: int
    each: str
    slowest: str
    share: float


def timings_of(facts: Facts) -> list[Timing]:
    """Return what each step took, in the order of the recipe."""
    timing = facts.result.timing
    longest = max((x.seconds for x in timing.values()), default=0.0) or 1.0
    slowest: dict[str, float] = {}
    for entry in facts.log.entries:
        slowest[entry.step] = max(entry.seconds, slowest.get(entry.step, 0.0))
    return [
        Timing(
            step,
            duration(spent.seconds),
            spent.calls,
            duration(spent.seconds / max(spent.calls, 1)),
            duration(slowest[step]) if step in slowest else "",
            spent.seconds / longest,
        )
        for step, spent in sorted(timing.items(), key=lambda item: _step_order(item[0]))
    ]


def idle_of(facts: Facts) -> str:
    """Return how much of its session an arm had nothing to do; empty without an arm."""
    shares = [spent.idle for spent in facts.result.timing.values() if spent.idle is not None]
    return f"{max(shares):.1%}" if shares else ""


def _step_order(label: str) -> tuple[int, str]:
    index, _, name = label.partition(".")
    return (int(index) if index.isdigit() else 0, name)


def provenance_of(facts: Facts) -> list[tuple[str, str]]:
    """Return what made this result: name and value."""
    made, log = facts.result.provenance, facts.log
    rows = {
        "Recipe": made.recipe,
        "Recipe, SHA-256": made.recipe_hash if facts.recipe else "",
        "Input, hash": made.input_hash,
        "Seed": str(made.seed),
        "Captured": _captured(facts),
        "Log": log.path.name,
        "Libraries": _listed(made.versions),
        "Plugins": _listed(made.plugins),
    }
    return [(name, value) for name, value in rows.items() if value]


def _captured(facts: Facts) -> str:
    times = [meta["time_ns"] for meta in facts.log.poses.values() if meta["time_ns"]]
    if not times:
        return ""
    first, last = (datetime.fromtimestamp(x / 1e9, UTC) for x in (min(times), max(times)))
    return f"{first:%Y-%m-%d %H:%M:%S} to {last:%Y-%m-%d %H:%M:%S} UTC"


def _listed(versions: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in versions.items())

"""Facts of a run from its log, finished or not, in the structure of ``result.json``.

A finished run's log contains its result. For a killed run the same document is assembled from the
log with the same functions, so that reports need not distinguish the two.
"""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from typing import Any, Literal

import numpy as np

from flangeye import types as t
from flangeye.errors import FlangeyeError
from flangeye.files.yaml_lines import parse_yaml
from flangeye.models.loading import load_model
from flangeye.models.workspace import work_of
from flangeye.units import parse_quantity
from flangeye.workflow.log.read import RunLog
from flangeye.workflow.recipe.own_models import carried_files
from flangeye.workflow.report.units import duration
from flangeye.workflow.result import contract as r
from flangeye.workflow.result import logged_result, sections, sha256


@dataclass(frozen=True)
class Facts:
    """One run, finished or not.

    Attributes:
        log: The run's log.
        result: The run's result, or one assembled from the log.
        recipe: The resolved recipe, or an empty text.
    """

    log: RunLog
    result: r.Result
    recipe: str

    @property
    def estimate(self) -> tuple[str, r.TransformResult] | None:
        """Name and value of the transform that was estimated, if the solver came so far."""
        return next(iter(self.result.transforms.items()), None)

    @cached_property
    def header(self) -> dict[str, Any]:
        """The recipe as data; empty without one."""
        found = parse_yaml(self.recipe, "recipe").data if self.recipe else {}
        return found if isinstance(found, dict) else {}

    def section(self, name: str) -> dict[str, Any]:
        """Return a section of the recipe; empty if a foreign log has no valid one."""
        found = self.header.get(name)
        return found if isinstance(found, dict) else {}

    def model(self, kind: Literal["robots", "scanners"]) -> Any:
        """Return the recipe's arm or scanner; None if its file is not on this machine.

        Args:
            kind: Kind of the models: the name of their folder.
        """
        name = self.section(kind.removesuffix("s")).get("model")
        with suppress(FlangeyeError), carried_files(self.log.models) as folder:
            return load_model(kind, name, folder) if name else None
        return None

    @property
    def of_cell(self) -> bool:
        """Whether several cameras or targets may have been calibrated: those of a cell."""
        return any(o.camera != t.CAMERA for o in self.log.observations()[:1])

    @property
    def base_T_camera(self) -> t.Array | None:
        """Camera's pose (4, 4) in the base; None if another transform was estimated."""
        found = self.result.transforms.get("base_T_camera")
        return None if found is None else np.array(found.matrix)

    @property
    def measured(self) -> list[r.ObservationResult]:
        """Poses with a fitted circle, in capture order."""
        order = {capture: i for i, capture in enumerate(self.log.poses)}
        fitted = [o for o in self.result.observations if o.centre_in_camera is not None]
        return sorted(fitted, key=lambda o: order.get(o.id, len(order)))

    @property
    def residuals(self) -> dict[str, float]:
        """Residual by pose [m]; empty without an estimate."""
        if self.estimate is None:
            return {}
        return {o.id: o.residual for o in self.measured if o.residual is not None}

    @property
    def set_aside(self) -> list[r.ObservationResult]:
        """Captures that some stage or the solver decided not to use."""
        return [
            o
            for o in self.result.observations
            if not o.used and (o.centre_in_camera is None or self.estimate is not None)
        ]


def facts_of(log: RunLog) -> Facts:
    """Return the facts in ``log``."""
    attached = log.attachments.get("recipe.resolved.yaml", log.attachments.get("recipe.yaml", b""))
    recipe = attached.decode("utf-8", "replace")
    result = logged_result(log) or _so_far(log, recipe)
    return Facts(log, result, recipe)


def _so_far(log: RunLog, recipe: str) -> r.Result:
    """Return the result a killed run would have had, as far as it came."""
    source = log.source or t.Source(fingerprint="")
    calibration = log.calibration()
    pairs = calibration.pairs if calibration else _unsolved(log.observations())
    header = parse_yaml(recipe, "recipe").data if recipe else {}
    box = work_of(calibration, source, _box(header)) if calibration else None
    notes = [*source.notes, *(calibration.notes if calibration else ())]
    verifications = {e.step: e.value for e in log.of_kind("verify")}
    return r.Result(
        title=str(header.get("title", log.path.name)),
        status="incomplete",
        method=calibration.method if calibration else None,
        transforms=sections.transforms_result(calibration),
        expected_error=sections.expected_error_result(calibration),
        observations=sections.observations_result(pairs, log.rejections),
        workspace=sections.workspace_result(box) if box else None,
        holdout=sections.holdout_result(verifications),
        verifications=sections.verifications_result(verifications),
        truth=_truth(source, calibration, box),
        simulated=source.simulated,
        warnings=sections.warnings_result(notes),
        notes=t.records_of(calibration.notes if calibration else ()),
        timing=_timing(log),
        provenance=_provenance(source, t.records_of(notes), header, recipe),
    )


def _unsolved(observations: Sequence[t.Observation]) -> list[t.Pair]:
    reason = "the run ended before the solver"
    return [t.Pair(o, np.zeros(3), used=False, reason=reason) for o in observations]


def _box(header: dict[str, Any]) -> t.Box | None:
    """Return the box of the recipe's ``workspace`` section."""
    section = header.get("workspace")
    if not section:
        return None
    centre, size = ([parse_quantity(x, "length") for x in section[k]] for k in ("centre", "size"))
    return t.Box(np.array(centre), np.array(size))


def _truth(
    source: t.Source, calibration: t.HandEye | None, box: t.Box | None
) -> r.TruthResult | None:
    if source.truth is None or calibration is None or box is None:
        return None
    # What the arm is like stands in the recipe, which a killed run may not have left.
    return sections.truth_result(calibration, replace(source.truth, unseen=()), box)


def _timing(log: RunLog) -> dict[str, r.StageTiming]:
    spent: dict[str, list[float]] = {}
    for meta in log.poses.values():
        spent.setdefault(meta["step"], []).append(meta["seconds"])
    for entry in log.entries:
        spent.setdefault(entry.step, []).append(entry.seconds)
    return {
        step: r.StageTiming(seconds=sum(each), calls=len(each))
        for step, each in sorted(spent.items())
    }


def _provenance(
    source: t.Source, notes: list[str], header: dict[str, Any], recipe: str
) -> r.Provenance:
    return r.Provenance(
        versions={},  # the machine that reports need not be the one that ran
        plugins={},
        recipe="",
        recipe_hash=sha256(recipe),
        input_hash=source.fingerprint,
        seed=int(header.get("seed", 0)),
        notes=notes,
    )


@dataclass(frozen=True)
class RejectedRow:
    """One capture that was not used."""

    id: str
    stage: str
    reason: str


@dataclass(frozen=True)
class SetAside:
    """The captures that were not used, with their reasons.

    Attributes:
        rows: One row for each capture.
        counts: (number, stage, reason), most frequent first; reasons that differ in numbers only
            are merged.
        early: Number of captures rejected before the solver.
        late: Number of captures rejected by the solver.
    """

    rows: list[RejectedRow] = field(default_factory=list)
    counts: list[tuple[int, str, str]] = field(default_factory=list)
    early: int = 0
    late: int = 0


def set_aside_of(facts: Facts) -> SetAside:
    """Return every capture that was not used, by reason and one by one."""
    early = {x.id: x for x in facts.log.rejections}
    solver = facts.result.method or "solver"
    rows, kinds = [], defaultdict[tuple[str, str], list[str]](list)
    for each in facts.set_aside:
        by_stage = early.get(each.id)
        stage = by_stage.stage if by_stage else solver
        reason = (each.reason or "no reason was given").removeprefix(f"{stage}: ")
        rows.append(RejectedRow(each.id, stage, reason))
        shared = by_stage.reason if by_stage else reason
        # Reasons that differ in numbers alone are one; the 6 of M6 is none
        kinds[
            stage, re.sub(r"(?<![\w.])[-+]?\d+(?:[.,]\d+)*(?:e[-+]?\d+)?(?!\w)", "…", shared)
        ].append(shared)
    counts = [(len(alike), stage, _first_of(alike)) for (stage, _), alike in kinds.items()]
    counts.sort(key=lambda each: -each[0])
    ahead = sum(x.id in early for x in rows)
    return SetAside(rows, counts, ahead, len(rows) - ahead)


def _first_of(reasons: list[str]) -> str:
    return reasons[0] + ("; the others alike" if set(reasons[1:]) - {reasons[0]} else "")


@dataclass(frozen=True)
class Timing:
    """Duration of one step; ``share`` is relative to the slowest, for a bar."""

    step: str
    total: str
    calls: int
    each: str
    slowest: str
    share: float


def timings_of(facts: Facts) -> list[Timing]:
    """Return the duration of each step, in recipe order."""
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
    """Return the arm's idle share of the session; empty without an arm."""
    shares = [spent.idle for spent in facts.result.timing.values() if spent.idle is not None]
    return f"{max(shares):.1%}" if shares else ""


def _step_order(label: str) -> tuple[int, str]:
    index, _, name = label.partition(".")
    return (int(index) if index.isdigit() else 0, name)


def provenance_of(facts: Facts) -> list[tuple[str, str]]:
    """Return the provenance of a result: recipe, versions, hashes."""
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

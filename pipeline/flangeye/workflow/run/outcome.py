"""The outcome of a run, and its ``result.json``."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from flangeye import types as t
from flangeye.errors import CalibrationRefused
from flangeye.models.cell import cell_in
from flangeye.models.workspace import work_of
from flangeye.plugin.registry import Registry
from flangeye.workflow.recipe.load import Recipe
from flangeye.workflow.result import contract as r
from flangeye.workflow.result import library_versions, sections, sha256


@dataclass
class Outcome:
    """The outcome of a run, filled in step by step.

    Attributes:
        source: Source of the captures.
        calibration: The solver's result; a ``VerifiedHandEye`` if every verification passed.
        verifications: Results of verification, by step label.
        rejections: Captures set aside before solving.
        refused: Reason why the calibration was refused.
        seen: The observations that reached the solver.
        scan: The scan of the workpiece.
        seam: The planned seam.
        weld: Record of the weld.
        exports: Files that export steps wrote.
    """

    source: t.Source
    calibration: t.HandEye | None = None
    verifications: dict[str, t.Verification] = field(default_factory=dict)
    rejections: list[t.Rejection] = field(default_factory=list)
    refused: CalibrationRefused | None = None
    seen: list[t.Observation] = field(default_factory=list)
    scan: t.WorkpieceScan | None = None
    seam: t.Seam | None = None
    weld: t.WeldReport | None = None
    exports: list[t.ExportedFile] = field(default_factory=list)

    @property
    def status(self) -> Literal["refused", "verified", "unverified"]:
        """``refused``, ``verified`` or ``unverified``."""
        if self.refused:
            return "refused"
        return "verified" if isinstance(self.calibration, t.VerifiedHandEye) else "unverified"

    def pairs(self) -> Sequence[t.Pair]:
        """Return every observation, with its residual when there is a calibration."""
        if self.calibration:
            return self.calibration.pairs
        nothing = np.zeros(3)
        return [t.Pair(o, nothing, used=False, reason="refused before solving") for o in self.seen]


@dataclass
class Truths:
    """The truth of a simulation, kept from every stage until the result is final.

    Attributes:
        cell: The true unknowns.
        seams: The true seams by name, (N, 3) in ``base`` [m].
    """

    cell: t.Truth | None = None
    seams: Mapping[str, t.Array] = field(default_factory=dict)


def result_of(
    outcome: Outcome,
    recipe: Recipe,
    registry: Registry,
    watch: Stopwatch,
    truths: Truths = Truths(),  # noqa: B008  never written to
) -> r.Result:
    """Return the document of a run that ended, refused or not."""
    calibration, pairs = outcome.calibration, outcome.pairs()
    scan = outcome.scan and replace(outcome.scan, truth=truths.seams)
    holdout = sections.holdout_result(outcome.verifications)
    # The top level of result.json is for the arm as its controller reports it: readers that know
    # nothing of the corrected arm command the robot correctly
    known = calibration.as_reported().correction if calibration else None
    result = r.Result(
        title=recipe.header.title,
        status=outcome.status,
        refused=outcome.refused.wrong if outcome.refused else None,
        advice=outcome.refused.advice if outcome.refused else "",
        transforms=sections.transforms_result(calibration),
        correction=sections.correction_result(known),
        answers=sections.answers_result(calibration, holdout),
        expected_error=sections.expected_error_result(calibration),
        true=sections.true_result(calibration),
        observations=sections.observations_result(pairs, outcome.rejections),
        holdout=holdout,
        verifications=sections.verifications_result(outcome.verifications),
        seam=sections.seam_result(outcome.seam, scan),
        weld=sections.weld_result(outcome.weld, scan),
        simulated=outcome.source.simulated,
        warnings=sections.warnings_result([*recipe.notes, *outcome.source.notes, *_notes(outcome)]),
        notes=t.records_of(_notes(outcome)),
        exports={file.name: file.text for file in outcome.exports},
        timing=_timing(watch),
        provenance=_provenance(outcome, recipe, registry),
    )
    given = recipe.context.get(t.Box)
    if calibration and (box := work_of(calibration, outcome.source, given)):
        result.method = calibration.method
        result.workspace = sections.workspace_result(box)
        if truth := truths.cell:
            result.truth = sections.truth_result(calibration, truth, box, cell_in(recipe.context))
    result.warnings += sections.standing_warnings(result)
    return result


def _timing(watch: Stopwatch) -> dict[str, r.StageTiming]:
    return {
        label: r.StageTiming(seconds=seconds, calls=watch.calls[label], idle=watch.idle.get(label))
        for label, seconds in sorted(watch.seconds.items())
    }


def _notes(outcome: Outcome) -> list[str]:
    """Return the notes of the solver, of the scan of the workpiece, and of the weld."""
    told = (outcome.calibration, outcome.scan, outcome.weld)
    return [note for value in told if value is not None for note in value.notes]


def _provenance(outcome: Outcome, recipe: Recipe, registry: Registry) -> r.Provenance:
    return r.Provenance(
        versions=library_versions(),
        plugins=registry.versions(),
        recipe=recipe.name,
        recipe_hash=sha256(recipe.resolved()),
        input_hash=outcome.source.fingerprint,
        seed=recipe.header.seed,
        notes=t.records_of([*recipe.notes, *outcome.source.notes, *_notes(outcome)]),
    )


class Stopwatch:
    """Exclusive time per label: the outer step's clock stops while an inner step runs.

    Attributes:
        seconds: Duration of each step by label [s].
        calls: Number of calls of each step by label.
        idle: Share of the time in which an arm was idle, by label; None without an arm.
    """

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.calls: Counter[str] = Counter()
        self.idle: dict[str, float | None] = {}
        self._running: list[str] = []
        self._since: float  # when time was charged last

    @contextmanager
    def timing(self, label: str) -> Iterator[None]:
        """Add the time spent in the context to ``label``."""
        self._charge()
        self._running.append(label)
        self.calls[label] += 1
        try:
            yield
        finally:
            self._charge()
            self._running.pop()

    def add(self, label: str, seconds: float) -> None:
        """Add time that was spent on another core to ``label``."""
        self.calls[label] += 1
        self.seconds[label] += seconds

    def _charge(self) -> None:
        now = time.perf_counter()
        if self._running:
            # A pulled stream nests its steps: the time since the last change is the innermost
            # step's
            self.seconds[self._running[-1]] += now - self._since
        self._since = now

"""What a run came to, and the ``result.json`` that tells it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from flangeye import result as r
from flangeye import types as t
from flangeye.recipe import Recipe
from flangeye.registry import Registry
from flangeye.stopwatch import Stopwatch
from flangeye.workspace import work_of


@dataclass
class Outcome:
    """What a run came to.

    Attributes:
        source: Where the captures came from.
        calibration: What the solver gave; a ``VerifiedHandEye`` when every verification passed.
        verifications: By step label.
        rejections: Captures set aside before solving.
        refused: Why the calibration was refused.
        seen: The observations that reached the solver.
        scan: The scan of the workpiece.
        seam: What was planned from it.
        weld: What the torch did.
    """

    source: t.Source
    calibration: t.HandEye | None = None
    verifications: dict[str, t.Verification] = field(default_factory=dict)
    rejections: list[t.Rejection] = field(default_factory=list)
    refused: str | None = None
    seen: list[t.Observation] = field(default_factory=list)
    scan: t.WorkpieceScan | None = None
    seam: t.Seam | None = None
    weld: t.WeldReport | None = None

    @property
    def status(self) -> str:
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


def result_of(outcome: Outcome, recipe: Recipe, registry: Registry, watch: Stopwatch) -> r.Result:
    """Return the document of a run that ended, refused or not."""
    calibration, pairs = outcome.calibration, outcome.pairs()
    result = r.Result(
        title=recipe.header.title,
        status=outcome.status,
        refused=outcome.refused,
        transforms=r.transforms_result(calibration),
        correction=r.correction_result(calibration),
        observations=r.observations_result(pairs, outcome.rejections),
        holdout=r.holdout_result(outcome.verifications),
        verifications=r.verifications_result(outcome.verifications),
        seam=r.seam_result(outcome.seam, outcome.scan),
        weld=r.weld_result(outcome.weld, outcome.scan),
        timing=_timing(watch),
        provenance=_provenance(outcome, recipe, registry),
    )
    given = recipe.context.get(t.Box)
    box = work_of(calibration, outcome.source, given) if calibration else None
    if calibration and box:
        result.method = calibration.method
        result.workspace = r.workspace_result(calibration, box)
        if truth := outcome.source.truth:
            result.truth = r.truth_result(calibration, truth, box)
    return result


def _timing(watch: Stopwatch) -> dict[str, r.StageTiming]:
    return {
        label: r.StageTiming(seconds=seconds, calls=watch.calls[label])
        for label, seconds in sorted(watch.seconds.items())
    }


def _provenance(outcome: Outcome, recipe: Recipe, registry: Registry) -> r.Provenance:
    solver_notes = outcome.calibration.notes if outcome.calibration else ()
    scan_notes = outcome.scan.notes if outcome.scan else ()
    return r.Provenance(
        versions=r.library_versions(),
        plugins=registry.versions(),
        recipe=recipe.name,
        recipe_hash=r.sha256(recipe.resolved()),
        input_hash=outcome.source.fingerprint,
        seed=recipe.header.seed,
        notes=[*outcome.source.notes, *solver_notes, *scan_notes],
    )

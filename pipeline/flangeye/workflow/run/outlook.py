"""Quality of a calibration from the poses so far: during a run, or after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flangeye import types as t
from flangeye.errors import FlangeyeError
from flangeye.models.workspace import Coverage, coverage_of, workspace_of
from flangeye.plugin.registry import Registry
from flangeye.workflow.log.read import RunLog
from flangeye.workflow.recipe.load import Recipe
from flangeye.workflow.run.folder import recipe_of_log
from flangeye.workflow.run.runner import Runner


@dataclass(frozen=True, eq=False)
class Outlook:
    """The calibration from the poses so far.

    Attributes:
        residuals: Residuals of the used poses [m], by pose.
        set_aside: Reason why a pose was not used, by pose.
        error: Predicted 95 % error at the work [m]; None where unknown.
        missing: The solver's message on the missing motion; empty if there is none.
        coverage: Part of the workspace covered by the poses, if known.
    """

    residuals: dict[str, float] = field(default_factory=dict)
    set_aside: dict[str, str] = field(default_factory=dict)
    error: float | None = None
    missing: str = ""
    coverage: Coverage | None = None

    def lines(self) -> list[str]:
        """Return the outlook as printable lines."""
        poses = [f"{pose}  {size * 1e3:.3f} mm" for pose, size in self.residuals.items()]
        poses += [f"{pose}  set aside: {why}" for pose, why in self.set_aside.items()]
        worth = "expected error: not known yet"
        if self.error is not None:
            worth = f"expected error: 95 % below {self.error * 1e3:.3f} mm at the work"
        covered = [f"covered: {self.coverage}"] if self.coverage else []
        missing = [f"missing: {self.missing}"] if self.missing else []
        return [*poses, worth, *covered, *missing, *(f"better: {x}" for x in self.better)]

    @property
    def better(self) -> list[str]:
        """Motions that would improve the calibration."""
        return self.coverage.lacking() if self.coverage else []


def outlook_of_log(log: RunLog, registry: Registry) -> Outlook:
    """Return the quality of the calibration so far from a log's captures and recipe."""
    recipe = recipe_of_log(log, registry)
    return outlook(recipe, registry, log.observations(), log.source or t.Source(fingerprint=""))


def motions_to_add(log: RunLog, registry: Registry) -> list[str]:
    """Return the motions that the poses of a log lack; empty if the workspace is covered."""
    recipe = recipe_of_log(log, registry)
    covered = _coverage(recipe, log.observations(), log.source or t.Source(fingerprint=""))
    return covered.lacking() if covered else []


def outlook(
    recipe: Recipe, registry: Registry, seen: Sequence[t.Observation], source: t.Source
) -> Outlook:
    """Return the result of the recipe's solve step on the observations so far.

    Args:
        recipe: The run's recipe.
        registry: The registry it was checked with.
        seen: Observations so far.
        source: Provenance of the observations.
    """
    # The truth of a simulation is no business of the solver's.
    runner = Runner(recipe, registry, t.ArchivePath())
    try:
        found = runner.solve(seen, replace(source, truth=None))
    except FlangeyeError as error:
        return Outlook(missing=str(error), coverage=_coverage(recipe, seen, source))
    used = {p.observation.id: float(np.linalg.norm(p.residual)) for p in found.pairs if p.used}
    aside = {p.observation.id: p.reason or "not used" for p in found.pairs if not p.used}
    worth = found.expected.p95 if found.expected else None
    return Outlook(used, aside, worth, "", _coverage(recipe, seen, source))


def _coverage(recipe: Recipe, seen: Sequence[t.Observation], source: t.Source) -> Coverage | None:
    seen = [o for o in seen if t.FLANGE in o.poses]
    pairs = [t.Pair(o, np.zeros(3)) for o in seen]
    box = workspace_of(source, recipe.context.get(t.Box), pairs)
    return coverage_of(box, [o.base_T_flange.matrix for o in seen]) if box and seen else None

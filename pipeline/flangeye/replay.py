"""Run from a log: what the steps before a given one gave is read back instead of done again."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.recipe import Recipe, parse_recipe
from flangeye.registry import Registry
from flangeye.runlog import RunLog, read_run
from flangeye.stage import KINDS

_ORDER = list(KINDS)


@dataclass(frozen=True)
class Replay:
    """A log, and where in the recipe to start.

    Attributes:
        log: The log.
        at: Index of the first step to do again.
        kind: Kind of that step.
    """

    log: RunLog
    at: int
    kind: str

    @property
    def source(self) -> t.Source:
        """Where the logged captures came from."""
        return self.log.source or t.Source(fingerprint="")

    def stream(self) -> t.Captures | t.Observations:
        """Return what the log gives to the step ``at``.

        Raises:
            StageError: The log does not hold it.
        """
        if self.kind == "acquire":
            raise StageError("--at the acquire step: that is the whole recipe; leave out --from")
        if self.kind == "segment":
            return self._scans()
        if self.kind == "fit" and not self.log.of_kind("segment"):
            return self._scans()
        if self.kind == "fit":
            captures = [capture for capture, _ in self.log.flange_clouds()]
            return t.Captures(captures, self.source, len(captures))
        observations = self.log.observations()
        return t.Observations(observations, self.source, len(observations))

    def _scans(self) -> t.Captures:
        if not self.log.has_full_clouds:
            raise StageError(
                f"{self.log.path}: holds thinned scans only, which cannot be segmented again; "
                "start --at a later step, or record with log: {clouds: full}"
            )
        return t.Captures(self.log.captures(), self.source, len(self.log.poses))

    def segmented(self) -> dict[str, t.FlangeCloud] | None:
        """Return the segmented flanges by capture, when segmenting is not done again."""
        if self.kind != "fit" or not self.log.of_kind("segment"):
            return None
        return {capture.id: flange for capture, flange in self.log.flange_clouds()}

    def views(self) -> t.Views:
        """Return the verification views, when they are not segmented again."""
        again = self.kind in ("segment", "fit")
        return t.Views() if again else self.log.views()

    def rejections(self) -> list[t.Rejection]:
        """Return the captures that were set aside by the steps that are not done again."""
        earlier = _ORDER[: _ORDER.index(self.kind)]
        return [r for r in self.log.rejections if r.stage.partition(".")[0] in earlier]

    def given(self, stage: str) -> Any:
        """Return what ``stage``, a step that runs once, gave.

        Raises:
            StageError: The run ended before.
        """
        found = self.log.given(stage)
        if found is None:
            raise StageError(f"{self.log.path}: ended before {stage}; use --at {stage}")
        return found


@dataclass(frozen=True)
class Earlier:
    """A run that ended early and is gone on with.

    Attributes:
        log: Its log.
    """

    log: RunLog

    @property
    def resumed(self) -> t.Resumed:
        """The captures it took, whatever became of them."""
        aside = {rejection.id for rejection in self.log.rejections}
        return t.Resumed(frozenset({*self.log.finished, *aside}))

    def became(self) -> dict[str, t.Observation | None]:
        """Return what became of each of them."""
        nothing = dict.fromkeys(sorted(self.resumed.done))
        return {**nothing, **{o.id: o for o in self.log.observations()}}


def replay_from(log: RunLog, recipe: Recipe, at: str) -> Replay:
    """Return the replay that starts at the step ``at``: its index, its name or its label.

    Raises:
        StageError: There is no such step; names those there are.
    """
    for step in recipe.steps:
        if at in (str(step.index), step.stage.name, step.label):
            return Replay(log, step.index, step.stage.kind)
    known = ", ".join(step.stage.name for step in recipe.steps)
    raise StageError(f"--at {at}: the recipe has no such step; its steps are {known}")


def earlier_run(path: Path, registry: Registry) -> tuple[Recipe, Earlier]:
    """Return the recipe of a run that ended early, and what it gathered.

    Args:
        path: The run's folder, or its log.
        registry: The plugins on offer.

    Raises:
        StageError: There is no such log, it holds no recipe, or the run came to its end.
    """
    log = read_run(path / "run.mcap" if path.is_dir() else path)
    if log.result is not None:
        raise StageError(f"{log.path}: this run came to its end; there is nothing to go on with")
    text = log.attachments.get("recipe.resolved.yaml")
    if text is None:
        raise StageError(f"{log.path}: holds no recipe; it cannot be gone on with")
    name = log.path.absolute().parent.name.partition("_")[2] or "resumed"
    recipe = parse_recipe(text.decode(), name, registry)
    if not resumable(recipe):
        raise StageError(f"{log.path}: {recipe.steps[0].stage.name} begins anew each time")
    return recipe, Earlier(log)


def resumable(recipe: Recipe) -> bool:
    """Return whether the recipe's source leaves out what an earlier run already took."""
    return any(t.Resumed in get_args(need) for need in recipe.steps[0].stage.needs.values())

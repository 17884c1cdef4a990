"""What a run starts from: nothing, a log of an earlier run, or a run that ended early.

The runner asks a starting point for what it has; what it has not is done. A log is a source like
any other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, get_args

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.log.read import RunLog, read_run
from flangeye.plugin.registry import Registry
from flangeye.plugin.stage import KINDS
from flangeye.recipe.load import Recipe, parse_recipe
from flangeye.recipe.steps import Step

_ORDER = list(KINDS)

Acquire = Callable[[], Any]
"""Does the recipe's acquire step."""


class Gathered(NamedTuple):
    """A capture that an earlier run took, and what that run made of it."""

    capture: t.Capture
    flange: t.FlangeCloud | None
    observation: t.Observation | None


class FromNothing:
    """Every step is done."""

    @property
    def simulated(self) -> bool:
        """Whether a simulated cell has to be set up again to scan with it."""
        return False

    @property
    def resumed(self) -> t.Resumed | None:
        """The captures an earlier run took, whatever became of them."""
        return None

    def stream(self, acquire: Acquire) -> t.Captures | t.Observations:
        """Return what the steps work on."""
        stream: t.Captures | t.Observations = acquire()
        return stream

    def does(self, step: Step) -> bool:
        """Return whether a step is done, rather than read back."""
        return True

    def given(self, step: Step) -> Any:
        """Return what a step that runs once, and is not done, gave."""
        raise NotImplementedError(f"{step.label} is to be done")

    def segmented(self, capture: str) -> t.FlangeCloud | None:
        """Return the flange in a capture that is not segmented again, or None."""
        return None

    def views(self) -> t.Views:
        """Return the verification views that are there already."""
        return t.Views()

    def rejections(self) -> list[t.Rejection]:
        """Return the captures that were set aside by steps that are not done again."""
        return []

    def gathered(self) -> Iterator[Gathered]:
        """Return what an earlier run gathered, which is logged again."""
        return iter(())


@dataclass(frozen=True)
class FromLog(FromNothing):
    """What the steps before one gave is read back from a log (``--from``, ``--at``).

    Attributes:
        log: The log.
        at: Index of the first step to do again.
        kind: Kind of that step.
    """

    log: RunLog
    at: int
    kind: str

    @property
    def simulated(self) -> bool:
        """Whether the log is of a simulation."""
        return self._source.truth is not None

    @property
    def _source(self) -> t.Source:
        return self.log.source or t.Source(fingerprint="")

    @property
    def _reads_flanges(self) -> bool:
        return self.kind == "fit" and bool(self.log.of_kind("segment"))

    def stream(self, acquire: Acquire) -> t.Captures | t.Observations:
        """Return what the log gives to the step ``at``.

        Raises:
            StageError: The log does not hold it.
        """
        if self.kind == "acquire":
            raise StageError("--at the acquire step: that is the whole recipe; leave out --from")
        if self._reads_flanges:
            captures = [capture for capture, _ in self.log.flange_clouds()]
            return t.Captures(captures, self._source, len(captures))
        if self.kind in ("segment", "fit"):
            return self._scans()
        observations = self.log.observations()
        return t.Observations(observations, self._source, len(observations))

    def _scans(self) -> t.Captures:
        if not self.log.has_full_clouds:
            raise StageError(
                f"{self.log.path}: holds thinned scans only, which cannot be segmented again; "
                "start --at a later step, or record with log: {clouds: full}"
            )
        return t.Captures(self.log.readings(), self._source, len(self.log.poses))

    def does(self, step: Step) -> bool:
        """Return whether a step is done, rather than read back."""
        return self.at <= step.index

    def given(self, step: Step) -> Any:
        """Return what a step that runs once gave.

        Raises:
            StageError: The run ended before.
        """
        found = self.log.given(step.stage.name)
        if found is None:
            name = step.stage.name
            raise StageError(f"{self.log.path}: ended before {name}; use --at {name}")
        return found

    def segmented(self, capture: str) -> t.FlangeCloud | None:
        """Return the flange in a capture that is not segmented again, or None."""
        return self._flanges.get(capture) if self._reads_flanges else None

    @cached_property
    def _flanges(self) -> dict[str, t.FlangeCloud]:
        return {capture.id: flange for capture, flange in self.log.flange_clouds()}

    def views(self) -> t.Views:
        """Return the verification views, when they are not segmented again."""
        again = self.kind in ("segment", "fit")
        return t.Views() if again else self.log.views()

    def rejections(self) -> list[t.Rejection]:
        """Return the captures that were set aside by the steps that are not done again."""
        earlier = _ORDER[: _ORDER.index(self.kind)]
        return [r for r in self.log.rejections if r.stage.partition(".")[0] in earlier]


@dataclass(frozen=True)
class FromEarlierRun(FromNothing):
    """A run that ended early and is gone on with (``--resume``).

    Attributes:
        log: Its log.
        segments: Whether the recipe segments.
    """

    log: RunLog
    segments: bool

    @property
    def resumed(self) -> t.Resumed:
        """The captures it took, whatever became of them."""
        aside = {rejection.id for rejection in self.log.rejections}
        return t.Resumed(frozenset({*self.log.finished, *aside}), self.log.last_joints)

    def stream(self, acquire: Acquire) -> t.Captures | t.Observations:
        """Return what is left to take, told what became of the rest."""
        stream: t.Captures | t.Observations = acquire()
        if isinstance(stream, t.Captures):
            stream.outcomes.update(dict.fromkeys(sorted(self.resumed.done)))
            stream.outcomes.update({o.id: o for o in self.log.observations()})
        return stream

    def views(self) -> t.Views:
        """Return the verification views of that run."""
        return self.log.views()

    def rejections(self) -> list[t.Rejection]:
        """Return the captures that run set aside."""
        return list(self.log.rejections)

    def gathered(self) -> Iterator[Gathered]:
        """Return what that run gathered, so that the new log stands by itself."""
        fitted = {o.id: o for o in self.log.observations()}
        unsegmented = ((capture, None) for capture in self.log.captures())
        for capture, flange in self.log.flange_clouds() if self.segments else unsegmented:
            yield Gathered(capture, flange, fitted.get(capture.id))


def restart_at(log: RunLog, recipe: Recipe, at: str) -> FromLog:
    """Return the starting point that does the step ``at``, and those after it.

    Args:
        log: Holds what the steps before gave.
        recipe: The recipe.
        at: A step's index, name or label.

    Raises:
        StageError: There is no such step; names those there are.
    """
    for step in recipe.steps:
        if at in (str(step.index), step.stage.name, step.label):
            return FromLog(log, step.index, step.stage.kind)
    known = ", ".join(step.stage.name for step in recipe.steps)
    raise StageError(f"--at {at}: the recipe has no such step; its steps are {known}")


def earlier_run(path: Path, registry: Registry) -> tuple[Recipe, FromEarlierRun]:
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
    text = log.text("recipe.resolved.yaml")
    if text is None:
        raise StageError(f"{log.path}: holds no recipe; it cannot be gone on with")
    name = log.path.absolute().parent.name.partition("_")[2] or "resumed"
    recipe = parse_recipe(text, name, registry)
    if not resumable(recipe):
        raise StageError(f"{log.path}: {recipe.steps[0].stage.name} begins anew each time")
    segments = any(step.stage.kind == "segment" for step in recipe.steps)
    return recipe, FromEarlierRun(log, segments)


def resumable(recipe: Recipe) -> bool:
    """Return whether the recipe's source leaves out what an earlier run already took."""
    return any(t.Resumed in get_args(need) for need in recipe.steps[0].stage.needs.values())


def restart_hint(recipe: Recipe, log: Path) -> str:
    """Return the command that runs on what a log holds, with other parameters."""
    later = [step.stage for step in recipe.steps if step.stage.kind != "acquire"]
    whole = recipe.header.log.clouds == "full"
    again = [stage for stage in later if whole or stage.kind != "segment"]
    command = f"flangeye run {recipe.name} --from {log} --at {again[0].name} --set PATH=VALUE"
    if again[0] is later[0]:
        return command
    return f"{command} (to do {later[0].name} again, record with --set log.clouds=full)"

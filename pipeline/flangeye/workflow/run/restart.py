"""Starting points of a run: nothing, a log of an earlier run, or a run that ended early.

The runner asks the starting point for existing results and computes those that are missing. A log
is a source of captures like any other.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple, Protocol, TypeVar, get_args

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.plugin.registry import Registry
from flangeye.plugin.stage import KINDS
from flangeye.workflow.log.read import RunLog, read_notes, read_run
from flangeye.workflow.recipe.load import Recipe
from flangeye.workflow.recipe.steps import Step
from flangeye.workflow.run.folder import recipe_of_log

Acquire = Callable[[], Any]
"""Runs the recipe's acquire step."""


class _Named(Protocol):
    @property
    def id(self) -> str: ...


Each = TypeVar("Each", bound=_Named)


class EarlierCapture(NamedTuple):
    """A capture of an earlier run, with that run's results for it."""

    capture: t.Capture
    flange: t.FlangeCloud | None
    observation: t.Observation | None


class FromNothing:
    """A run from the start: every step is done."""

    @property
    def simulated(self) -> bool:
        """Whether a simulated cell has to be set up again to scan with it."""
        return False

    @property
    def resumed(self) -> t.Resumed | None:
        """All captures of an earlier run, used or not."""
        return None

    @property
    def first(self) -> int:
        """Number of captures to take before those of the earlier run are counted."""
        return 0

    def stream(self, acquire: Acquire) -> t.Captures | t.Observations:
        """Return the input of the first step."""
        stream: t.Captures | t.Observations = acquire()
        return stream

    def does(self, step: Step) -> bool:
        """Return whether a step is executed; otherwise its result is read from the log."""
        return True

    def given(self, step: Step) -> Any:
        """Return the logged result of a step that runs once, if it is not run again."""
        raise NotImplementedError(f"{step.label} has no logged result")

    def segmented(self, capture: str) -> t.FlangeCloud | None:
        """Return the flange in a capture that is not segmented again, or None."""
        return None

    def views(self) -> t.Views:
        """Return the verification views of the earlier run."""
        return t.Views()

    def rejections(self) -> list[t.Rejection]:
        """Return the captures rejected by steps that are not repeated."""
        return []

    def gathered(self) -> Iterator[EarlierCapture]:
        """Return the captures of an earlier run, to be logged again."""
        return iter(())


@dataclass(frozen=True)
class FromLog(FromNothing):
    """Start in the middle: results of earlier steps are read from a log (``--from``, ``--at``).

    Attributes:
        log: The log.
        at: Index of the first step to do again.
        kind: Kind of that step.
        left_out: Captures to leave out.
    """

    log: RunLog
    at: int
    kind: str
    left_out: frozenset[str] = frozenset()

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
        """Return the logged inputs of the step ``at``.

        Raises:
            StageError: The log does not contain them.
        """
        if self.kind == "acquire":
            raise StageError("--at the acquire step: that is the whole recipe; leave out --from")
        if self._reads_flanges:
            captures = list(self._kept(capture for capture, _ in self.log.flange_clouds()))
            return t.Captures(captures, self._source, len(captures))
        if self.kind in ("segment", "fit"):
            return self._scans()
        observations = list(self._kept(self.log.observations()))
        return t.Observations(observations, self._source, len(observations))

    def _kept(self, taken: Iterable[Each]) -> Iterator[Each]:
        return (each for each in taken if each.id not in self.left_out)

    def _scans(self) -> t.Captures:
        if not self.log.has_full_clouds:
            raise StageError(
                f"{self.log.path}: holds thinned scans only, which cannot be segmented again; "
                "start --at a later step, or record with log: {clouds: full}"
            )
        readings = self._kept(self.log.readings())
        return t.Captures(readings, self._source, len(self.log.poses) - len(self.left_out))

    def does(self, step: Step) -> bool:
        """Return whether a step is executed; otherwise its result is read from the log."""
        return self.at <= step.index

    def given(self, step: Step) -> Any:
        """Return the logged result of a step that runs once.

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
        return t.Views() if again else t.Views(self._kept(self.log.views()))

    def rejections(self) -> list[t.Rejection]:
        """Return the captures rejected by the steps that are not repeated."""
        order = list(KINDS)
        # The steps that run again decide anew about the captures that they rejected
        earlier = order[: order.index(self.kind)]
        why = "left out by --leave-out"
        named = [t.Rejection(each, "acquire", why) for each in sorted(self.left_out)]
        found = [r for r in self.log.rejections if r.stage.partition(".")[0] in earlier]
        return [*self._kept(found), *named]


@dataclass(frozen=True)
class FromEarlierRun(FromNothing):
    """A run that ended early and is resumed (``--resume``).

    Attributes:
        log: Log of the earlier run.
        segments: Whether the recipe has a segment step.
        retaken: Captures to repeat; their earlier data are ignored.
    """

    log: RunLog
    segments: bool
    retaken: frozenset[str] = frozenset()

    @property
    def resumed(self) -> t.Resumed:
        """The earlier run's captures that are not taken again, used or rejected."""
        aside = {rejection.id for rejection in self.log.rejections}
        done = frozenset({*self.log.finished, *aside}) - self.retaken
        return t.Resumed(done, self.log.last_joints)

    @property
    def first(self) -> int:
        """Number of captures to take again; they come first, before a solver has enough."""
        return len(self.retaken)

    def stream(self, acquire: Acquire) -> t.Captures | t.Observations:
        """Return the source's stream, with the outcomes of the earlier captures."""
        stream: t.Captures | t.Observations = acquire()
        if isinstance(stream, t.Captures):
            # An adaptive plan reads here which poses were visited; None: nothing was measured there
            stream.outcomes.update(dict.fromkeys(sorted(self.resumed.done)))
            kept = [o for o in self.log.observations() if o.id not in self.retaken]
            stream.outcomes.update({o.id: o for o in kept})
        return stream

    def views(self) -> t.Views:
        """Return the earlier run's verification views, except those taken again."""
        return t.Views(view for view in self.log.views() if view.id not in self.retaken)

    def rejections(self) -> list[t.Rejection]:
        """Return the earlier run's rejected captures, except those taken again."""
        return [r for r in self.log.rejections if r.id not in self.retaken]

    def gathered(self) -> Iterator[EarlierCapture]:
        """Return the earlier run's captures, so that the new log is complete in itself."""
        fitted = {o.id: o for o in self.log.observations()}
        unsegmented = ((capture, None) for capture in self.log.captures())
        for capture, flange in self.log.flange_clouds() if self.segments else unsegmented:
            if capture.id not in self.retaken:
                yield EarlierCapture(capture, flange, fitted.get(capture.id))


def restart_at(log: RunLog, recipe: Recipe, at: str, left_out: Collection[str] = ()) -> FromLog:
    """Return a starting point from which step ``at`` and the later ones are run.

    Args:
        log: Log with the results of the earlier steps.
        recipe: The recipe.
        at: A step's index, name or label.
        left_out: Captures to leave out.

    Raises:
        StageError: There is no such step or capture; the message lists the existing ones.
    """
    for step in recipe.steps:
        if at in (str(step.index), step.stage.name, step.label):
            found = _named("--leave-out", left_out, log)
            return FromLog(log, step.index, step.stage.kind, found)
    known = ", ".join(step.stage.name for step in recipe.steps)
    raise StageError(f"--at {at}: the recipe has no such step; its steps are {known}")


def _named(option: str, wanted: Collection[str], log: RunLog) -> frozenset[str]:
    """Return captures that were named.

    Raises:
        StageError: The log has no such capture.
    """
    known = {*log.poses, *(o.id for o in log.observations()), *(r.id for r in log.rejections)}
    most = 12
    for each in wanted:
        if each not in known:
            near = ", ".join(sorted(known)[:most]) + (" …" if len(known) > most else "")
            raise StageError(f"{option} {each}: {log.path} has no such capture; it has {near}")
    return frozenset(wanted)


def earlier_run(
    path: Path, registry: Registry, retaken: Collection[str] = ()
) -> tuple[Recipe, FromNothing]:
    """Return the recipe and captures of a run that ended early.

    A run that stopped in its weld is resumed there; the weld then overlaps the bead.

    Args:
        path: The run's folder, or its log.
        registry: The installed plugins.
        retaken: Captures to repeat; the run may then have finished.

    Raises:
        StageError: There is no log or no recipe in it, the run finished, or it has no such capture.
    """
    log = read_run(path / "run.mcap" if path.is_dir() else path)
    ended = log.result is not None and not _stopped_in_weld(log.result)
    if ended and not retaken:
        raise StageError(
            f"{log.path}: this run is complete; there is nothing to resume "
            "(--retake ID takes a capture again)"
        )
    name = log.path.absolute().parent.name.partition("_")[2] or "resumed"
    if not log.has_recipe:
        raise StageError(f"{log.path}: holds no recipe; it cannot be resumed")
    recipe = recipe_of_log(log, registry, name=name)
    weld = None if retaken else _begun_weld(log, recipe)
    if weld is not None:
        going_on = [f"steps.{weld.index}.resume={log.path.absolute()}"]
        return recipe_of_log(log, registry, going_on, name), restart_at(log, recipe, weld.label)
    if not resumable(recipe):
        raise StageError(f"{log.path}: {recipe.steps[0].stage.name} cannot be resumed")
    segments = any(step.stage.kind == "segment" for step in recipe.steps)
    return recipe, FromEarlierRun(log, segments, _named("--retake", retaken, log))


def _stopped_in_weld(result: Mapping[str, Any]) -> bool:
    weld = result.get("weld") or {}
    return not weld.get("completed", True)


def _begun_weld(log: RunLog, recipe: Recipe) -> Step | None:
    """Return the last weld that a run began, if it can be resumed."""
    welds = [s for s in recipe.steps if s.params and "resume" in type(s.params).model_fields]
    begun = {note.step for note in read_notes(log.path, {s.label for s in welds})}
    return next((step for step in reversed(welds) if step.label in begun), None)


def resumable(recipe: Recipe) -> bool:
    """Return whether the recipe's source can skip captures that an earlier run took."""
    return any(t.Resumed in get_args(need) for need in recipe.steps[0].stage.needs.values())


def restart_hint(recipe: Recipe, called: str, log: Path) -> str:
    """Return the command that reruns from a log with other parameters.

    Args:
        recipe: The recipe of the run.
        called: Name or path of the recipe as the user gave it.
        log: Log of the run.
    """
    later = [step.stage for step in recipe.steps if step.stage.kind != "acquire"]
    whole = recipe.header.log.clouds == "full"
    again = [stage for stage in later if whole or stage.kind != "segment"]
    run = f"flangeye run {quote(called)} --from {quote(str(log))}"
    command = f"{run} --at {again[0].name} --set PATH=VALUE"
    if again[0] is later[0]:
        return command
    return f"{command} (to do {later[0].name} again, record with --set log.clouds=full)"

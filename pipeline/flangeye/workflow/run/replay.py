"""Repeat the decisions of a step from its log, and compare them with the logged ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from flangeye.errors import StageError
from flangeye.plugin.registry import PluginNotFoundError, Registry
from flangeye.workflow.log.read import log_of, read_notes


@dataclass(frozen=True)
class ReplayedStep:
    """Comparison of repeated decisions with those in the log.

    Attributes:
        what: Text that describes the decisions.
        same: Whether repeated and logged decisions are the same.
        figures: Differences by name with unit.
    """

    what: str
    same: bool
    figures: Mapping[str, float] = field(default_factory=dict)


class Repeat(Protocol):
    """How a ``replay`` part is called."""

    def __call__(self, log: Path, step: str) -> ReplayedStep:
        """Return the comparison of the decisions of ``step``, repeated from its log."""


def replay_steps(log: Path, registry: Registry) -> Iterator[tuple[str, ReplayedStep]]:
    """Yield the comparison of each step of a log whose decisions can be repeated.

    A step ``weld.tactile`` can be repeated if a plugin has a part ``replay.tactile``.

    Raises:
        StageError: The file cannot be read, or has no such step.
    """
    log = log_of(log)
    steps = dict.fromkeys(note.step for note in read_notes(log))
    found = False
    for step in steps:
        try:
            part = registry.part(f"replay.{step.rpartition('.')[2]}")
        except PluginNotFoundError:
            continue
        found = True
        yield step, part(log, step)
    if not found:
        raise StageError(f"{log}: holds no step whose decisions can be repeated")

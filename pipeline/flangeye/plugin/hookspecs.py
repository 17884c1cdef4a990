"""The hooks that plugins may implement: their offers, and the events of a run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pluggy

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from flangeye.models.graph import Emulator, Graph
    from flangeye.plugin.stage import Part, Stage
    from flangeye.types import Capture, Rejection, Source

PROJECT = "flangeye"
"""Entry-point group and pluggy project name."""

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def flangeye_stages() -> Iterable[Stage] | Mapping[str, str]:  # type: ignore[empty-body]
    """Return the stages this plugin offers to recipes.

    A mapping of import paths, ``{"fit.hull": "acme.hull:fit_hull"}``, imports a module only when a
    recipe uses it.
    """


@hookspec
def flangeye_parts() -> Iterable[Part] | Mapping[str, str]:  # type: ignore[empty-body]
    """Return the parts (costs, readers, plans) that parameters may name, or their import paths."""


@hookspec
def flangeye_emulators() -> Iterable[Emulator]:  # type: ignore[empty-body]
    """Return the robot controllers this plugin can imitate, for ``flangeye emulator``."""


@hookspec
def flangeye_graphs() -> Mapping[str, Callable[[], Graph]]:  # type: ignore[empty-body]
    """Return, by name, the graphs of running nodes that this plugin can join."""


@hookspec
def flangeye_run_started(source: Source, total: int | None) -> None:
    """A run began: where its captures come from, and how many there will be, if known."""


@hookspec
def flangeye_captured(step: str, capture: Capture, seconds: float) -> None:
    """A capture arrived, before any stage has seen it."""


@hookspec
def flangeye_stage_finished(step: str, capture: str | None, value: Any, seconds: float) -> None:
    """A step gave ``value``; ``capture`` is its id for the steps that run once per capture."""


@hookspec
def flangeye_noted(step: str, name: str, value: Any) -> None:
    """A step that is under way wrote ``value`` into its log, under ``name``."""


@hookspec
def flangeye_capture_rejected(rejection: Rejection) -> None:
    """A stage set a capture aside."""


@hookspec
def flangeye_capture_finished(capture: str) -> None:
    """A capture went through every per-capture step, or was rejected by one."""


@hookspec
def flangeye_run_finished(result: dict[str, Any]) -> None:
    """The run ended, refused or not, with the content of ``result.json``."""

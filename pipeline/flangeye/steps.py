"""The steps of a recipe: a stage with its parameters each, in an order that makes sense."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import NoneType
from typing import Any, get_args

from flangeye import types as t
from flangeye.catalogue import Flange, RobotModel, ScannerModel, SecondRobot, Sphere
from flangeye.configuration import DEFAULT, Configuration
from flangeye.devices import MotionAllowed, RobotDriver, ScannerDriver
from flangeye.stage import KINDS, Params, Stage

Complain = Callable[[Sequence[Hashable], str], None]

SECTIONS = {
    RobotModel: ("robot", "{model: …}"),
    ScannerModel: ("scanner", "{model: …}"),
    Flange: ("robot", "{model: …}"),
    Sphere: ("feature", "{sphere: {diameter: 38.1 mm, centre: [0 mm, 0 mm, 60 mm]}}"),
    t.Seed: ("seed", "0"),
    Configuration: ("configuration", "{name: eye-in-hand, place: unknown}"),
    SecondRobot: ("second_robot", "{model: …}"),
    RobotDriver: ("robot", "{model: …, driver: {ur_rtde: {host: 192.168.1.10}}, limits: …}"),
    ScannerDriver: ("scanner", "{model: …, driver: {watched_folder: {path: …}}}"),
}
"""What stages may ask for of a recipe's header: the section it comes from, and an example."""


@dataclass(frozen=True)
class Step:
    """One step of a recipe: a stage with its checked parameters.

    Attributes:
        index: Place in the recipe, from 0.
        stage: The plugin.
        params: Its parameters, or None when it takes none.
    """

    index: int
    stage: Stage
    params: Params | None

    @property
    def label(self) -> str:
        """Name in logs and reports: ``2.fit.rim``."""
        return f"{self.index}.{self.stage.name}"


class StepOrder:
    """Walks the steps and says where one stands that cannot stand there."""

    def __init__(self, complain: Complain, given: Mapping[Any, Any]) -> None:
        """Start before the first step.

        Args:
            complain: Told each mistake: where, and what.
            given: What stages may ask for from the start, by type.
        """
        self._configuration: Configuration = given.get(Configuration) or DEFAULT
        self._circles = True
        self._complain = complain
        self._have: set[Any] = {*given, t.ArchivePath, t.Box, t.Journal, MotionAllowed}
        self._rank = 0
        self._kinds: list[str] = []

    def visit(self, index: int, name: str, stage: Stage | None) -> None:
        """Check one step against those before it; ``stage`` is None when it is not installed."""
        kind = name.partition(".")[0]
        if kind not in KINDS:
            return
        at = ("steps", index, name)
        self._check_place(at, kind)
        takes = KINDS[kind].takes
        needs = _required(stage.needs.values()) if stage else takes[:1]
        for need in needs:
            if need not in self._have:
                self._complain(at, _missing(need))
        if stage and kind == "fit":
            self._circles = t.CircleFeature in stage.gives
        if stage and kind in ("solve", "refine", "verify"):
            self._check_configuration(at, stage)
        gives = stage.gives if stage and kind == "acquire" else ()
        opened = (t.Observations,) if gives == (t.Observations,) else KINDS[kind].opens
        self._have |= set(opened)
        self._kinds.append(kind)

    def finish(self) -> None:
        """Check what only the whole list can show."""
        if "solve" not in self._kinds and self._kinds:
            self._complain(
                ("steps",),
                "no solve step, so there is no calibration; add one after the fit: solve.svd",
            )

    def _check_configuration(self, at: tuple[Hashable, ...], stage: Stage) -> None:
        """Refuse a stage that knows no other configuration than the default."""
        if Configuration in map(bare, stage.needs.values()):
            return
        if not self._configuration.is_default:
            found = ", ".join(self._configuration.unknowns)
            self._complain(
                at,
                f"{stage.name} finds base_T_camera from the flange's own circle, and the "
                f"configuration asks for {found}; {_instead(stage.kind)}",
            )
        elif not self._circles:
            self._complain(
                at, f"{stage.name} takes circles, and the fit gives poses; {_instead(stage.kind)}"
            )

    def _check_place(self, at: tuple[Hashable, ...], kind: str) -> None:
        rank = list(KINDS).index(kind)
        if kind in self._kinds and kind not in ("refine", "verify"):
            self._complain(at, f"a recipe has one {kind} step, and this is the second")
        elif rank < self._rank:
            later = list(KINDS)[self._rank]
            self._complain(at, f"{_a(kind)} step cannot come after {_a(later)} step")
        self._rank = max(self._rank, rank)


def bare(need: Any) -> Any:
    """Return X of ``X | None``."""
    alternatives = [a for a in get_args(need) if a is not NoneType]
    return alternatives[0] if NoneType in get_args(need) else need


def _instead(kind: str) -> str:
    known = {"solve": "use solve.maximum_likelihood", "verify": "use verify.holdout"}
    return known.get(kind, "leave it out")


def _required(needs: Iterable[Any]) -> list[Any]:
    return [need for need in needs if NoneType not in get_args(need)]


def _a(noun: str) -> str:
    return f"an {noun}" if noun[0] in "aeiou" else f"a {noun}"


def _missing(need: Any) -> str:
    if need in SECTIONS:
        section, example = SECTIONS[need]
        return f"needs the recipe's '{section}' section, for example {section}: {example}"
    givers = [kind for kind, contract in KINDS.items() if need in contract.opens]
    name = getattr(need, "__name__", str(need))
    cure = f"; put {_a(givers[0])} step before it" if givers else ""
    return f"needs a {name}, which no earlier step gives{cure}"

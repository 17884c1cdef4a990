"""The steps of a recipe: a stage with its parameters each, in an order that makes sense."""

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import NoneType
from typing import Any, NamedTuple, get_args

from flangeye import types as t
from flangeye.devices import MotionAllowed, RobotDriver, ScannerDriver
from flangeye.models.bodies import TargetBody
from flangeye.models.cell import Cell
from flangeye.models.configuration import CELL, DEFAULT, Configuration
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.models.scanners import ScannerData, ScannerModel
from flangeye.models.targets import Flange, Sphere
from flangeye.plugin.stage import KINDS, Params, Stage
from flangeye.workflow.recipe.header import LimitsSection

Complain = Callable[[Sequence[Hashable], str], None]


class Given(NamedTuple):
    """Section of a recipe's header that provides a value.

    Attributes:
        what: Noun for it, as messages use it.
        sections: The sections that can give it.
        example: How to write it.
    """

    what: str
    sections: tuple[str, ...]
    example: str


SECTIONS: Mapping[Any, Given] = {
    RobotModel: Given(
        "the arm's kinematics",
        ("robot",),
        "robot: ur10e ('flangeye robots' lists them), or robot: {urdf: arm.urdf}",
    ),
    ScannerData: Given(
        "a scanner", ("scanner",), "scanner: {name: ACME 3000, range: [300 mm, 900 mm]}"
    ),
    ScannerModel: Given(
        "the scanner's field of view and noise",
        ("scanner",),
        "scanner: phoxi-m ('flangeye scanners' lists them, 'flangeye new-scanner' writes one)",
    ),
    Flange: Given(
        "the plate to look for",
        ("robot", "feature"),
        "feature: {standard: ISO 9409-1-50-4-M6} ('flangeye standards' lists them), or a robot's "
        "model",
    ),
    Sphere: Given(
        "a sphere",
        ("feature",),
        "feature: {sphere: {diameter: 38.1 mm, centre: [0 mm, 0 mm, 60 mm]}}",
    ),
    TargetBody: Given("a body to look for", ("target",), "target: {body: gripper.stl, at: flange}"),
    t.Seed: Given("a seed", ("seed",), "seed: 0"),
    Configuration: Given(
        "a configuration", ("configuration",), "configuration: {name: eye-in-hand, place: unknown}"
    ),
    Cell: Given(
        "a cell",
        ("cell",),
        "cell: {arms: {arm: ur5}, cameras: {left: base, right: base}, targets: {board: arm}}",
    ),
    SecondRobot: Given("the second arm", ("second_robot",), "second_robot: ur5"),
    RobotDriver: Given(
        "the arm's driver",
        ("robot",),
        "robot: {model: ur10e, driver: {ur_rtde: {host: 192.168.1.10}}, limits: …}",
    ),
    LimitsSection: Given(
        "the arm's limits",
        ("robot",),
        "robot: {limits: {box: {centre: [500 mm, 0 mm, 400 mm], size: [800 mm, 800 mm, 800 mm]}}}",
    ),
    ScannerDriver: Given(
        "the scanner's driver",
        ("scanner",),
        "scanner: {model: phoxi-m, driver: {watched_folder: {path: …}}}",
    ),
}
"""Values of a recipe's header that stages may request."""


@dataclass(frozen=True)
class Step:
    """One step of a recipe: a stage with its checked parameters.

    Attributes:
        index: Index in the recipe, from 0.
        stage: The stage.
        params: Parameters of the stage; None if it has none.
    """

    index: int
    stage: Stage
    params: Params | None

    @property
    def label(self) -> str:
        """Name in logs and reports: ``2.fit.rim``."""
        return f"{self.index}.{self.stage.name}"


class StepOrder:
    """Checks the order of steps: each must get the inputs it needs."""

    def __init__(self, complain: Complain, given: Mapping[Any, Any]) -> None:
        """Start before the first step.

        Args:
            complain: Called with place and text of each mistake.
            given: Values available to stages from the start, by type.
        """
        self._cell = Cell in given
        self._configuration: Configuration = given.get(Configuration) or DEFAULT
        self._circles = True
        self._complain = complain
        self._lost = False
        self._have: set[Any] = {*given, t.ArchivePath, t.Box, t.Earlier, t.StageLog, MotionAllowed}
        self._rank = 0
        self._kinds: list[str] = []

    def visit(self, index: int, name: str, stage: Stage | None) -> None:
        """Check one step against the earlier ones; ``stage`` is None if it is not installed."""
        kind = name.partition(".")[0]
        if kind not in KINDS:
            self.lose_track()
            return
        at = ("steps", index, name)
        self._check_place(at, kind)
        takes = KINDS[kind].takes
        needs = _required(stage.needs.values()) if stage else takes[:1]
        if self._cell and stage and not _serves_cells(stage):
            in_a_cell = {
                "acquire": "use acquire.samples, acquire.centres or acquire.archive with reader: "
                "cell, or acquire.simulated_cell",
                "solve": "use solve.robust",
                "verify": "use verify.holdout",
                "export": "leave it out: calibration.yaml carries every transform of the cell, and "
                "after the run flangeye export RUN --to NAME --camera CAMERA writes one",
            }
            self._complain(at, f"{name} serves no cell; {in_a_cell.get(kind, 'leave it out')}")
            needs = []
        for need in needs:
            self._need(at, need, _what_for(name))
        if stage and kind == "fit":
            self._circles = t.CircleFeature in stage.gives
        if stage:
            self._check_configuration(at, stage)
        gives = stage.gives if stage and kind == "acquire" else ()
        # A source of ready-made observations has no captures to segment or to fit
        opened = (t.Observations,) if gives == (t.Observations,) else KINDS[kind].opens
        self._have |= set(opened)
        self._kinds.append(kind)

    def require(self, index: int, name: str, params: Params | None) -> None:
        """Check that the recipe has the sections that a step's parameters need."""
        for need, purpose in (params.requires() if params else {}).items():
            self._need(("steps", index, name), need, purpose)

    def lose_track(self) -> None:
        """Note an entry that is not a valid step: its output is unknown from here on."""
        self._lost = True

    def _need(self, at: tuple[Hashable, ...], need: Any, purpose: str) -> None:
        # After an entry that is no step anything may have been given, except what the header gives
        known = need in self._have or (self._lost and need not in SECTIONS)
        if not known:
            self._complain(at, _missing(need, purpose))

    def finish(self) -> None:
        """Check the list as a whole, after all steps were visited."""
        if "solve" not in self._kinds and self._kinds and not self._lost:
            self._complain(
                ("steps",),
                "no solve step, so there is no calibration; add one after the fit: solve.svd",
            )

    def _check_configuration(self, at: tuple[Hashable, ...], stage: Stage) -> None:
        """Refuse a stage in a configuration that it does not declare to serve."""
        if self._cell or stage.kind not in ("acquire", "solve", "refine", "verify"):
            return
        if stage.kind == "acquire":
            self._check_carried(at, stage)
        elif not self._configuration.is_default:
            if self._configuration.name in stage.serves:
                return
            found = ", ".join(self._configuration.unknowns)
            others = f", or serves {', '.join(stage.serves)}" if stage.serves else ""
            self._complain(
                at,
                f"{stage.name} finds base_T_camera from the flange's own circle{others}, and the "
                f"configuration asks for {found}; {_instead(stage.kind)}",
            )
        elif not self._circles and not stage.serves:
            self._complain(
                at, f"{stage.name} takes circles, and the fit gives poses; {_instead(stage.kind)}"
            )

    def _check_carried(self, at: tuple[Hashable, ...], stage: Stage) -> None:
        """Refuse a stage that plans poses for a body on the flange where it is elsewhere."""
        plans = TargetBody in map(bare, stage.needs.values()) and TargetBody in self._have
        if plans and self._configuration.target != t.FLANGE:
            self._complain(
                at,
                f"{stage.name} plans poses that show a body on the flange, and this one is on "
                f"{self._configuration.target}; record the scans and use acquire.archive",
            )

    def _check_place(self, at: tuple[Hashable, ...], kind: str) -> None:
        rank = list(KINDS).index(kind)
        if kind == "export":  # done after verifying, wherever it stands behind the solver
            return
        if kind in self._kinds and not KINDS[kind].several:
            self._complain(at, f"a recipe has one {kind} step, and this is the second")
        elif rank < self._rank:
            later = list(KINDS)[self._rank]
            self._complain(at, f"{_a(kind)} step cannot come after {_a(later)} step")
        # The latest so far: a step out of place is reported once, not every step after it
        self._rank = max(self._rank, rank)


def _serves_cells(stage: Stage) -> bool:
    if stage.kind in ("segment", "fit"):  # these see one capture, whoever took it
        return True
    return CELL in stage.serves or Cell in map(bare, stage.needs.values())


def bare(need: Any) -> Any:
    """Return X of ``X | None``."""
    alternatives = [a for a in get_args(need) if a is not NoneType]
    return alternatives[0] if NoneType in get_args(need) else need


def _instead(kind: str) -> str:
    known = {"solve": "use solve.robust", "verify": "use verify.holdout"}
    return known.get(kind, "leave it out")


def _required(needs: Iterable[Any]) -> list[Any]:
    return [need for need in needs if NoneType not in get_args(need)]


def _a(noun: str) -> str:
    return f"an {noun}" if noun[0] in "aeiouAEIO" else f"a {noun}"


def _what_for(name: str) -> str:
    if name.startswith("acquire.simulated"):
        return "to simulate it"
    if name.startswith("acquire"):
        return "to plan its poses and to watch it move"
    return "to lead the torch along the seam" if name.startswith("weld") else ""


def _missing(need: Any, purpose: str) -> str:
    if need in SECTIONS:
        why = f", {purpose}" if need is RobotModel and purpose else ""
        return f"needs {SECTIONS[need].what}{why}: write {SECTIONS[need].example}"
    givers = [kind for kind, contract in KINDS.items() if need in contract.opens]
    name = getattr(need, "__name__", str(need))
    cure = f"; put {_a(givers[0])} step before it" if givers else ""
    return f"needs {_a(name)}, which no earlier step gives{cure}"

"""A stage is a plain function; its signature is its declaration.

Two sorts of plugins share one decorator each and one registry:

* ``@stage`` functions are the steps of a recipe (``fit.rim``): what they take and give decides
  where in a recipe they may stand.
* ``@part`` functions are chosen by name inside a step's parameters (``cost.translation`` in
  ``solve.iterative: {cost: {translation: {}}}``).
"""

from __future__ import annotations

import importlib
import inspect
import types as python_types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import ConfigDict, GetCoreSchemaHandler, ValidationError, ValidationInfo
from pydantic_core import InitErrorDetails, PydanticCustomError, core_schema

from flangeye import types as t
from flangeye.files.described import Described
from flangeye.files.validation import EXPLAINED, sentence
from flangeye.models.configuration import CELL, EVERY
from flangeye.models.robots import RobotModel
from flangeye.types.geometry import rigid, rotation_from_rpy
from flangeye.units import Angle, Length, param


class Params(Described):
    """Base of every plugin's parameters: frozen, and a misspelt key is an error."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        # Defaults are written as text with a unit, such as 0.3 mm, so they are validated too
        validate_default=True,
        arbitrary_types_allowed=True,
        # Listing stages imports every plugin; only the models that are used need be built.
        defer_build=True,
    )

    def requires(self) -> Mapping[type, str]:
        """Return the sections of the recipe's header that these values need, by type, and why."""
        return {}


class PlaceParams(Params):
    """A pose in the frame of its carrier."""

    position: tuple[Length, Length, Length] = param(("0 mm", "0 mm", "0 mm"))
    rpy: tuple[Angle, Angle, Angle] = param(("0 deg", "0 deg", "0 deg"))
    """Roll, pitch, yaw; a target's z points towards the scanner."""

    @property
    def matrix(self) -> t.Floats:
        """Matrix (4, 4) of the transform, translation in [m]."""
        return rigid(rotation_from_rpy(*self.rpy), np.asarray(self.position))


@dataclass(frozen=True)
class Contract:
    """The inputs and outputs that all stages of a kind must have.

    Attributes:
        takes: Types of the input, of which a stage takes one; none for the first step.
        gives: Types a stage may return.
        opens: Types that later steps may take once such a step has run.
        meaning: One line shown in messages and reports.
        several: Whether a recipe may have more than one step of the kind.
    """

    takes: tuple[Any, ...]
    gives: tuple[Any, ...]
    opens: tuple[Any, ...]
    meaning: str
    several: bool = False


KINDS: Mapping[str, Contract] = {
    "acquire": Contract(
        (), (t.Captures, t.Observations), (t.Capture,), "where scans and robot poses come from"
    ),
    "segment": Contract(
        (t.Capture,),
        (t.FlangeCloud, t.Rejected),
        (t.FlangeCloud, t.Views),
        "find the flange in a scan",
    ),
    "fit": Contract(
        (t.FlangeCloud, t.Capture),
        (t.CircleFeature, t.PoseFeature, t.Rejected),
        (t.CircleFeature, t.PoseFeature, t.Observations),
        "the circle's centre or the marker's pose, with covariance",
    ),
    "solve": Contract(
        (t.Observations,),
        (t.HandEye,),
        (t.HandEye, t.Solver, t.CalibratedPose),
        "the camera's pose",
    ),
    "refine": Contract(
        (t.HandEye,), (t.HandEye,), (t.HandEye,), "a calibration changed after solving", True
    ),
    "verify": Contract(
        (t.HandEye,), (t.Verification,), (t.VerifiedHandEye,), "whether the pose may be used", True
    ),
    "export": Contract(
        (t.CalibratedPose,), (t.ExportedFile,), (), "the pose in another program's format", True
    ),
    "scan": Contract((), (t.WorkpieceScan,), (t.WorkpieceScan,), "a scan of the workpiece"),
    "seam": Contract((t.VerifiedHandEye,), (t.Seam,), (t.Seam,), "where to weld", True),
    "weld": Contract((t.VerifiedHandEye,), (t.WeldReport,), (t.WeldReport,), "weld along the seam"),
}
"""The kinds of steps, in the order a recipe runs them."""


@dataclass(frozen=True)
class PartKind:
    """A kind of parts.

    Attributes:
        meaning: One line shown in messages and reports.
        contract: ``module:Protocol`` with the part's arguments and result. It is a name, not an
            import: the Protocol stands beside its types.
    """

    meaning: str
    contract: str


PARTS: Mapping[str, PartKind] = {
    "reader": PartKind(
        "an archive layout that acquire.archive can read", "flangeye.files.recording:Reader"
    ),
    "plan": PartKind("the robot poses an acquisition visits", "flangeye.motion.reach:Planner"),
    "cost": PartKind(
        "what solve.iterative minimises of a pose error", "flangeye.models.contracts:Cost"
    ),
    "error": PartKind(
        "how solve.iterative measures a candidate's pose error",
        "flangeye.models.contracts:ErrorMeasure",
    ),
    "view": PartKind(
        "a first guess of the scanner's pose, for planning", "flangeye.models.contracts:ViewGuess"
    ),
    "robot": PartKind("an arm that acquire.live can move", "flangeye.models.contracts:RobotPart"),
    "scanner": PartKind(
        "a scanner that acquire.live can trigger", "flangeye.models.contracts:ScannerPart"
    ),
    "replay": PartKind(
        "repeats a step's decisions from its log, and compares",
        "flangeye.workflow.run.replay:Repeat",
    ),
    "guide": PartKind(
        "a guided procedure with the devices of a recipe", "flangeye.workflow.recipe.load:Guide"
    ),
    "controller": PartKind(
        "moves tool and torch along a seam in weld.tactile",
        "flangeye.motion.seam_following:ControllerPart",
    ),
    "sensor": PartKind(
        "a tactile sensor that weld.tactile can read", "flangeye.models.contracts:SensorPart"
    ),
    "profiler": PartKind(
        "a profile sensor behind the torch, for weld.tactile",
        "flangeye.models.contracts:ProfilerPart",
    ),
    "arc": PartKind(
        "a welding power source that weld.tactile switches", "flangeye.models.contracts:ArcPart"
    ),
    "check": PartKind(
        "a mistake in recordings that flangeye doctor can name",
        "flangeye.workflow.doctor.diagnosis:Check",
    ),
}
"""The kinds of parts, which steps choose by name in their parameters."""


@dataclass(frozen=True)
class Plugin:
    """A registered function: ``kind.name`` and its signature's declarations.

    Attributes:
        name: ``kind.name``.
        function: The plain function; call the plugin to call it.
        params: Its parameter model, or None when it takes none.
        needs: Argument name -> type, the parameters aside.
        gives: Types it may return.
    """

    name: str
    function: Callable[..., Any]
    params: type[Params] | None
    needs: Mapping[str, Any]
    gives: tuple[Any, ...]

    @property
    def kind(self) -> str:
        """The part of the name before the first dot."""
        return self.name.partition(".")[0]

    @property
    def summary(self) -> str:
        """First line of the docstring."""
        return self.documentation.partition("\n")[0]

    @property
    def documentation(self) -> str:
        """Whole docstring of the stage's function."""
        return inspect.getdoc(self.function) or ""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the function as it was written."""
        return self.function(*args, **kwargs)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the plugin by its name: the module attribute of that name is the plugin itself."""
        return _at, (self.function.__module__, self.function.__qualname__)


def _at(module: str, name: str) -> Any:
    return getattr(importlib.import_module(module), name)


@dataclass(frozen=True)
class Stage(Plugin):
    """A step of a recipe.

    Attributes:
        serves: Configurations that a solve, refine or verify stage can work in, by name, besides
            the default: a camera beside the robot that looks at the flange's own circle.
    """

    serves: tuple[str, ...] = ()


@dataclass(frozen=True)
class Part(Plugin):
    """A function chosen by name inside a step's parameters.

    Attributes:
        simulated: A robot part with a simulated arm and simulated time.
        interactive: A robot part that asks a person at the terminal; nothing it does is urgent.
        passive: A robot part that commands nothing: others move the arm, no permission is needed.
        simulation_only: A controller part that is known to diverge; a real arm is refused with it.
    """

    simulated: bool = False
    interactive: bool = False
    passive: bool = False
    simulation_only: bool = False

    @property
    def can_only_read(self) -> bool:
        """Whether a robot part takes ``reads_only``: it then starts and commands nothing."""
        return "reads_only" in self.needs

    def bind(self, params: Params | None = None) -> BoundPart:
        """Return the part together with its parameters, as a recipe's step states it."""
        return BoundPart(self, params if params or not self.params else self.params())


Siblings = Mapping[str, Part]
"""The other parts of a part's kind, by the name a recipe gives them; a part that has to know them
has an argument ``siblings`` of this type."""


@dataclass(frozen=True)
class BoundPart:
    """A part with its parameters; call it with the part's remaining arguments.

    Attributes:
        part: The part.
        params: Its parameters, or None when it takes none.
        offered: What a recipe offers a part that asks for ``siblings`` or ``kinematics``.
    """

    part: Part
    params: Params | None
    offered: PartLookup | None = field(default=None, compare=False, repr=False)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the part's function; its parameters are already there."""
        # A part declares by its arguments what else it needs; most need their parameters alone
        extra: dict[str, Any] = {} if self.params is None else {"params": self.params}
        if self.offered is not None and "siblings" in self.part.needs:
            extra["siblings"] = self.offered.siblings(self.part)
        if self.offered is not None and "kinematics" in self.part.needs:
            extra["kinematics"] = self.offered.robot
        return self.part.function(*args, **kwargs, **extra)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the part without the other offered parts."""
        return BoundPart, (self.part, self.params)

    def to_yaml(self) -> dict[str, Any]:
        """Return ``{name: parameters}`` as a recipe writes it."""
        name = self.part.name.partition(".")[2]
        return {name: self.params.model_dump(mode="json") if self.params else {}}


class PartLookup(Protocol):
    """Context of a recipe's validation: available parts, the recipe's folder, the arm."""

    folder: Path
    robot: RobotModel | None
    needs_files: bool

    def part(self, name: str) -> Part:
        """Return the part ``kind.name``, or raise LookupError naming the nearest."""

    def siblings(self, part: Part) -> Siblings:
        """Return the other parts of a part's kind."""


@dataclass(frozen=True)
class Choose:
    """Annotation of a parameter that chooses a part: ``cost: Annotated[Chosen, Choose("cost")]``.

    In YAML it is the part's name, or a mapping of the name to the part's parameters.

    Attributes:
        kind: The parts' kind.
        words: Words accepted instead of a part, and kept unchanged.
    """

    kind: str
    words: tuple[str, ...] = ()

    def __get_pydantic_core_schema__(
        self, _source: Any, _handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return core_schema.with_info_plain_validator_function(
            self._choose,
            serialization=core_schema.plain_serializer_function_ser_schema(
                lambda chosen: chosen.to_yaml() if isinstance(chosen, BoundPart) else chosen
            ),
        )

    def __get_pydantic_json_schema__(self, _schema: Any, _handler: Any) -> dict[str, Any]:
        part = {"x-flangeye-part": self.kind}
        return {"anyOf": [{"enum": list(self.words)}, part]} if self.words else part

    def _choose(self, value: Any, info: ValidationInfo) -> BoundPart | str:
        # A part that code has chosen, or that an earlier validation has made of its name
        if isinstance(value, BoundPart) or (isinstance(value, str) and value in self.words):
            return value
        if isinstance(value, str):
            value = {value: {}}
        if not isinstance(value, dict) or len(value) != 1:
            raise ValueError(f"choose one {self.kind} by name, for example {{name: {{}}}}")
        ((name, raw),) = value.items()
        lookup: PartLookup | None = info.context
        if lookup is None:
            raise ValueError(f"outside a recipe, give the {self.kind} itself, not its name")
        try:
            chosen = lookup.part(f"{self.kind}.{name}")
        except LookupError as error:
            others = f"; or write {' or '.join(self.words)}" if self.words else ""
            raise ValueError(f"{error}{others}") from None
        if chosen.params is None:
            if raw:
                raise ValueError(f"{chosen.name} takes no parameters")
            return BoundPart(chosen, None, lookup)
        try:
            params = chosen.params.model_validate(raw or {}, context=lookup)
        except ValidationError as error:
            raise _below(name, error, chosen.params) from None
        return BoundPart(chosen, params, lookup)


def _below(key: str, error: ValidationError, model: type[Params]) -> ValidationError:
    """Return the same mistakes, explained, and located below ``key`` so that lines can be named."""
    return ValidationError.from_exception_data(
        error.title,
        [
            InitErrorDetails(
                type=PydanticCustomError(
                    EXPLAINED, "{message}", {"message": sentence(e, model, e["input"])}
                ),
                loc=(key, *e["loc"]),
                input=e["input"],
            )
            for e in error.errors()
        ],
    )


def stage(name: str, serves: Iterable[str] = ()) -> Callable[[Callable[..., Any]], Stage]:
    """Declare a function as the step ``name``, for example ``solve.svd``.

    Args:
        name: ``kind.name``.
        serves: Configurations it can work in besides the default, by name;
            :data:`flangeye.models.configuration.EVERY` for all,
            and ``CELL`` for cells.

    Raises:
        TypeError: The signature breaks the contract of the stage's kind, or a configuration is
            not known.
    """
    unknown = sorted(set(serves) - {*EVERY, CELL})
    if unknown:
        raise TypeError(
            f"stage '{name}' serves '{unknown[0]}', which is not a configuration; known: "
            f"{', '.join((*EVERY, CELL))}"
        )

    def declare(function: Callable[..., Any]) -> Stage:
        declared = replace(_read_signature(Stage, name, function), serves=tuple(serves))
        _check_contract(declared)
        return declared

    return declare


def part(
    name: str,
    *,
    simulated: bool = False,
    interactive: bool = False,
    passive: bool = False,
    simulation_only: bool = False,
) -> Callable[[Callable[..., Any]], Part]:
    """Declare a function as the part ``name``, for example ``cost.translation``.

    Args:
        name: ``kind.name``.
        simulated: Whether a robot's arm and time are simulated.
        interactive: Whether a robot asks a person at the terminal.
        passive: Whether a robot commands nothing because others move the arm.
        simulation_only: Whether a controller is known to diverge and must not move a real arm.

    Raises:
        TypeError: The kind before the dot is not known, or the signature breaks its contract.
    """

    def declare(function: Callable[..., Any]) -> Part:
        declared = replace(
            _read_signature(Part, name, function),
            simulated=simulated,
            interactive=interactive,
            passive=passive,
            simulation_only=simulation_only,
        )
        if declared.kind not in PARTS:
            raise TypeError(f"part '{name}': no kind '{declared.kind}'; kinds: {', '.join(PARTS)}")
        _check_call(declared, PARTS[declared.kind])
        return declared

    return declare


AnyPlugin = TypeVar("AnyPlugin", bound=Plugin)


def _read_signature(cls: type[AnyPlugin], name: str, function: Callable[..., Any]) -> AnyPlugin:
    # Annotations are text until now: one that cannot be resolved fails at import, not in a run
    hints = get_type_hints(function)
    params = hints.pop("params", None)
    gives = _alternatives(hints.pop("return", type(None)))
    if params is not None and not (isinstance(params, type) and issubclass(params, Params)):
        raise TypeError(f"'{name}': its params must be a subclass of flangeye.Params")
    if not inspect.getdoc(function):
        raise TypeError(f"'{name}' has no docstring; its first line is what people read")
    return cls(name, function, params, hints, gives)


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    if get_origin(annotation) in (Union, python_types.UnionType):
        return get_args(annotation)
    return (annotation,)


def _check_contract(declared: Stage) -> None:
    contract = KINDS.get(declared.kind)
    where = f"stage '{declared.name}'"
    if contract is None:
        raise TypeError(f"{where}: no kind '{declared.kind}'; kinds: {', '.join(KINDS)}")
    if contract.takes and not set(contract.takes) & set(declared.needs.values()):
        wanted = " or a ".join(taken.__name__ for taken in contract.takes)
        raise TypeError(f"{where}: a '{declared.kind}' stage takes a {wanted}")
    foreign = [g for g in declared.gives if g not in contract.gives]
    if foreign:
        allowed = " or ".join(g.__name__ for g in contract.gives)
        got = getattr(foreign[0], "__name__", str(foreign[0]))
        raise TypeError(f"{where} returns {got}, but a '{declared.kind}' stage returns {allowed}")


def _check_call(declared: Part, kind: PartKind) -> None:
    """Check a part's signature against the Protocol of its kind; untyped arguments pass."""
    contract = _at(*kind.contract.split(":"))
    wanted = get_type_hints(contract.__call__)
    gives = _alternatives(wanted.pop("return", type(None)))
    where = f"part '{declared.name}'"
    # Arguments that any part may have: its parameters, the other parts of its kind, the model
    # of the recipe's `robot` (None without one) and, for a robot, whether the arm is opened to
    # be read and for nothing else
    given = ("params", "siblings", "kinematics", "reads_only")
    asked = [n for n in inspect.signature(declared.function).parameters if n not in given]
    if asked != list(wanted):
        raise TypeError(
            f"{where}: a '{declared.kind}' part is called with {', '.join(wanted)}, "
            f"and has {', '.join(asked) or 'no arguments'}"
        )
    for name, taken in declared.needs.items():
        if name in wanted and not _fits(wanted[name], taken):
            raise TypeError(
                f"{where}: its {name} is a {_called(wanted[name])}, not a {_called(taken)}"
            )
    foreign = [g for g in declared.gives if not any(_fits(g, given) for given in gives)]
    if foreign:
        raise TypeError(
            f"{where} returns {_called(foreign[0])}, but a '{declared.kind}' part returns "
            f"{' or '.join(map(_called, gives))}"
        )


def _fits(got: Any, wanted: Any) -> bool:
    """Return whether a value of type ``got`` may stand where ``wanted`` is asked for."""
    if Any in (got, wanted) or got == wanted:
        return True
    got, wanted = _class_of(got), _class_of(wanted)
    return isinstance(got, type) and isinstance(wanted, type) and issubclass(got, wanted)


def _class_of(annotation: Any) -> Any:
    """Return the class behind an annotation; NumPy's NDArray is an alias of one since 2.5."""
    origin = get_origin(annotation) or annotation
    aliased = getattr(origin, "__value__", None)
    return origin if aliased is None else _class_of(aliased)


def _called(annotation: Any) -> str:
    return getattr(annotation, "__name__", None) or str(annotation)

"""A stage is a plain function; its signature is its declaration.

Two sorts of plugins share one decorator each and one registry:

* ``@stage`` functions are the steps of a recipe (``fit.rim``): what they take and give decides
  where in a recipe they may stand.
* ``@part`` functions are chosen by name inside a step's parameters (``cost.translation`` in
  ``solve.iterative: {cost: {translation: {}}}``).
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import types as python_types
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar, Union, get_args, get_origin, get_type_hints

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    GetCoreSchemaHandler,
    PlainSerializer,
    ValidationError,
    ValidationInfo,
)
from pydantic_core import InitErrorDetails, PydanticCustomError, core_schema

from flangeye import types as t
from flangeye.explain import EXPLAINED, sentence
from flangeye.shipped import shipped


class Params(BaseModel):
    """Base of every plugin's parameters: frozen, and a misspelt key is an error."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        validate_default=True,
        arbitrary_types_allowed=True,
        # Listing stages imports every plugin; only the models that are used need be built.
        defer_build=True,
    )


@dataclass(frozen=True)
class Contract:
    """What every stage of one kind must take and must give.

    Attributes:
        takes: Types of the value the kind works on, of which it needs one; none for the first.
        gives: Types it may return.
        opens: What later steps may ask for once such a step has run.
        meaning: One line for people.
    """

    takes: tuple[Any, ...]
    gives: tuple[Any, ...]
    opens: tuple[Any, ...]
    meaning: str


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
    "solve": Contract((t.Observations,), (t.HandEye,), (t.HandEye, t.Solver), "the camera's pose"),
    "refine": Contract(
        (t.HandEye,), (t.HandEye,), (t.HandEye,), "a calibration changed after solving"
    ),
    "verify": Contract(
        (t.HandEye,), (t.Verification,), (t.VerifiedHandEye,), "whether the pose may be used"
    ),
    "scan": Contract((), (t.WorkpieceScan,), (t.WorkpieceScan,), "a scan of the workpiece"),
    "seam": Contract((t.VerifiedHandEye,), (t.Seam,), (t.Seam,), "where to weld"),
    "weld": Contract((t.VerifiedHandEye,), (t.WeldReport,), (t.WeldReport,), "weld along the seam"),
}
"""The kinds of steps, in the order a recipe runs them."""

PARTS: Mapping[str, str] = {
    "reader": "an archive layout that acquire.archive can read",
    "plan": "the robot poses an acquisition visits",
    "cost": "what solve.iterative minimises of a pose error",
    "error": "how solve.iterative measures a candidate's pose error",
    "view": "what is guessed of the scanner's place, for planning",
    "robot": "an arm that acquire.live can move",
    "scanner": "a scanner that acquire.live can trigger",
    "replay": "decides again, from its journal, what a step decided",
    "guide": "a guided procedure with the devices of a recipe",
    "sensor": "a tactile sensor that weld.tactile can read",
    "check": "a mistake in recordings that flangeye doctor can name",
}
"""The kinds of parts, which steps choose by name in their parameters."""


@dataclass(frozen=True)
class Plugin:
    """A registered function: ``kind.name`` and what its signature declares.

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
        """The whole docstring."""
        return inspect.getdoc(self.function) or ""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the function as it was written."""
        return self.function(*args, **kwargs)

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel to another process by name: what carries the function's name is the plugin."""
        return _at, (self.function.__module__, self.function.__qualname__)


def _at(module: str, name: str) -> Any:
    return getattr(importlib.import_module(module), name)


class Stage(Plugin):
    """A step of a recipe."""


class Part(Plugin):
    """A function chosen by name inside a step's parameters."""

    def bind(self, params: Params | None = None) -> Chosen:
        """Return the part with its parameters, as a step's parameter holds it."""
        return Chosen(self, params if params or not self.params else self.params())


Siblings = Mapping[str, Part]
"""The other parts of a part's kind, by the name a recipe gives them; a part that has to know them
has an argument ``siblings`` of this type."""


@dataclass(frozen=True)
class Chosen:
    """A part with its parameters; call it with the part's remaining arguments.

    Attributes:
        part: The part.
        params: Its parameters, or None when it takes none.
        offered: The parts a recipe may choose from, for a part that asks for Siblings.
    """

    part: Part
    params: Params | None
    offered: PartLookup | None = field(default=None, compare=False, repr=False)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the part's function; its parameters are already there."""
        extra: dict[str, Any] = {} if self.params is None else {"params": self.params}
        if self.offered is not None and "siblings" in self.part.needs:
            extra["siblings"] = self.offered.siblings(self.part)
        return self.part.function(*args, **kwargs, **extra)

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel to another process without the parts on offer here."""
        return Chosen, (self.part, self.params)

    def to_yaml(self) -> dict[str, Any]:
        """Return ``{name: parameters}`` as a recipe writes it."""
        name = self.part.name.partition(".")[2]
        return {name: self.params.model_dump(mode="json") if self.params else {}}


class PartLookup(Protocol):
    """What the validation of a recipe passes as context: the parts on offer, and the folder."""

    folder: Path

    def part(self, name: str) -> Part:
        """Return the part ``kind.name``, or raise LookupError naming the nearest."""
        ...

    def siblings(self, part: Part) -> Siblings:
        """Return the other parts of a part's kind."""
        ...


@dataclass(frozen=True)
class Choose:
    """Annotation of a parameter that chooses a part: ``cost: Annotated[Chosen, Choose("cost")]``.

    In YAML it is the part's name, or a mapping of the name to the part's parameters.
    """

    kind: str

    def __get_pydantic_core_schema__(
        self, _source: Any, _handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return core_schema.with_info_plain_validator_function(
            self._choose,
            serialization=core_schema.plain_serializer_function_ser_schema(
                lambda chosen: chosen.to_yaml()
            ),
        )

    def __get_pydantic_json_schema__(self, _schema: Any, _handler: Any) -> dict[str, Any]:
        return {"x-flangeye-part": self.kind}

    def _choose(self, value: Any, info: ValidationInfo) -> Chosen:
        if isinstance(value, Chosen):
            return value
        if isinstance(value, str):
            value = {value: {}}
        if not isinstance(value, dict) or len(value) != 1:
            raise ValueError(f"choose one {self.kind} by name, for example {{name: {{}}}}")
        ((name, raw),) = value.items()
        lookup: PartLookup | None = info.context
        if lookup is None:
            raise ValueError(f"a {self.kind} is chosen by name only inside a recipe")
        try:
            chosen = lookup.part(f"{self.kind}.{name}")
        except LookupError as error:
            raise ValueError(str(error)) from None
        if chosen.params is None:
            if raw:
                raise ValueError(f"{chosen.name} takes no parameters")
            return Chosen(chosen, None, lookup)
        try:
            params = chosen.params.model_validate(raw or {}, context=lookup)
        except ValidationError as error:
            raise _below(name, error, chosen.params) from None
        return Chosen(chosen, params, lookup)


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


def _beside_recipe(value: Any, info: ValidationInfo) -> Path:
    if not isinstance(value, (str, Path)):
        raise ValueError("a path is text")
    path = Path(value).expanduser()
    return path if info.context is None else info.context.folder / path


RecipePath = Annotated[
    Path,
    BeforeValidator(_beside_recipe),
    PlainSerializer(lambda path: str(path.absolute()), return_type=str, when_used="json"),
]
"""A path in a parameter; a relative one starts at the recipe's folder."""


def shipped_file(kind: str, folder: str) -> Callable[[Any, ValidationInfo], Path]:
    """Return the check of a parameter that names a file of ``data/FOLDER`` or one's own.

    Args:
        kind: What it is, for people: ``workpiece``.
        folder: Where those that come with the project are: ``workpieces``.
    """

    def found(value: Any, info: ValidationInfo) -> Path:
        if not isinstance(value, (str, Path)):
            raise ValueError(f"a {kind} is a name or a path to a .yaml file")
        if str(value).endswith((".yaml", ".yml")):
            return _beside_recipe(value, info)
        path = shipped("data") / folder / f"{value}.yaml"
        if not path.is_file():
            known = sorted(p.stem for p in path.parent.glob("*.yaml"))
            near = difflib.get_close_matches(str(value), known, n=2) or known
            raise ValueError(f"no {kind} '{value}'; known: {', '.join(near)}, or a .yaml file")
        return path

    return found


def stage(name: str) -> Callable[[Callable[..., Any]], Stage]:
    """Declare a function as the step ``name``, for example ``solve.svd``.

    Raises:
        TypeError: The signature breaks the contract of the stage's kind.
    """

    def declare(function: Callable[..., Any]) -> Stage:
        declared = _read_signature(Stage, name, function)
        _check_contract(declared)
        return declared

    return declare


def part(name: str) -> Callable[[Callable[..., Any]], Part]:
    """Declare a function as the part ``name``, for example ``cost.translation``.

    Raises:
        TypeError: The kind before the dot is not known.
    """

    def declare(function: Callable[..., Any]) -> Part:
        declared = _read_signature(Part, name, function)
        if declared.kind not in PARTS:
            raise TypeError(f"part '{name}': no kind '{declared.kind}'; kinds: {', '.join(PARTS)}")
        return declared

    return declare


AnyPlugin = TypeVar("AnyPlugin", bound=Plugin)


def _read_signature(cls: type[AnyPlugin], name: str, function: Callable[..., Any]) -> AnyPlugin:
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

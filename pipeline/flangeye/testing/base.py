"""Tests for plugins of every kind: they are found, declare themselves, and are deterministic."""

import tempfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from functools import cached_property
from pathlib import Path
from types import NoneType
from typing import Any, ClassVar, TypeVar, cast, get_args

import numpy as np

from flangeye import types as t
from flangeye.devices import MotionAllowed
from flangeye.errors import FlangeyeError
from flangeye.files.described import descriptions_of
from flangeye.models.loading import load_model
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerData, ScannerModel
from flangeye.models.targets import Flange, plate_of
from flangeye.plugin.registry import Lookup, load_registry
from flangeye.plugin.stage import KINDS, PARTS, Params, Plugin
from flangeye.workflow.log.read import read_run
from flangeye.workflow.log.record import Recorder, adapter, clouds_of

Tested = TypeVar("Tested")


class Conformance:
    """Base of every class of the kit.

    Set ``stage`` (or ``part``, the same) to the plugin, and ``params`` to its parameters if not all
    have defaults. If it needs values that a usual recipe's header does not provide, return them by
    type from :meth:`context`.

    Attributes:
        stage: The plugin, as the decorator returned it.
        part: The part under test, if it is no stage.
        params: Parameters of the plugin: a Params, or a mapping as in a recipe.
        kind: The kind this class is for.
    """

    stage: ClassVar[Plugin]
    part: ClassVar[Plugin]
    params: ClassVar[Params | Mapping[str, Any] | None] = None
    kind: ClassVar[str] = ""

    @property
    def plugin(self) -> Plugin:
        """The plugin under test."""
        found = getattr(self, "stage", None) or getattr(self, "part", None)
        require(found is not None, f"{type(self).__name__}: set stage or part to your plugin")
        require(
            isinstance(found, Plugin),
            f"{type(self).__name__}: {found!r} is not a plugin; is @stage or @part above it?",
        )
        assert isinstance(found, Plugin)  # noqa: S101  for type checkers
        return found

    @cached_property
    def robot(self) -> RobotModel:
        """The arm of the kit's cell."""
        model: RobotModel = load_model("robots", "ur5e")
        return model

    @cached_property
    def scanner(self) -> ScannerModel:
        """The scanner of the kit's cell."""
        model: ScannerModel = load_model("scanners", "phoxi-m")
        return model

    @cached_property
    def flange(self) -> Flange:
        """The flange plate of the kit's arm."""
        return plate_of(self.robot)

    def context(self) -> Mapping[Any, Any]:
        """Return the values that the plugin may request by type, besides its input."""
        return {}

    def call(self, given: Mapping[Any, Any] | None = None, *arguments: Any) -> Any:
        """Call the plugin as the engine would.

        Args:
            given: Values by type, before the context and the kit's cell.
            *arguments: Positional arguments of the part.
        """
        plugin = self.plugin
        values = {**self._cell(), **self.context(), **(given or {})}
        named: dict[str, Any] = {}
        for name, need in list(plugin.needs.items())[len(arguments) :]:
            named[name] = self._value(values, name, need)
        params = self._params()
        if params is not None:
            named["params"] = params
        return plugin.function(*arguments, **named)

    def _cell(self) -> dict[Any, Any]:
        return {
            RobotModel: self.robot,
            ScannerData: self.scanner,
            ScannerModel: self.scanner,
            Flange: self.flange,
            t.Seed: t.Seed(0),
            MotionAllowed: MotionAllowed(),
            t.Views: t.Views(),
            t.ArchivePath: t.ArchivePath(),
            t.StageLog: lambda name, value: None,
        }

    def _value(self, values: Mapping[Any, Any], name: str, need: Any) -> Any:
        optional = NoneType in get_args(need)
        wanted = next((a for a in get_args(need) if a is not NoneType), need) if optional else need
        require(
            wanted in values or optional,
            f"{self.plugin.name} asks for '{name}', of which the kit has none: let context() "
            "give it",
        )
        return values.get(wanted)

    def _params(self) -> Params | None:
        model, given = self.plugin.params, self.params
        if isinstance(given, Params) or model is None:
            return given if isinstance(given, Params) else None
        return model.model_validate(dict(given or {}), context=Lookup(load_registry()))

    # What every plugin must do ------------------------------------------------------------------

    def test_it_is_found_by_its_name(self) -> None:
        """An entry point of an installed package offers it."""
        registry = load_registry()
        name = self.plugin.name
        offered = {**registry.stages, **registry.parts}.get(name)
        broken = "; ".join(f"{n}: {error}" for n, error in registry.broken.items())
        require(
            offered is not None,
            f"{name} is not offered: does its hook return it, is the entry point in the group "
            f"'flangeye', and is the package installed? {broken}".rstrip(),
        )
        require(
            offered is self.plugin, f"{name} is offered, but from another place than the one tested"
        )

    def test_it_declares_what_it_is(self) -> None:
        """The plugin has a known kind, one line of help, and described parameters."""
        plugin = self.plugin
        kinds = {**KINDS, **PARTS}
        require(plugin.kind in kinds, f"'{plugin.kind}' is not a kind; kinds: {', '.join(kinds)}")
        require(
            not self.kind or plugin.kind == self.kind,
            f"{plugin.name} is tested as a {self.kind}, but is a {plugin.kind}",
        )
        summary = plugin.summary
        longest = 110  # `flangeye stages` shows it on one line
        require(
            0 < len(summary) <= longest,
            f"{plugin.name}: the docstring's first line has {len(summary)} characters, at most "
            f"{longest} fit a line",
        )
        for name, text in (descriptions_of(plugin.params) if plugin.params else {}).items():
            require(text, f"{plugin.name}: parameter '{name}' has no description")


def require(holds: object, message: str) -> None:
    """Raise AssertionError with ``message`` unless ``holds``."""
    if not holds:
        raise AssertionError(message)


def require_type(value: Any, kind: type[Tested]) -> Tested:
    """Return a plugin's answer; raise AssertionError unless it is of a type."""
    require(isinstance(value, kind), f"gave {type(value).__name__}, not a {kind.__name__}")
    return cast("Tested", value)


def require_repeats(call: Callable[[], Any]) -> None:
    """Raise AssertionError unless two calls give the same result, to the last bit."""
    require(plain(call()) == plain(call()), "two calls with equal input differ")


def require_close(got: Any, expected: Any, within: float, what: str) -> None:
    """Raise AssertionError if any entry of ``got`` is off ``expected`` by more than ``within``."""
    off = float(np.abs(np.asarray(got, dtype=float) - np.asarray(expected, dtype=float)).max())
    require(off <= within, f"{what} is off by {off:.3g}, at most {within:.3g} is allowed")


def plain(value: Any) -> Any:
    """Return a flowing value as plain data that can be compared, its clouds as bytes."""
    if isinstance(value, (float, int, str, type(None))):
        return value
    clouds = clouds_of(value)
    data = adapter(type(value)).dump_python(value, mode="json", exclude=set(clouds))
    return data, {name: (c.frame, c.xyz.tobytes()) for name, c in clouds.items()}


def require_one_line(error: Exception) -> None:
    """Raise AssertionError unless a refusal is one line that a person can act on."""
    text = str(error)
    require(text and "\n" not in text, f"an error is one line, not {text!r}")
    require(not text.startswith(("Traceback", "<")), f"an error is a sentence, not {text!r}")


def require_refusal(call: Callable[[], Any], rejected: type, what: str) -> None:
    """Raise AssertionError unless ``call`` refuses: with a ``rejected`` value, or in one line."""
    try:
        value = call()
    except FlangeyeError as error:
        require_one_line(error)
        return
    except Exception as error:
        raise AssertionError(
            f"{what}: must be refused with StageError in one line, not {type(error).__name__}: "
            f"{error}"
        ) from error
    gave = f"{what}: must be refused, but gave {type(value).__name__}"
    require(isinstance(value, rejected), gave)


def from_log(value: Any) -> Any:
    """Return a value after a round trip through an MCAP log."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        with closing(Recorder(path, {"recipe.yaml": ""}, full_clouds=True)) as recorder:
            recorder.flangeye_stage_finished("0.kit.value", "0", value, 0.0)
        (entry,) = read_run(path).entries
    return entry.value


def require_round_trip(value: Any, through: Callable[[Any], Any] = from_log) -> None:
    """Raise AssertionError unless a value is unchanged by a round trip through a log."""
    try:
        back = through(value)
    except Exception as error:
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise AssertionError(f"the value cannot be logged: {why}") from error
    require(plain(back) == plain(value), "the value comes back from its MCAP log changed")


def require_covariance(matrix: Any, what: str) -> None:
    """Raise AssertionError unless a matrix is symmetric and has no negative variance."""
    matrix = np.asarray(matrix, dtype=float)
    require(np.allclose(matrix, matrix.T, rtol=1e-6, atol=1e-18), f"{what} is not symmetric")
    least, most = np.linalg.eigvalsh(matrix)[[0, -1]]
    require(least >= -1e-9 * max(most, 1e-30), f"{what} has a negative variance, {least:.3g}")


def only(values: Iterable[Any], kind: type) -> list[Any]:
    """Return the values of one type."""
    return [value for value in values if isinstance(value, kind)]

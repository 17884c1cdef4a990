"""How the kit compares, and what it makes of a stage's answer."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from flangeye.errors import FlangeyeError
from flangeye.log.read import read_run
from flangeye.log.record import Recorder, adapter, clouds_of

T = TypeVar("T")


def require(holds: object, message: str) -> None:
    """Raise AssertionError with ``message`` unless ``holds``."""
    if not holds:
        raise AssertionError(message)


def require_type(value: Any, kind: type[T]) -> T:
    """Return a plugin's answer; raise AssertionError unless it is of a type."""
    require(isinstance(value, kind), f"gave {type(value).__name__}, not a {kind.__name__}")
    return cast("T", value)


def require_repeats(call: Callable[[], Any]) -> None:
    """Raise AssertionError unless two calls give the same, to the last bit."""
    require(plain(call()) == plain(call()), "two calls with equal input differ")


def require_close(got: Any, expected: Any, within: float, what: str) -> None:
    """Raise AssertionError unless no entry of ``got`` is farther than ``within`` from expected."""
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
    require(
        not text.startswith(("Traceback", "<")), f"an error is a sentence for people, not {text!r}"
    )


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
    """Return a value as it comes back from an MCAP log."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        with closing(Recorder(path, {"recipe.yaml": ""}, full_clouds=True)) as recorder:
            recorder.flangeye_stage_finished("0.kit.value", "0", value, 0.0)
        (entry,) = read_run(path).entries
    return entry.value


def require_round_trip(value: Any, through: Callable[[Any], Any] = from_log) -> None:
    """Raise AssertionError unless a value comes back from a log as it went in."""
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

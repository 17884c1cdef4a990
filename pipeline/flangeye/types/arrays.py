"""Validated read-only arrays of values, and notes of a step."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Any, ForwardRef

import numpy as np
from pydantic import PlainSerializer, PlainValidator
from pydantic_core import core_schema

if TYPE_CHECKING:
    from numpy.typing import NDArray


class _AsNestedLists:
    """Lets pydantic read and write an array as nested JSON lists, bit for bit."""

    def __init__(self, dtype: str) -> None:
        self._dtype = dtype

    def __get_pydantic_core_schema__(self, _source: Any, _handler: Any) -> core_schema.CoreSchema:
        return core_schema.no_info_plain_validator_function(
            lambda value: np.asarray(value, dtype=self._dtype),
            serialization=core_schema.plain_serializer_function_ser_schema(lambda a: a.tolist()),
        )

    def __get_pydantic_json_schema__(self, _schema: Any, _handler: Any) -> dict[str, Any]:
        return {"type": "array"}


if TYPE_CHECKING:
    Floats = NDArray[np.float64]
    Singles = NDArray[np.float32]
    Indices = NDArray[np.intp]
    Mask = NDArray[np.bool_]

    Array = Annotated[NDArray[np.float64], _AsNestedLists("float64")]
    Pixels = Annotated[NDArray[np.uint8], _AsNestedLists("uint8")]
    FloatArray = Singles | Floats
else:  # names that are evaluated where they are asked for: NumPy takes longer than many a command

    def _arrays(dtype: str) -> ForwardRef:
        return ForwardRef(f"np.ndarray[Any, np.dtype[np.{dtype}]]", module=__name__)

    Floats, Singles, Indices, Mask = map(_arrays, ("float64", "float32", "intp", "bool_"))
    Array = Annotated[Floats, _AsNestedLists("float64")]
    Pixels = Annotated[_arrays("uint8"), _AsNestedLists("uint8")]
    FloatArray = Singles | Floats


def frozen(value: Any, shape: tuple[int, ...], what: str) -> Floats:
    """Return a read-only float64 copy of ``value``; refuse another shape or non-finite entries."""
    array = np.array(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{what} has shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{what} holds values that are not finite")
    array.setflags(write=False)
    return array


def freeze(instance: Any, **shapes: tuple[int, ...]) -> None:
    """Make the arrays of a frozen dataclass read-only; refuse one of another shape.

    Raises:
        ValueError: Names the class and the array.
    """
    for name, shape in shapes.items():
        what = f"{type(instance).__name__}.{name}"
        object.__setattr__(instance, name, frozen(getattr(instance, name), shape, what))


class Warn(str):
    """A note with something to do: printed at once, first in the report and on the page.

    The text says what is wrong, in one line.

    Attributes:
        fix: What mends it: a command, a line of the recipe, or what to do at the cell.
    """

    fix: str
    __slots__ = ("fix",)

    def __new__(cls, text: str, fix: str) -> Warn:
        """Return the warning."""
        made = super().__new__(cls, text)
        made.fix = fix
        return made

    def __getnewargs__(self) -> tuple[str, str]:  # type: ignore[override]
        """Return the text and the fix, so that pickling keeps both."""
        return str(self), self.fix


def _plain(note: str) -> str | dict[str, str]:
    return {"text": str(note), "fix": note.fix} if isinstance(note, Warn) else note


def _note(plain: Any) -> str:
    if isinstance(plain, str):
        return plain
    if isinstance(plain, dict) and [type(plain.get(key)) for key in ("text", "fix")] == [str, str]:
        return Warn(plain["text"], plain["fix"])
    raise ValueError("a note is a text, or {text: …, fix: …}")


Note = Annotated[str, PlainValidator(_note), PlainSerializer(_plain)]
"""A plain line is for the record: ``flangeye show``, the report's end and ``result.json``. Logged
as a text, and a :class:`Warn` as ``{text, fix}``."""


def as_line(note: str) -> str:
    """Return a note as one line: its text, and its fix."""
    return f"warning: {note}; {note.fix}" if isinstance(note, Warn) else f"note: {note}"


def warnings_of(notes: Iterable[str]) -> list[Warn]:
    """Return the notes that require action."""
    return [note for note in notes if isinstance(note, Warn)]


def records_of(notes: Iterable[str]) -> list[str]:
    """Return the notes that require no action."""
    return [note for note in notes if not isinstance(note, Warn)]

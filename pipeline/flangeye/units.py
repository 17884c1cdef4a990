"""Quantities in YAML carry their unit, ``31.5 mm``; in code they are SI floats.

The conversion is exact in decimal, so that a resolved recipe reads back bit for bit.
"""

import math
import re
from collections.abc import Iterable
from decimal import Decimal
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, PlainSerializer, WithJsonSchema

_DEG, _MILLI = Decimal(math.pi) / 180, Decimal("1e-3")
_UNITS: dict[str, tuple[str, dict[str, Decimal]]] = {
    "length": ("31.5 mm", {"mm": _MILLI, "m": Decimal(1), "um": Decimal("1e-6")}),
    "angle": ("17 deg", {"deg": _DEG, "rad": Decimal(1), "mrad": _MILLI}),
    "joint position": (
        "170 deg",
        {"deg": _DEG, "rad": Decimal(1), "mm": _MILLI, "m": Decimal(1)},
    ),
    "duration": ("500 ms", {"ms": _MILLI, "s": Decimal(1), "min": Decimal(60)}),
    "speed": ("50 mm/s", {"mm/s": _MILLI, "m/s": Decimal(1)}),
    "acceleration": ("200 mm/s^2", {"mm/s^2": _MILLI, "m/s^2": Decimal(1)}),
    "angular speed": ("30 deg/s", {"deg/s": _DEG, "rad/s": Decimal(1)}),
    "force": ("3 N", {"N": Decimal(1), "mN": _MILLI}),
    "stiffness": ("2 N/mm", {"N/mm": Decimal("1e3"), "N/m": Decimal(1)}),
}
"""An example of each kind of quantity, and each of its units in SI units."""


def parse_quantity(value: object, kind: str) -> float:
    """Return ``value`` in SI units; ``kind`` is a key of the unit table, such as ``length``.

    Raises:
        ValueError: There is no unit, or it measures something else; the message lists the units.
    """
    example, units = _UNITS[kind]
    a_kind = f"an {kind}" if kind[0] in "aeiou" else f"a {kind}"
    allowed = f"{', '.join(units)}, for example '{example}'"
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise ValueError(f"{a_kind} is a number with a unit ({allowed})")
    # Each part can be matched in one way only: otherwise ten thousand digits take for ever.
    number_and_unit = r"\s*([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)\s*(?:([^\d\s.]\S*)\s*)?"
    match = re.fullmatch(number_and_unit, str(value))
    if match is None:
        raise ValueError(f"'{value}' is not {a_kind}: write a number and a unit ({allowed})")
    number, unit = match.groups()
    if unit is None:
        raise ValueError(f"'{value}' has no unit: {a_kind} needs one ({allowed})")
    if unit not in units:
        other = next((k for k, (_, known) in _UNITS.items() if unit in known), None)
        what = f"is not a {kind}, it has a unit of {other}" if other else "has an unknown unit"
        raise ValueError(f"'{value}' {what}: {a_kind} needs {allowed}")
    try:
        si = float(Decimal(number) * units[unit])
    except ArithmeticError:  # an exponent of more digits than decimals have
        si = math.inf
    if not math.isfinite(si):
        raise ValueError(f"'{value}' is out of any range")
    return si


def format_quantity(si: float, kind: str) -> str:
    """Return ``si`` as text that :func:`parse_quantity` reads back to the same float."""
    si = float(si)  # NumPy's floats have another repr
    _, units = _UNITS[kind]
    for unit, factor in units.items():
        text = f"{float(f'{Decimal(repr(si)) / factor:.12g}'):.12g} {unit}"
        if parse_quantity(text, kind) == si:
            return text
    return f"{si!r} {next(u for u, f in units.items() if f == 1)}"


def _quantity(kind: str) -> tuple[BeforeValidator, PlainSerializer, WithJsonSchema]:
    example, units = _UNITS[kind]

    def parse(value: object) -> float:
        # Defaults may be given in SI by code; only text from YAML must carry its unit.
        return value.si if isinstance(value, SI) else parse_quantity(value, kind)

    return (
        BeforeValidator(parse),
        PlainSerializer(lambda si: format_quantity(si, kind), return_type=str, when_used="json"),
        WithJsonSchema(
            {
                "type": "string",
                "x-flangeye-quantity": kind,
                "examples": [example],
                "description": f"A {kind} with its unit: {', '.join(units)}.",
            }
        ),
    )


def param(default: Any = ..., *, description: str = "", **limits: Any) -> Any:
    """Declare a field of a model: pydantic's ``Field``, for defaults written as text with a unit.

    ``inlier: Length = param("0.3 mm", gt=0)``: the text is parsed like a recipe's, the limits are
    in SI, and type checkers see the field's own type. What it means stands in the text below it.
    """
    return Field(default, description=description or None, validate_default=True, **limits)


def in_mm(point: Iterable[float]) -> str:
    """Return a point [m] as text: ``600, 0, 950 mm``."""
    return ", ".join(f"{1e3 * x:.0f}" for x in point) + " mm"


class SI:
    """A number that code passes to a quantity field without going through text."""

    def __init__(self, si: float) -> None:
        self.si = float(si)


Length = Annotated[float, *_quantity("length")]
Angle = Annotated[float, *_quantity("angle")]
JointPosition = Annotated[float, *_quantity("joint position")]
Duration = Annotated[float, *_quantity("duration")]
Speed = Annotated[float, *_quantity("speed")]
Acceleration = Annotated[float, *_quantity("acceleration")]
AngularSpeed = Annotated[float, *_quantity("angular speed")]
Force = Annotated[float, *_quantity("force")]
Stiffness = Annotated[float, *_quantity("stiffness")]

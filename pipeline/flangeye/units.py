"""Quantities in YAML carry their unit, ``31.5 mm``; in code they are SI floats.

The conversion is exact in decimal, so that a resolved recipe reads back bit for bit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from decimal import Decimal
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, PlainSerializer, WithJsonSchema

_DEGREE = Decimal(math.pi) / 180
_UNITS: dict[str, dict[str, Decimal]] = {
    "length": {"mm": Decimal("1e-3"), "m": Decimal(1), "um": Decimal("1e-6")},
    "angle": {"deg": _DEGREE, "rad": Decimal(1), "mrad": Decimal("1e-3")},
    "joint position": {"deg": _DEGREE, "rad": Decimal(1), "mm": Decimal("1e-3"), "m": Decimal(1)},
    "duration": {"ms": Decimal("1e-3"), "s": Decimal(1), "min": Decimal(60)},
    "speed": {"mm/s": Decimal("1e-3"), "m/s": Decimal(1)},
    "acceleration": {"mm/s^2": Decimal("1e-3"), "m/s^2": Decimal(1)},
    "angular speed": {"deg/s": _DEGREE, "rad/s": Decimal(1)},
    "force": {"N": Decimal(1), "mN": Decimal("1e-3")},
    "stiffness": {"N/mm": Decimal("1e3"), "N/m": Decimal(1)},
}
_EXAMPLES = {
    "length": "31.5 mm",
    "angle": "17 deg",
    "joint position": "170 deg",
    "duration": "500 ms",
    "speed": "50 mm/s",
    "acceleration": "200 mm/s^2",
    "angular speed": "30 deg/s",
    "force": "3 N",
    "stiffness": "2 N/mm",
}
# Each part can be matched in one way only: otherwise ten thousand digits take for ever.
_NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
_QUANTITY = re.compile(rf"\s*({_NUMBER})\s*(?:([^\d\s.]\S*)\s*)?")


def parse_quantity(value: object, kind: str) -> float:
    """Return ``value`` in SI units; ``kind`` is a key of the unit table, such as ``length``.

    Raises:
        ValueError: There is no unit, or it measures something else; says what is allowed.
    """
    units = _UNITS[kind]
    a_kind = f"an {kind}" if kind[0] in "aeiou" else f"a {kind}"
    allowed = f"{', '.join(units)}, for example '{_EXAMPLES[kind]}'"
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise ValueError(f"{a_kind} is a number with a unit ({allowed})")
    match = _QUANTITY.fullmatch(str(value))
    if match is None:
        raise ValueError(f"'{value}' is not {a_kind}: write a number and a unit ({allowed})")
    number, unit = match.groups()
    if unit is None:
        raise ValueError(f"'{value}' has no unit: {a_kind} needs one ({allowed})")
    if unit not in units:
        other = next((k for k, table in _UNITS.items() if unit in table), None)
        what = f"is no {kind}, it has a unit of {other}" if other else "has an unknown unit"
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
    for unit, factor in _UNITS[kind].items():
        text = f"{float(f'{Decimal(repr(si)) / factor:.12g}'):.12g} {unit}"
        if parse_quantity(text, kind) == si:
            return text
    return f"{si!r} {next(u for u, f in _UNITS[kind].items() if f == 1)}"


def _quantity(kind: str) -> tuple[BeforeValidator, PlainSerializer, WithJsonSchema]:
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
                "examples": [_EXAMPLES[kind]],
                "description": f"A {kind} with its unit: {', '.join(_UNITS[kind])}.",
            }
        ),
    )


def param(default: Any = ..., *, description: str = "", **limits: Any) -> Any:
    """Declare a field of a model: pydantic's ``Field``, for defaults written as text with a unit.

    ``inlier: Length = param("0.3 mm", gt=0, description="…")``: the text is parsed like a
    recipe's, the limits are in SI, and type checkers see the field's own type.
    """
    return Field(default, description=description or None, validate_default=True, **limits)


def in_mm(point: Iterable[float]) -> str:
    """Return a point [m] for people: ``600, 0, 950 mm``."""
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

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flangeye.units import format_quantity, parse_quantity


@pytest.mark.parametrize(
    ("text", "kind", "si"),
    [
        ("31.5 mm", "length", 0.0315),
        ("0.3mm", "length", 0.0003),
        ("  1e-3 m ", "length", 0.001),
        ("-5 um", "length", -5e-6),
        ("180 deg", "angle", np.pi),
        ("500 ms", "duration", 0.5),
        ("2 N/mm", "stiffness", 2000.0),
    ],
)
def test_a_quantity_becomes_si(text: str, kind: str, si: Any) -> None:
    assert parse_quantity(text, kind) == si


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (0.3, "'0.3' has no unit: a length needs one (mm, m, um, for example '31.5 mm')"),
        ("0.3", "'0.3' has no unit: a length needs one (mm, m, um, for example '31.5 mm')"),
        (
            "5 deg",
            "'5 deg' is not a length, it has a unit of angle: a length needs mm, m, um, for example "
            "'31.5 mm'",
        ),
        (
            "5 parsec",
            "'5 parsec' has an unknown unit: a length needs mm, m, um, for example '31.5 mm'",
        ),
        (
            "wide",
            "'wide' is not a length: write a number and a unit (mm, m, um, for example '31.5 mm')",
        ),
        (True, "a length is a number with a unit (mm, m, um, for example '31.5 mm')"),
        (None, "a length is a number with a unit (mm, m, um, for example '31.5 mm')"),
        ("1e999 mm", "'1e999 mm' is out of any range"),
        (
            "nan mm",
            "'nan mm' is not a length: write a number and a unit (mm, m, um, for example '31.5 mm')",
        ),
    ],
)
def test_a_quantity_that_is_none_says_what_is_allowed(value: Any, message: str) -> None:
    with pytest.raises(ValueError) as error:
        parse_quantity(value, "length")
    assert str(error.value) == message


@given(st.floats(-1e6, 1e6), st.sampled_from(["length", "angle", "duration", "speed", "force"]))
def test_formatting_reads_back_to_the_same_float(si: float, kind: Any) -> None:
    assert parse_quantity(format_quantity(si, kind), kind) == si


@pytest.mark.parametrize("text", ["1" * 400_000 + "..", "1" + " " * 400_000 + "2", "1." * 200_000])
def test_a_text_of_very_many_digits_is_refused_in_one_pass(text: str) -> None:
    with pytest.raises(ValueError, match="is not a length"):
        parse_quantity(text, "length")

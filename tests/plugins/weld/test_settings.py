"""What a recipe may ask of a weld, at the least and at the most."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pydantic import ValidationError

from flangeye.plugin.stage import BoundPart
from flangeye_emulators.finger.sensor import SimulatedFingerParams, sensor_simulated_finger
from flangeye_plugins.weld.settings import Following, PassParams, WeldTactileParams

SENSOR = BoundPart(sensor_simulated_finger, SimulatedFingerParams())
SOME = {
    "m": "deflection preload reach corner_radius overlap",
    "m/s": "speed",
    "rad/s": "turn_rate",
    "s": "blind",
    "": "weave_frequency",
}
"""An empty answer is refused."""
NONE = {
    "m": "arm_sigma distortion root_gap weave_width",
    "": "friction gain_drift",
}
"""What may be nothing, but not less."""
MOST = [
    ("speed", 0.05, "m/s"), ("turn_rate", 2.0, "rad/s"), ("deflection", 0.01, "m"), ("preload", 0.01, "m"),
    ("weave_width", 0.03, "m"), ("weave_frequency", 10.0, ""),
    ("friction", 1.0, ""), ("gain_drift", 1.0, ""),
]  # fmt: skip
EITHER = [
    ("offset_across", 0.02, "m"), ("work_angle", math.pi / 3, "rad"),
    ("travel_angle", math.pi / 6, "rad"),
]  # fmt: skip


def asked(name: str, value: float, unit: str) -> Any:
    """Ask for a value; return what it is taken for, or None where it is refused."""
    given = f"{value!r} {unit}" if unit else value
    try:
        told = WeldTactileParams.model_validate({"sensor": SENSOR, name: given})
    except ValidationError:
        return None
    return getattr(told, name)


def each(table: dict[str, str]) -> list[tuple[str, str]]:
    return [(name, unit) for unit, names in table.items() for name in names.split()]


@pytest.mark.parametrize(("name", "unit"), each(SOME))
def test_what_a_weld_needs_some_of_is_more_than_nothing(name: str, unit: str) -> None:
    assert asked(name, 1e-3, unit) == pytest.approx(1e-3)
    assert asked(name, 0.0, unit) is None


@pytest.mark.parametrize(("name", "unit"), each(NONE))
def test_what_a_weld_can_do_without_is_not_less_than_nothing(name: str, unit: str) -> None:
    assert asked(name, 0.0, unit) == 0.0
    assert asked(name, -1e-9, unit) is None


@pytest.mark.parametrize(("name", "most", "unit"), MOST)
def test_no_recipe_asks_for_more_than_an_arm_and_a_finger_are_to_do(
    name: str, most: float, unit: str
) -> None:
    assert asked(name, most, unit) == pytest.approx(most)
    assert asked(name, 1.001 * most, unit) is None


@pytest.mark.parametrize(("name", "most", "unit"), EITHER)
def test_an_angle_or_offset_is_as_large_to_either_side(name: str, most: float, unit: str) -> None:
    for sign in (1, -1):
        assert asked(name, sign * 0.999 * most, unit) == pytest.approx(sign * 0.999 * most)
        assert asked(name, sign * 1.001 * most, unit) is None


def test_the_error_that_is_allowed_and_the_leg_that_is_chosen_are_some() -> None:
    assert asked("max_error", 1e-6, "m") == pytest.approx(1e-6)
    assert asked("max_error", 0.0, "m") is None
    sensor: dict[str, Any] = {"sensor": SENSOR}
    assert WeldTactileParams.model_validate({**sensor, "leg": 1}).leg == 1
    with pytest.raises(ValidationError):
        WeldTactileParams.model_validate({**sensor, "leg": 0})
    assert len(Following.model_validate({"passes": [{}] * 20}).passes) == 20
    with pytest.raises(ValidationError):
        Following.model_validate({"passes": [{}] * 21})


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("across", ("30 mm", "-30 mm", "0 mm"), ("30.1 mm", "-30.1 mm")),
        ("up", ("0.01 mm", "50 mm"), ("0 mm", "50.1 mm")),
        ("weave_width", ("0 mm", "30 mm"), ("-0.01 mm", "30.1 mm")),
    ],
)
def test_a_later_pass_is_beside_the_root_s_and_higher(name: str, good: Any, bad: Any) -> None:
    for given in good:
        PassParams.model_validate({name: given})
    for given in bad:
        with pytest.raises(ValidationError):
            PassParams.model_validate({name: given})


def test_what_is_not_asked_for_holds_for_a_root_pass_and_the_ones_after_it() -> None:
    """A weave is one a second; the servo takes an error back within a third of one."""
    known = Following()
    assert known.weave_frequency == 1.0
    assert known.servo_gain == known.height_gain == 3.0
    assert (known.cross_track_gain, known.friction, known.gain_drift) == (1.0, 0.3, 0.05)


def test_an_arm_slows_down_and_stands_before_a_weld_that_sees_nothing_is_stopped() -> None:
    for blind in (0.5, 5.0):
        known = Following.model_validate({"blind": f"{blind} s"})
        assert (known.stale, known.still) == pytest.approx((blind / 5, 0.3 * blind))

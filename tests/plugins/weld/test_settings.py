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
RANGES = {
    "speed": (1e-6, 0.05), "turn_rate": (1e-6, 2.0), "deflection": (1e-6, 0.01),
    "preload": (1e-6, 0.01), "weave_frequency": (1e-6, 10.0), "max_error": (1e-6, None),
    **{name: (1e-6, None) for name in ("reach", "corner_radius", "overlap", "blind")},
    "weave_width": (0.0, 0.03), "friction": (0.0, 1.0), "gain_drift": (0.0, 1.0),
    **{name: (0.0, None) for name in ("arm_sigma", "distortion", "root_gap")},
    "offset_across": (-0.02, 0.02), "work_angle": (-math.pi / 3, math.pi / 3),
    "travel_angle": (-math.pi / 6, math.pi / 6), "leg": (1, None),
}  # fmt: skip
UNITS = {"speed": "m/s", "turn_rate": "rad/s", "work_angle": "rad", "travel_angle": "rad",
         "blind": "s", "weave_frequency": "", "friction": "", "gain_drift": "", "leg": ""}  # fmt: skip


@pytest.mark.parametrize("name", RANGES)
def test_a_weld_is_asked_for_within_what_arm_and_finger_are_to_do(name: str) -> None:
    least, most = RANGES[name]
    beyond = 1e-3 * (most or 1.0) if least != 1 else 1
    below = 0.0 if least == 1e-6 else least - beyond
    for value, taken in (
        (least, True),
        (below, False),
        (most, True),
        ((most or 0) + beyond, False),
    ):
        unit = UNITS.get(name, "m")
        given: Any = {"sensor": SENSOR, name: f"{value!r} {unit}" if unit else value}
        if taken and value is not None:
            found = getattr(WeldTactileParams.model_validate(given), name)
            assert found == pytest.approx(value)
        elif not taken and (value == below or most is not None):
            with pytest.raises(ValidationError):
                WeldTactileParams.model_validate(given)


def test_a_later_pass_is_beside_the_root_s_and_higher() -> None:
    assert len(Following.model_validate({"passes": [{}] * 20}).passes) == 20
    with pytest.raises(ValidationError):
        Following.model_validate({"passes": [{}] * 21})
    PassParams.model_validate({"across": "-30 mm", "up": "50 mm", "weave_width": "30 mm"})
    for wrong in ({"across": "30.1 mm"}, {"up": "0 mm"}, {"up": "50.1 mm"}):
        with pytest.raises(ValidationError):
            PassParams.model_validate(wrong)


def test_an_arm_slows_down_and_stands_before_a_weld_that_sees_nothing_is_stopped() -> None:
    for blind in (0.5, 5.0):
        known = Following.model_validate({"blind": f"{blind} s"})
        assert (known.stale, known.still) == pytest.approx((blind / 5, 0.3 * blind))


def test_the_tip_is_set_down_where_the_seam_has_surely_begun() -> None:
    for ends, down in (("2 mm", Following.inset), ("9 mm", 10.5e-3)):
        assert Following.model_validate({"ends": ends}).set_down == pytest.approx(down)

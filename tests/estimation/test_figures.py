"""The figures of tests/benchmarks/hand_eye.py: against OpenCV 4, and against the bound."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.benchmarks import hand_eye

OPENCV = json.loads(
    (Path(__file__).parents[1] / "benchmarks" / "opencv4.json").read_text(encoding="utf-8")
)


@pytest.mark.parametrize("case", hand_eye.CASES)
@pytest.mark.parametrize("name", [*hand_eye.BY_MOTIONS, *hand_eye.BY_BOTH])
def test_no_closed_form_is_less_accurate_than_opencvs(name: Any, case: Any) -> None:
    made = hand_eye.sessions(case, 60)
    ours = hand_eye.rms([hand_eye.closed(name, m) for m in made], made)
    assert (np.array(ours) <= 1.001 * np.array(OPENCV[case][name])).all()


@pytest.mark.slow
def test_the_default_solver_is_near_the_bound() -> None:
    made = hand_eye.sessions("n=15, 17 deg", 400)
    found = np.array(hand_eye.rms([hand_eye.most_likely(m) for m in made], made))
    bound = np.array(hand_eye.bound(made))
    assert (found <= 1.1 * bound).all()
    assert (found >= 0.9 * bound).all()  # else the bound is not one


@pytest.mark.slow
def test_closed_forms_stand_where_they_are_known_to() -> None:
    made = hand_eye.sessions("n=15, 17 deg", 200)
    turn, shift = hand_eye.rms([hand_eye.closed("park_martin", m) for m in made], made)
    assert turn < 0.17
    assert shift < 1.4


def test_one_random_start_is_enough_for_two_arms() -> None:
    assert hand_eye.converged(20) >= 19

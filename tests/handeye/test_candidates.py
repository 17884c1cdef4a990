"""Poses held out: the systems they lead to, against least squares by singular values."""

from typing import Any

import numpy as np
import pytest

from flangeye.handeye.candidates import LEAST_KEPT, Model, _solved
from flangeye.types import ArmCorrection


@pytest.mark.parametrize("smallest", [1.0, 1e-3, 1e-7, 1e-11, 0.0])
def test_held_out_systems_are_solved_as_by_singular_values(smallest: float) -> None:
    rng = np.random.default_rng(3)
    left, right = (np.linalg.qr(rng.normal(size=(24, 24)))[0] for _ in range(2))
    square = left * np.append(np.linspace(1.0, 0.1, 23), smallest) @ right
    wanted = rng.normal(size=(24, 5))
    expected = np.linalg.lstsq(square, wanted, rcond=LEAST_KEPT)[0]
    scale = np.abs(expected).max()
    assert _solved(square, wanted) == pytest.approx(expected, abs=1e-8 * scale)


def test_a_system_without_an_inverse_has_the_least_solution() -> None:
    assert _solved(np.diag([2.0, 0.0]), np.ones((2, 1))) == pytest.approx(np.array([[0.5], [0.0]]))


def test_joints_are_corrected_where_the_correction_has_offsets_of_them() -> None:
    some: Any = None
    offset = ArmCorrection(np.zeros(3))
    joints = ArmCorrection(np.zeros(3), joint_offsets=np.zeros(6), joints=np.zeros(6))
    assert [Model(some, each).corrects_joints for each in (None, offset, joints)] == [
        False, False, True,
    ]  # fmt: skip

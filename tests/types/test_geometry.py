"""Rotations of one vector and of many, against a library's."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flangeye.types.geometry import (
    basis_of_plane,
    rotation_exp,
    rotation_from_rpy,
    rotation_log,
    rows_at,
    rpy_from_rotation,
)

VECTORS = st.lists(st.floats(-7.0, 7.0), min_size=3, max_size=3).map(np.array)


@given(VECTORS)
def test_one_and_many_are_the_rotations_of_the_library(vector: Any) -> None:
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rotation_exp(vector), expected, atol=1e-14)
    np.testing.assert_allclose(rotation_exp(np.stack([vector, -vector]))[0], expected, atol=1e-14)


@pytest.mark.parametrize("length", [0.0, 1e-300, 1e-160, 1e-12, 1e-8, np.pi])
def test_at_no_turn_a_small_one_and_half_a_turn(length: Any) -> None:
    vector = length * np.array([0.6, 0.0, -0.8])
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rotation_exp(vector), expected, atol=1e-14)


@given(VECTORS.filter(lambda v: np.linalg.norm(v) < 3.1))
def test_the_logarithm_undoes_it(vector: Any) -> None:
    np.testing.assert_allclose(rotation_log(rotation_exp(vector)), vector, atol=1e-12)


@given(VECTORS.filter(lambda v: np.linalg.norm(v) > 0.1))
def test_the_axes_of_a_plane_are_a_rotation_about_its_normal(normal: Any) -> None:
    axes = basis_of_plane(normal)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(axes[2] * np.linalg.norm(normal), normal, atol=1e-12)


@pytest.mark.parametrize("normal", [[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 0]])
def test_a_plane_without_a_normal_has_no_axes(normal: list[float]) -> None:
    assert np.isnan(basis_of_plane(np.array(normal))).all()


ANGLES = st.floats(-7.0, 7.0) | st.sampled_from([0.0, np.pi / 2, -np.pi / 2, np.pi])


@given(ANGLES, ANGLES, ANGLES, st.sampled_from([0.0, 1e-15, 1e-9, 1e-5]))
def test_roll_pitch_and_yaw_give_the_rotation_at_any_pitch(r: Any, p: Any, y: Any, by: Any) -> None:
    expected = Rotation.from_euler("xyz", [r, p + by, y]).as_matrix()
    found = rotation_from_rpy(*rpy_from_rotation(expected))
    np.testing.assert_allclose(found, expected, atol=1e-14)


@pytest.mark.parametrize("axis", [*np.eye(3), *-np.eye(3)])
def test_a_frame_whose_z_lies_along_any_axis_has_angles(axis: Any) -> None:
    angles = rpy_from_rotation(basis_of_plane(axis).T)
    np.testing.assert_allclose(rotation_from_rpy(*angles)[:, 2], axis, atol=1e-15)


def test_rows_are_interpolated_column_by_column() -> None:
    times, points = np.array([0.0, 1.0, 3.0]), np.array([[0.0, 0, 0], [1, 2, 3], [3, 2, 1.0]])
    found = rows_at(np.array([0.5, 2.0]), times, points)
    assert found == pytest.approx(np.array([[0.5, 1, 1.5], [2, 2, 2]]))
    assert rows_at(2.0, times, points) == pytest.approx([2, 2, 2])
    assert rows_at(2.0, times, points[:, 0]) == pytest.approx(2.0)
    assert rows_at([0.5], times, points[:, None]).shape == (1, 1, 3)

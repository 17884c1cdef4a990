from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from flangeye.types.geometry import rotation_exp, rotation_log
from flangeye_emulators.controllers.poses import (
    carried,
    pose_matrix,
    pose_vector,
    rotation_matrix,
    rotation_vector,
    twist_between,
)

coordinates = st.floats(-2.0, 2.0)
vectors = st.tuples(coordinates, coordinates, coordinates).map(np.array)
poses = st.tuples(*[coordinates] * 6).map(np.array)


@given(vectors)
def test_rotations_agree_with_the_geometry_of_the_engine(vector: Any) -> None:
    rotation = rotation_matrix(vector)
    assert np.allclose(rotation, rotation_exp(vector), atol=1e-14)
    assert np.allclose(rotation_vector(rotation), rotation_log(rotation), atol=1e-9)


@given(vectors, st.floats(1e-12, 1e-3))
def test_tiny_turns_keep_their_digits(vector: Any, scale: float) -> None:
    small = scale * vector
    assert np.allclose(rotation_vector(rotation_matrix(small)), small, rtol=1e-9, atol=1e-17)


def test_half_a_turn_has_a_vector_of_length_pi() -> None:
    for axis in np.eye(3):
        vector = rotation_vector(rotation_matrix(np.pi * axis))
        assert np.isclose(np.linalg.norm(vector), np.pi)
        assert np.allclose(rotation_matrix(vector), rotation_matrix(np.pi * axis), atol=1e-12)


@given(poses, poses)
def test_a_twist_leads_from_pose_to_pose(first: Any, second: Any) -> None:
    start, end = pose_matrix(first), pose_matrix(second)
    assert np.allclose(carried(start, twist_between(start, end), 1.0), end, atol=1e-9)
    assert np.allclose(pose_matrix(pose_vector(start)), start, atol=1e-12)

"""Several linear systems at once, of which some equations are not known."""

import numpy as np
import pytest

from flangeye.estimation.start.loops import entries, least_squares
from flangeye.types.geometry import rotation_exp


def test_the_entries_of_a_rotation_move_points_as_it_does() -> None:
    rng = np.random.default_rng(0)
    before, points = rng.standard_normal((2, 5, 3, 3)), rng.standard_normal((2, 5, 3))
    points[1, 2] = np.nan  # what was not seen is nowhere
    rows = entries(before, points)
    assert rows.shape == (2, 5, 3, 9)
    rotation = rotation_exp(np.array([0.3, -0.5, 0.8]))
    expected = np.einsum("knij,jl,knl->kni", before, rotation, np.nan_to_num(points))
    assert rows @ rotation.ravel() == pytest.approx(expected)


def test_equations_that_are_not_known_do_not_count() -> None:
    rng = np.random.default_rng(1)
    first, second = rng.standard_normal((2, 6, 3, 4)), rng.standard_normal((1, 6, 3, 2))
    third = rng.standard_normal((2, 6, 3, 6))
    x = rng.standard_normal((2, 6))
    both = np.concatenate([first, np.broadcast_to(second, (2, 6, 3, 2))], axis=-1)
    right = (both @ x[:, None, :, None])[..., 0] + 0.1 * rng.standard_normal((2, 6, 3))
    other = (third @ x[:, None, :, None])[..., 0] + 0.1 * rng.standard_normal((2, 6, 3))
    right[0, 2], right[1, 4, 1] = np.nan, np.nan
    found = least_squares(([first, second], right), ([third], other))
    for k in range(2):
        rows = np.concatenate([both[k].reshape(-1, 6), third[k].reshape(-1, 6)])
        sides = np.concatenate([right[k].ravel(), other[k].ravel()])
        known = np.isfinite(sides)
        expected = np.linalg.lstsq(rows[known], sides[known], rcond=None)[0]
        assert found[k] == pytest.approx(expected)

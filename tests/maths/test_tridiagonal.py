"""Block tridiagonal systems against their dense form."""

import numpy as np
import pytest

from flangeye.maths.tridiagonal import solve_tridiagonal


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 8, 50])
def test_it_solves_and_inverts_as_the_dense_matrix_does(count: int) -> None:
    rng, s = np.random.default_rng(count), 3
    lower = np.zeros((count, s, count, s))
    for k in range(count):
        lower[k, :, k] = rng.normal(size=(s, s)) + 3 * np.eye(s)
        lower[k, :, max(k - 1, 0)] += rng.normal(size=(s, s)) * (k > 0)
    factor = lower.reshape(count * s, -1)
    whole = factor @ factor.T
    blocks, right = whole.reshape(count, s, count, s), rng.normal(size=(count, s, 2))
    at = np.arange(count)
    diagonal, below = blocks[at, :, at], blocks[at[1:], :, at[:-1]]
    found = solve_tridiagonal(diagonal, below, right)
    inverse = np.linalg.inv(whole)
    solution = (inverse @ right.reshape(count * s, 2)).reshape(right.shape)
    inverse = inverse.reshape(count, s, count, s)
    np.testing.assert_allclose(found.solution, solution, atol=1e-9)
    np.testing.assert_allclose(found.diagonal, inverse[at, :, at], atol=1e-9)
    np.testing.assert_allclose(found.below, inverse[at[1:], :, at[:-1]], atol=1e-9)
    assert found.logdet == pytest.approx(np.linalg.slogdet(whole)[1])

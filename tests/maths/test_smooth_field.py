"""A smooth field of displacements."""

from dataclasses import replace

import numpy as np

from flangeye.maths.arm_correction import (
    corrected_flange,
    displacement,
    effects,
    field_over,
)
from flangeye.types import ArmCorrection
from flangeye.types.geometry import rigid

RNG = np.random.default_rng(0)
PLACES = np.array([0.4, -0.5, 0.2]) + RNG.uniform(-0.15, 0.15, (40, 3))


def weighted(seed: int):
    bare = field_over(PLACES)
    rng = np.random.default_rng(seed)
    return replace(bare, weights=1e-3 * rng.standard_normal(len(bare.weights)))


def test_a_quadratic_error_is_followed() -> None:
    """What joints that are off do to a workspace of 0.3 m is a polynomial of low order."""
    field, u = field_over(PLACES), PLACES - PLACES.mean(axis=0)
    wanted = np.stack([4e-2 * u[:, 0] * u[:, 1], 3e-2 * u[:, 2] ** 2, -5e-2 * u[:, 0] ** 2], axis=1)
    rows, wanted = effects(field, PLACES).reshape(120, -1), wanted.ravel()
    left = wanted - rows @ np.linalg.lstsq(rows, wanted, rcond=None)[0]
    assert np.abs(left).max() < 0.15 * np.abs(wanted).max()


def test_a_correction_moves_the_reported_flange_by_the_field() -> None:
    field, pose = weighted(3), rigid(np.eye(3), PLACES[3])
    moved = corrected_flange(pose, None, ArmCorrection(np.zeros(3), field=field), None)
    np.testing.assert_allclose(moved[:3, 3] - pose[:3, 3], displacement(field, PLACES[3]))
    np.testing.assert_allclose(moved[:3, :3], np.eye(3))

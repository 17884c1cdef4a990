"""The arm's error over poses: its sizes, as a calibration's residuals tell them."""

from __future__ import annotations

import numpy as np
import pytest

from flangeye.handeye.pose_error import PoseError, pose_error_of
from flangeye.maths.geometry import hat, rigid, rotation_exp
from flangeye.types import Floats

NOISE = np.diag([3e-5**2] * 3 + [1e-4**2] * 2)


def drawn(seed: int, smooth: float) -> tuple[Floats, Floats, Floats, Floats, PoseError]:
    """Return residuals, effects, own covariances, poses of 40 poses, and what made them."""
    rng = np.random.default_rng(seed)
    turns = rotation_exp(rng.uniform(-0.4, 0.4, (40, 3)))
    poses = np.array([rigid(turn, rng.uniform(-0.2, 0.2, 3) + [0.5, 0, 0.4]) for turn in turns])
    own = np.tile(NOISE, (40, 1, 1))
    bare = pose_error_of(np.zeros((40, 5)), np.zeros((40, 5, 6)), own, poses)
    made = PoseError(bare.middle, bare.lengths, (smooth, smooth), (1e-4, 2e-4))
    effects = np.zeros((40, 5, 6))
    across = poses[:, :3, :2].transpose(0, 2, 1)
    effects[:, :3, :3], effects[:, :3, 3:] = -hat(poses[:, :3, 3] - poses[0, :3, 3]), np.eye(3)
    effects[:, 3:, :3] = -across @ hat(poses[:, :3, 2])
    weights = rng.normal(size=len(made.variances)) * np.sqrt(made.variances)
    noise = np.linalg.cholesky(own + made.beyond) @ rng.normal(size=(40, 5, 1))
    return made.effects(poses) @ weights + noise[..., 0], effects, own, poses, made


def test_sizes_are_found_again() -> None:
    found = [pose_error_of(*drawn(seed, 4e-4)[:4]) for seed in range(12)]
    made = drawn(0, 4e-4)[4]
    for name in ("smooth", "noise"):
        median = np.median([getattr(f, name) for f in found], axis=0)
        np.testing.assert_allclose(median, getattr(made, name), rtol=0.2)


def test_an_arm_without_a_smooth_error_is_given_none_that_counts() -> None:
    for seed in range(4):
        found = pose_error_of(*drawn(seed, 0.0)[:4])
        assert all(s < n for s, n in zip(found.smooth, found.noise, strict=True))
        assert found.noise == pytest.approx((1e-4, 2e-4), rel=0.35)


def test_effects_are_those_of_a_shift_and_of_a_turn() -> None:
    *_, poses, made = drawn(0, 1e-3)
    weights = np.random.default_rng(3).normal(size=len(made.variances))
    k = len(weights) // 2
    both = made.effects(poses)
    np.testing.assert_array_equal(both[:, :3, k:], 0.0)
    np.testing.assert_array_equal(both[:, 3:, :k], 0.0)
    turned = 1e-6 * (both @ weights)[:, 3:]
    spread = made.effects(poses)[:, :3, :k] @ weights[k:]  # the same functions, as rotations
    after = rotation_exp(1e-6 * spread) @ poses[:, :3, :3]
    tilts = np.einsum("nia,ni->na", poses[:, :3, :2], after[:, :, 2])
    np.testing.assert_allclose(tilts, turned, rtol=1e-4, atol=1e-12)

"""The arm's error over poses: its sizes, as a calibration's residuals tell them."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from flangeye.types import Floats
from flangeye.types.geometry import hat, rigid, rotation_exp, rotation_log
from flangeye.workflow.doctor.monitor.pose_error import (
    ArmPoseErrors,
    _unlikelihood,
    _unsized,
    pose_error_of,
)

NOISE = np.diag([3e-5**2] * 3 + [1e-4**2] * 2)


def drawn(seed: int, smooth: float) -> tuple[Floats, Floats, Floats, Floats, ArmPoseErrors]:
    """Return residuals, effects, own covariances, poses of 40 poses, and what made them."""
    rng = np.random.default_rng(seed)
    turns = rotation_exp(rng.uniform(-0.4, 0.4, (40, 3)))
    poses = np.array([rigid(turn, rng.uniform(-0.2, 0.2, 3) + [0.5, 0, 0.4]) for turn in turns])
    own = np.tile(NOISE, (40, 1, 1))
    bare = pose_error_of(np.zeros((40, 5)), np.zeros((40, 5, 6)), own, poses)
    made = ArmPoseErrors(bare.middle, bare.lengths, (smooth, smooth), (1e-4, 2e-4))
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


def test_errors_are_as_likely_as_a_normal_distribution_says() -> None:
    """Of all residuals at once: no sums pose by pose, no determinant taken apart."""
    residuals, effects, own, poses, made = drawn(5, 3e-4)
    sized = replace(made, smooth=(3e-4, 5e-4), noise=(1e-4, 2e-4))
    design = np.concatenate([effects, sized.effects(poses)], axis=2)
    rows = design.reshape(200, -1)
    variances = np.concatenate([np.ones(6), np.repeat([9e-8, 25e-8], 39)])
    spread = rows @ (variances[:, None] * rows.T)
    for i in range(40):
        beyond = np.diag([1e-8] * 3 + [4e-8] * 2)
        spread[5 * i : 5 * i + 5, 5 * i : 5 * i + 5] += own[i] + beyond
    flat = residuals.ravel()
    wanted = np.linalg.slogdet(spread)[1] + flat @ np.linalg.solve(spread, flat)
    assert _unlikelihood(design, residuals, own, sized) == pytest.approx(wanted, rel=1e-9)


def test_sizes_are_those_of_the_greatest_likelihood() -> None:
    """None other about them is likelier, and each is kept between a micron and a centimetre."""
    residuals, effects, own, poses, _ = drawn(2, 4e-4)
    found = pose_error_of(residuals, effects, own, poses)
    design = np.concatenate([effects, found.effects(poses)], axis=2)

    def unlikely(sizes: Floats) -> float:
        sized = replace(found, smooth=tuple(sizes[:2]), noise=tuple(sizes[2:]))
        return _unlikelihood(design, residuals, own, sized)

    best = np.array([*found.smooth, *found.noise])
    for i, factor in product(range(4), (0.8, 1.25)):
        assert unlikely(best * np.where(np.arange(4) == i, factor, 1.0)) > unlikely(best)
    assert pose_error_of(0 * residuals, effects, own, poses).noise == pytest.approx((1e-6, 1e-6))
    assert pose_error_of(1e6 * residuals, effects, own, poses).noise == pytest.approx((1e-2, 1e-2))


def test_sizes_are_told_by_sixty_poses_at_most() -> None:
    residuals, effects, own, poses = (np.repeat(x, 3, axis=0) for x in drawn(2, 4e-4)[:4])
    chosen = np.linspace(0, 119, 60).astype(int)
    of_sixty = pose_error_of(residuals, effects, own, poses)
    others = np.isin(np.arange(120), chosen, invert=True)
    found = pose_error_of(residuals + others[:, None], effects, own, poses)
    assert (found.smooth, found.noise) == (of_sixty.smooth, of_sixty.noise)


def test_lengths_are_half_as_much_again_as_the_poses_reach_or_the_shortest() -> None:
    """About the mean of places and of orientations."""
    places = np.array([[0.3, 0, 0], [-0.1, 0, 0], [0.1, 0.1, 0], [0.1, -0.1, 0]])
    turns = rotation_exp(np.array([[0, 0, 0.5], [0, 0, -0.5], [0, 0.2, 0], [0, -0.2, 0]]))
    found = _unsized(np.array([rigid(t, p) for t, p in zip(turns, places, strict=True)]))
    np.testing.assert_allclose(found.middle, rigid(np.eye(3), np.array([0.1, 0, 0])), atol=1e-12)
    np.testing.assert_allclose(found.lengths, 1.5 * np.repeat([0.2, 0.5], 3))
    near = np.array(
        [rigid(t, 0.1 * p) for t, p in zip(np.tile(np.eye(3), (4, 1, 1)), places, strict=True)]
    )
    bare = _unsized(near)
    np.testing.assert_allclose(bare.lengths, 1.5 * np.repeat([0.05, 0.3], 3))
    assert (bare.smooth, bare.noise) == ((0.0, 0.0), (0.0, 0.0))


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


def test_effects_are_of_second_order_in_place_and_of_first_in_orientation() -> None:
    """Every product of the coordinates' functions that costs two at most, a turn costing two."""
    *_, poses, made = drawn(0, 1e-3)
    of_place = (poses[:, :3, 3] - made.middle[:3, 3]) / made.lengths[:3]
    of_turn = rotation_log(poses[:, :3, :3] @ made.middle[:3, :3].T) / made.lengths[3:]
    scaled = np.concatenate([of_place, of_turn], axis=1)
    bell = np.exp(-0.5 * (scaled**2).sum(axis=1))
    x, y, z, a, b, c = scaled.T
    one, r = np.ones(len(poses)), np.sqrt(2.0)
    expected = [one, a, b, c, x, y, z, x * y, x * z, y * z, x * x / r, y * y / r, z * z / r]
    effects = made.effects(poses)
    assert effects.shape == (40, 5, 6 * len(expected))
    found = effects[:, 0, 0 : 3 * len(expected) : 3] / bell[:, None]
    for wanted in expected:  # in some order
        assert np.abs(found - wanted[:, None]).max(axis=0).min() < 1e-12

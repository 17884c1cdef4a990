"""The best calibration of every variant at once, with its likelihood; a few bad samples allowed.

Errors of a centre, of a normal and of a rotation are each taken as multivariate t with four
degrees of freedom and a scale of their own: close to normal in the middle, and a sample that is
far off costs the logarithm of its distance instead of its square. Fitted by
expectation-maximisation (Lange, Little & Taylor 1989), a Gauss-Newton step each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from flangeye.doctor.diagnosis import Arms, Misfit, RecordedSession
from flangeye.maths.geometry import hat, rotation_exp
from flangeye.types import Floats
from flangeye_plugins.check.equations import Equations, VariantUnknowns, equations_of, start_of

TAILS = 4.0
"""Degrees of freedom of the errors' distribution."""
FINEST_ANGLE = 1e-4
"""No scanner and no arm is better than this [rad]."""


class ErrorBlock(NamedTuple):
    """Errors of one kind: residuals (K, N, 3), their squares (K, N), derivatives (K, N, 3, P)."""

    residuals: Floats
    squares: Floats
    jacobian: Floats
    dimension: int
    finest: float


@dataclass(frozen=True, eq=False)
class VariantFits:
    """The best calibration of each of K variants.

    Attributes:
        likelihood: (K,) logarithm; minus infinity where no fit was found.
        residuals: (K, N, 3) of each kind of error, the centres' first [m, rad]; NaN where nothing
            was seen. In the carrier.
        scales: (K, B) standard deviation of each kind of error per coordinate [m, rad].
        count: (K,) coordinates that were measured.
        parameters: How many numbers were fitted.
        unknowns: What was fitted.
        information: (K, P, P) of the parameters.
    """

    likelihood: Floats
    residuals: tuple[Floats, ...]
    scales: Floats
    count: Floats
    parameters: int
    unknowns: VariantUnknowns
    information: Floats

    def misfit(self, variant: int = 0) -> Misfit:
        """Return the errors of a variant."""
        rms = np.sqrt(np.nanmean(self.lengths[variant] ** 2, axis=0))
        return Misfit(float(rms[0]), float(rms[1]) if len(rms) > 1 else None)

    @property
    def lengths(self) -> Floats:
        """(K, N, B) of every residual [m, rad]."""
        return np.stack([np.linalg.norm(r, axis=-1) for r in self.residuals], axis=-1)


def fit(equations: Equations) -> VariantFits:
    """Fit every variant: the camera, and the target where its place is not known."""
    unknowns = start_of(equations)
    blocks = _blocks(equations, unknowns)
    scales = [_first_scale(block) for block in blocks]
    fit_steps = 15
    for _ in range(fit_steps):
        weights = [_weights(b, s) for b, s in zip(blocks, scales, strict=True)]
        information, gradient = _normal_equations(blocks, weights, scales)
        unknowns = _moved(unknowns, _solved(information, gradient))
        blocks = _blocks(equations, unknowns)
        scales = [_scale(b, w) for b, w in zip(blocks, weights, strict=True)]
    return _score(blocks, scales, unknowns, information)


def errors_at(equations: Equations, unknowns: VariantUnknowns) -> Floats:
    """Return (K, N, B) lengths of every kind of error where the unknowns are as given [m, rad]."""
    blocks = _blocks(equations, unknowns)
    lengths = [np.linalg.norm(block.residuals, axis=-1) for block in blocks]
    return np.stack(np.broadcast_arrays(*lengths), axis=-1)


def _blocks(equations: Equations, unknowns: VariantUnknowns) -> list[ErrorBlock]:
    """Return every kind of error and how the parameters move it.

    Parameters: rotation and position of the camera (left perturbation); where the target's place
    is not known, its position, and its rotation if it has one; the second arm's base, if any.
    """
    blocks = [_centre_block(equations, unknowns)]
    if equations.has_rotations:
        blocks.append(_rotation_block(equations, unknowns))
    elif np.isfinite(equations.normals).any():
        blocks.append(_normal_block(equations, unknowns))
    return blocks


def _centre_block(equations: Equations, unknowns: VariantUnknowns) -> ErrorBlock:
    turned = equations.centres @ unknowns.rotation.swapaxes(-1, -2)
    mounts = equations.carried(unknowns.other)
    expected = (mounts[..., :3, :3] @ unknowns.place[..., None])[..., 0] + mounts[..., :3, 3]
    residuals = turned + unknowns.position[:, None] - expected
    parts = [-hat(turned), np.broadcast_to(np.eye(3), (*turned.shape, 3))]
    if unknowns.free_place:
        parts.append(-np.broadcast_to(mounts[..., :3, :3], (*turned.shape, 3)))
    if unknowns.free_turn:
        parts.append(np.zeros((*turned.shape, 3)))
    if equations.bases is not None:
        turns = equations.bases[..., :3, :3]
        arm = turns.swapaxes(-1, -2) @ (expected - equations.bases[..., :3, 3])[..., None]
        lever = arm[..., 0] - unknowns.other[:, None, :3, 3]
        parts += [turns @ hat(lever), -turns]
    # No scanner and no arm is better than this [m]
    return _block(residuals, parts, 3, 20e-6)


def _rotation_block(equations: Equations, unknowns: VariantUnknowns) -> ErrorBlock:
    turns = equations.carried(unknowns.other)[..., :3, :3]
    expected = turns @ unknowns.turn[:, None]
    seen = unknowns.rotation[:, None] @ equations.rotations
    residuals = log_of(seen @ expected.swapaxes(-1, -2))
    eye = np.broadcast_to(np.eye(3), (*residuals.shape, 3))
    zero = np.zeros_like(eye)
    parts = [eye, zero, *([zero] if unknowns.free_place else [])]
    parts += [-turns] if unknowns.free_turn else []
    if equations.bases is not None:
        parts += [-equations.bases[..., :3, :3], zero]
    return _block(residuals, parts, 3, FINEST_ANGLE)


def _normal_block(equations: Equations, unknowns: VariantUnknowns) -> ErrorBlock:
    turned = equations.normals @ unknowns.rotation.swapaxes(-1, -2)
    expected = equations.carried(unknowns.other)[..., :3, 2]
    residuals = turned - expected
    zero = np.zeros((*turned.shape, 3))
    parts = [-hat(turned), zero, *([zero] if unknowns.free_place else [])]
    if equations.bases is not None:
        turns = equations.bases[..., :3, :3]
        lever = turns.swapaxes(-1, -2) @ expected[..., None]
        parts += [turns @ hat(lever[..., 0]), zero]
    return _block(residuals, parts, 2, FINEST_ANGLE)


def _block(residuals: Floats, parts: Sequence[Floats], dimension: int, finest: float) -> ErrorBlock:
    """Return errors with what each group of parameters does to them."""
    jacobian = np.empty((*residuals.shape, 3 * len(parts)))
    for i, part in enumerate(parts):
        jacobian[..., 3 * i : 3 * i + 3] = part
    squares = np.asarray((residuals**2).sum(axis=-1))
    return ErrorBlock(residuals, squares, jacobian, dimension, finest)


def _first_scale(block: ErrorBlock) -> Floats:
    middle = np.nanmedian(block.squares, axis=-1)
    return np.asarray(np.sqrt(np.maximum(middle / block.dimension, block.finest**2)))


def _weights(block: ErrorBlock, scale: Floats) -> Floats:
    """(K, N) what each sample counts: 0 where it was not measured."""
    distances = block.squares / scale[:, None] ** 2
    return np.nan_to_num((TAILS + block.dimension) / (TAILS + distances))


def _scale(block: ErrorBlock, weights: Floats) -> Floats:
    seen = np.isfinite(block.squares).sum(axis=-1)
    total = (weights * np.nan_to_num(block.squares)).sum(axis=-1)
    return np.asarray(np.sqrt(np.maximum(total / (block.dimension * seen), block.finest**2)))


def _normal_equations(
    blocks: list[ErrorBlock], weights: list[Floats], scales: list[Floats]
) -> tuple[Floats, Floats]:
    p = blocks[0].jacobian.shape[-1]
    information: Floats = np.zeros((1, p, p))
    gradient: Floats = np.zeros((1, p))
    for block, weight, scale in zip(blocks, weights, scales, strict=True):
        w = np.sqrt(weight)[..., None] / scale[:, None, None]
        seen = weight[..., None] > 0
        rows = np.where(seen[..., None], block.jacobian, 0.0) * w[..., None]
        flat = rows.reshape(len(rows), -1, p)
        errors = (np.where(seen, block.residuals, 0.0) * w).reshape(len(rows), -1, 1)
        information = information + flat.swapaxes(-1, -2) @ flat
        gradient = gradient + (flat.swapaxes(-1, -2) @ errors)[..., 0]
    return information, gradient


def _solved(information: Floats, gradient: Floats) -> Floats:
    diagonal = np.einsum("kii->ki", information)
    size = np.sqrt(np.maximum(diagonal, 1e-300))
    p = information.shape[-1]
    # Share of the information that is added to every direction, for those nothing is known of
    damping = 1e-9
    scaled = information / (size[:, :, None] * size[:, None, :]) + damping * np.eye(p)
    return np.asarray(-np.linalg.solve(scaled, (gradient / size)[..., None])[..., 0] / size)


def _moved(unknowns: VariantUnknowns, step: Floats) -> VariantUnknowns:
    turned = rotation_exp(step[:, :3]) @ unknowns.rotation
    place, turn = unknowns.place, unknowns.turn
    if unknowns.free_place:
        place = place + step[:, None, 6:9]
    if unknowns.free_turn:
        turn = rotation_exp(step[:, 9:12]) @ turn
    other = _moved_base(unknowns.other, step[:, -6:]) if unknowns.free_other else unknowns.other
    return unknowns._replace(
        rotation=turned,
        position=unknowns.position + step[:, 3:6],
        place=place,
        turn=turn,
        other=other,
    )


def _moved_base(other: Floats, step: Floats) -> Floats:
    out = np.array(np.broadcast_to(other, (len(step), 4, 4)))
    out[:, :3, :3] = rotation_exp(step[:, :3]) @ out[:, :3, :3]
    out[:, :3, 3] += step[:, 3:]
    return out


def _score(
    blocks: list[ErrorBlock], scales: list[Floats], unknowns: VariantUnknowns, information: Floats
) -> VariantFits:
    likelihood = count = np.zeros(1)
    for block, scale in zip(blocks, scales, strict=True):
        squares, d = block.squares, block.dimension
        seen = np.isfinite(squares).sum(axis=-1)
        tails = np.nansum(np.log1p(squares / (TAILS * scale[:, None] ** 2)), axis=-1)
        likelihood = likelihood - d * seen * np.log(scale) - 0.5 * (TAILS + d) * tails
        count = count + d * seen
    return VariantFits(
        np.nan_to_num(likelihood, nan=-np.inf),
        tuple(block.residuals for block in blocks),
        np.stack(scales, axis=-1),
        count,
        information.shape[-1],
        unknowns,
        information,
    )


def log_of(rotations: Floats) -> Floats:
    """Return the rotation vectors (..., 3) [rad] of rotations (..., 3, 3).

    Their lengths are right at any angle; close to half a turn their direction is rough.
    """
    twice_sine_axis = np.stack(
        [
            rotations[..., 2, 1] - rotations[..., 1, 2],
            rotations[..., 0, 2] - rotations[..., 2, 0],
            rotations[..., 1, 0] - rotations[..., 0, 1],
        ],
        axis=-1,
    )
    length = np.linalg.norm(twice_sine_axis, axis=-1, keepdims=True)
    trace = np.trace(rotations, axis1=-2, axis2=-1)[..., None]
    angle = np.arctan2(length, trace - 1.0)
    away = np.broadcast_to([1.0, 0.0, 0.0], twice_sine_axis.shape)
    direction = np.where(length > 1e-9, twice_sine_axis / np.maximum(length, 1e-9), away)
    small = 0.5 * twice_sine_axis
    return np.asarray(np.where(angle < 1e-6, small, angle * direction))


@lru_cache(maxsize=2)
def fit_of(session: RecordedSession) -> VariantFits:
    """Return the best calibration of a session as it is; a session is known by its identity."""
    return fit(equations_of(session))


def named(arms: Arms, session: RecordedSession) -> str:
    """Return whose poses, as messages call them."""
    if session.seconds is None:
        return "the robot's"
    return {"both": "both arms'", "first": "the first arm's", "second": "the second arm's"}[arms]

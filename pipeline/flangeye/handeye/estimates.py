"""From the fit of a loop to the transforms with covariances that people get."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flangeye.handeye.likelihood import Solution
from flangeye.maths.geometry import adjoint_shift
from flangeye.maths.kinematics import Arm
from flangeye.models.configuration import Configuration, mapped_and_expected
from flangeye.types import Floats, HandEye, Observation, Pair, Transform, TransformEstimate


def transforms_of(
    configuration: Configuration, x: Floats, y: Floats, z: Floats
) -> dict[str, Transform]:
    """Return a configuration's unknowns by name, from X, Y and Z (4, 4)."""
    values = [x, *([y] if configuration.other_base else []), z]
    return {
        name: Transform.named(name, matrix)
        for name, matrix in zip(configuration.unknowns, values, strict=False)
    }


def columns_of(name: str, configuration: Configuration) -> slice:
    """Return where an unknown stands among the moves of X, Y and Z."""
    if name == configuration.unknowns[0]:
        return slice(0, 6)
    return slice(6, 12) if name == configuration.other_base else slice(12, 18)


def noise_note(found: Solution) -> str:
    """Say what noise there is beyond the features' own, of whole poses."""
    shift, turn = noise_beyond(found)
    return f"noise beyond the features' own: {shift:.3f} mm and {turn:.3f} deg per axis"


def noise_beyond(found: Solution) -> tuple[float, float]:
    """Return the noise per axis beyond the features' own, the arms' as the camera has it.

    Of places [mm] and of turns [deg].
    """
    of_arms = np.diagonal(found.linear.of_arms, axis1=1, axis2=2).mean(axis=0) * found.noise.arms
    shift = np.sqrt(of_arms[3:].mean() + found.noise.pose + found.noise.depth / 3) * 1e3
    return float(shift), float(np.degrees(np.sqrt(of_arms[:3].mean() + found.noise.tilt)))


def estimate_at(
    transform: Transform, covariance: Floats, about: Floats, unobservable: Floats
) -> TransformEstimate:
    """Return an estimate, its covariance taken about a point instead of the child's origin.

    Args:
        transform: The value.
        covariance: (6, 6), rotation and translation, this at the child's origin.
        about: (3,) in the parent [m].
        unobservable: (6, k) moves, taken like the covariance.
    """
    shift = adjoint_shift(about - transform.translation)
    moved = shift @ covariance @ shift.T
    sizes = np.linalg.norm(unobservable, axis=0)
    # A direction that moves another unknown alone is none of this one.
    kept = (shift @ unobservable)[:, sizes > 1e-6]
    directions = np.linalg.qr(kept)[0].T if kept.shape[1] else np.zeros((0, 6))
    return TransformEstimate(transform, 0.5 * (moved + moved.T), about, directions)


def points_of_interest(
    configuration: Configuration,
    transforms: dict[str, Transform],
    observations: Sequence[Observation],
    arm: Arm | None,
) -> dict[str, Floats]:
    """Return, by name of each unknown, where its error matters, in its parent [m].

    The middle of what the camera saw; for a target's place the target itself.
    """
    ends = configuration.ends(transforms, observations, arm)
    mapped, _ = mapped_and_expected(ends, observations)
    seen = np.array([o.feature.centre for o in observations])
    camera, *others = configuration.unknowns
    points = {name: transforms[name].translation for name in others}
    if configuration.other_base:
        points[configuration.other_base] = mapped.mean(axis=0)
    return {camera: transforms[camera].apply(seen).mean(axis=0), **points}


def pairs_of(
    configuration: Configuration,
    transforms: dict[str, Transform],
    observations: Sequence[Observation],
    arm: Arm | None,
    reasons: Sequence[str | None],
) -> tuple[Pair, ...]:
    """Return every observation with its residual in ``base``, and why it was not used."""
    ends = configuration.ends(transforms, observations, arm)
    mapped, expected = mapped_and_expected(ends, observations)
    return tuple(
        Pair(o, residual, reason is None, reason)
        for o, residual, reason in zip(observations, mapped - expected, reasons, strict=True)
    )


def hand_eye_of(
    estimates: Sequence[TransformEstimate], pairs: tuple[Pair, ...], method: str
) -> HandEye:
    """Return the calibration: the camera's pose first, then the other unknowns."""
    camera, *others = estimates
    return HandEye(camera, pairs, method, others=tuple(others))

"""What was found wrong with arms, as a controller or a robot's file can take it."""

from __future__ import annotations

import numpy as np

from flangeye.estimation.effects.arm import displacements
from flangeye.estimation.estimate import Estimate
from flangeye.estimation.graph import Carrier
from flangeye.maths.smooth_field import effects as field_effects
from flangeye.maths.smooth_field import field_over
from flangeye.types import ArmCorrection, Floats, SmoothField

CORRECTED = frozenset({"zeros", "lengths", "twists", "field"})
"""Kinds of errors that a correction has numbers for. Of encoders and sag its field takes what is
not rigid over the work; the rigid part stays in the camera's pose."""


def corrections_of(found: Estimate, tool_offset: Floats) -> dict[str, ArmCorrection]:
    """Return what to correct, by arm; nothing of what carries neither camera nor target."""
    flanges = [c for c in found.problem.carriers if c.link is None and not c.axis]
    return {c.arm: _correction(found, c, tool_offset) for c in flanges}


def _correction(found: Estimate, carrier: Carrier, tool_offset: Floats) -> ArmCorrection:
    zeros, lengths, twists = (_mean(found, carrier, k) for k in ("zeros", "lengths", "twists"))
    field = _field(found, carrier)
    if zeros is None or lengths is None or twists is None or carrier.joints is None:
        return ArmCorrection(tool_offset, field=field)
    built = np.column_stack([lengths.reshape(-1, 2), twists])
    return ArmCorrection(tool_offset, zeros, carrier.joints[0], field, built)


def _mean(found: Estimate, carrier: Carrier, kind: str) -> Floats | None:
    """Return the mean of an arm's numbers of a kind; None where it has none."""
    of_arm = [mean for effect, mean, _ in found.numbers(kind) if effect.cause == carrier.arm]
    return of_arm[0] if of_arm else None


def _field(found: Estimate, carrier: Carrier) -> SmoothField | None:
    """Return the smooth error, with what the correction has no other numbers for."""
    weights = _mean(found, carrier, "field")
    if weights is None:
        return None
    places = np.asarray(found.problem.frames[carrier.frame].place)[:, :3, 3]
    bare = field_over(places)
    rest = _other_displacement(found, carrier, len(places))
    effects = field_effects(bare, places).reshape(3 * len(places), -1)
    own = np.linalg.lstsq(effects, rest.ravel(), rcond=1e-6)[0]
    return SmoothField(bare.about, bare.length, bare.rigid, weights + own)


def _other_displacement(found: Estimate, carrier: Carrier, count: int) -> Floats:
    """Return (T, 3) by how much errors of other kinds displace the flange [m]."""
    out = np.zeros((count, 3))
    if carrier.joints is None or carrier.kinematics is None:
        return out
    for kind, columns in displacements(carrier).items():
        mean = _mean(found, carrier, kind)
        if kind not in CORRECTED and mean is not None:
            out += columns[:, 3:] @ mean
    return out

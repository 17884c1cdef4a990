"""Estimated arm errors as corrections for a controller or a robot model file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flangeye.estimation.effects.arm import COMMON
from flangeye.estimation.estimate import Estimate
from flangeye.estimation.graph import Carrier
from flangeye.maths.arm_correction import effects as field_effects
from flangeye.maths.arm_correction import field_over
from flangeye.types import ArmCorrection, Floats
from flangeye.types.geometry import levers

CORRECTED = frozenset({"zeros", "lengths", "twists", "field"})
"""Kinds of errors that a correction contains. Errors of encoders and sag enter its smooth field by
their non-rigid part; the rigid part stays in the camera's pose."""


def corrected_part(found: Estimate) -> Floats:
    """Return the (K,) part of the effects' values that a correction removes.

    It consists of the parameters in the correction. Other errors of the arm are included as far as
    the correction's smooth field reproduces them at the session's poses.
    """
    kept = np.repeat([e.of_arm and e.kind in CORRECTED for e in found.effects], found.counts)
    out = np.where(kept, found.posterior.mean[found.posterior.model.p :], 0.0)
    for carrier in _flanges(found):
        field = _rows(found, carrier, "field")
        if field is not None:
            out[field] += _as_field(found, carrier)
    return out


def corrections_of(found: Estimate, tool_offset: Floats) -> dict[str, ArmCorrection]:
    """Return the correction of each arm that carries a camera or a target."""
    numbers = corrected_part(found)
    return {c.arm: _correction(found, c, tool_offset, numbers) for c in _flanges(found)}


def _flanges(found: Estimate) -> list[Carrier]:
    return [c for c in found.problem.carriers if c.link is None and not c.axis]


def _rows(found: Estimate, carrier: Carrier, kind: str) -> slice | None:
    """Return the slice of an arm's parameters of one kind; None if it has none."""
    p = found.posterior.model.p
    own = (at for effect, at in found.rows(kind) if effect.cause == carrier.arm)
    return next((slice(at.start - p, at.stop - p) for at in own), None)


def _correction(
    found: Estimate, carrier: Carrier, tool_offset: Floats, numbers: Floats
) -> ArmCorrection:
    def of(kind: str) -> Floats | None:
        rows = _rows(found, carrier, kind)
        return None if rows is None else numbers[rows]

    zeros, lengths, twists, weights = map(of, ("zeros", "lengths", "twists", "field"))
    bare = field_over(_places(found, carrier))
    field = None if weights is None else replace(bare, weights=weights)
    if zeros is None or lengths is None or twists is None or carrier.joints is None:
        return ArmCorrection(tool_offset, field=field)
    built = np.column_stack([lengths.reshape(-1, 2), twists])
    return ArmCorrection(tool_offset, zeros, carrier.joints[0], field, built)


def _places(found: Estimate, carrier: Carrier) -> Floats:
    return np.asarray(found.problem.frames[carrier.frame].place)[:, :3, 3]


def _as_field(found: Estimate, carrier: Carrier) -> Floats:
    """Return smooth-field weights that displace the flange like the arm's other errors.

    They fit at the session's poses by least squares; the rigid part stays in the camera's pose.
    """
    problem, field = found.problem, field_over(_places(found, carrier))
    linear, rest = problem.following(carrier), np.zeros((len(problem.seen), 3))
    ends = np.cumsum([found.posterior.model.p, *found.counts])
    for effect, first, end in zip(found.effects, ends, ends[1:], strict=False):
        mine = effect.of_arm and effect.cause == carrier.arm
        if mine and effect.kind not in {*CORRECTED, COMMON}:
            rest += effect.block(problem, linear)[:, 3:] @ found.posterior.mean[first:end]
    places = _places(found, carrier)[problem.seen.times]
    # The rigid part is in the camera's pose already: left in here it would be corrected twice
    motions = levers(places - field.about).reshape(-1, 6)
    bent = rest.ravel() - motions @ np.linalg.lstsq(motions, rest.ravel(), rcond=1e-9)[0]
    moves = field_effects(field, places).reshape(len(bent), -1)
    return np.asarray(np.linalg.lstsq(moves, bent, rcond=1e-6)[0])

"""Errors that all sightings of one target share: of its circle and its face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from flangeye.estimation.effects.effect import Effect
from flangeye.estimation.graph import Linear, Places, Problem
from flangeye.types import Floats


def target_effects(problem: Problem) -> list[Effect]:
    """Return the errors of circles and faces that are the same at all poses.

    Where a target's place is unknown, a tilt and an offset are part of it.
    """
    circles = [k for k, (_, t) in enumerate(problem.ends) if problem.frames[t].place is not None]
    s = problem.seen
    ranks = s.ranks[np.isin(s.pairs, circles) & s.by_depth]
    effects = []
    if (ranks == 5).any():
        # Of a plate's face against the flange's axis [rad]: flatness of 0.02 mm over the
        # rim and what the last joint's bearing adds
        effects.append(Effect("tilt of the face", partial(_tilt, circles), 0.5e-3, kind="tilt"))
    if (ranks > 0).any():
        effects.append(
            # Of the seen circle's centre from the controller's flange origin [m]
            Effect("offset of the circle", partial(_offset, circles), 0.03e-3, kind="offset")
        )
    return effects


def wrong_offset(problem: Problem, effects: Sequence[Effect]) -> list[Effect] | None:
    """Return the effects with a circle offset of millimetres; None without a circle."""
    # 2 mm, or three times as much or as little, one sigma
    wrong = [replace(e, size=2e-3, factor=3.0) if e.kind == "offset" else e for e in effects]
    return wrong if any(e.kind == "offset" for e in effects) else None


def offset_shown_to(problem: Problem, places: Places) -> float:
    """Return the standard deviation of a circle's offset in its flange with a flat prior [m].

    A constant offset d moves the circle by R_i d at pose i. Where all R_i are alike, it cannot be
    distinguished from a shift of the camera.

    Returns:
        The deviation in the least observable direction; 0 if the residuals are not noise.
    """
    linear, shown = problem.linearised(places), np.zeros((3, 3))
    for pair in np.unique(problem.seen.pairs):
        turns = linear.turns[problem.seen.pairs == pair]
        turned = turns - turns.mean(axis=0)
        shown += np.einsum("nij,nik->jk", turned, turned)
    error = float(np.sqrt((linear.residuals[:, 3:] ** 2).mean()))
    # Larger residuals [m] are those of a mistake, not of the arm and the scanner
    return error / float(np.sqrt(max(np.linalg.eigvalsh(shown)[0], 1e-12))) if error < 5e-3 else 0.0


def _tilt(circles: list[int], problem: Problem, linear: Linear) -> Floats:
    out = np.zeros((len(problem.seen), 6, 2))
    rows = np.isin(problem.seen.pairs, circles) & (problem.seen.ranks == 5)
    out[rows, :3] = linear.turns[rows][:, :, :2]
    return out


def _offset(circles: list[int], problem: Problem, linear: Linear) -> Floats:
    out = np.zeros((len(problem.seen), 6, 3))
    rows = np.isin(problem.seen.pairs, circles)
    out[rows, 3:] = linear.turns[rows]
    return out

"""The true workpiece: the CAD's groove, with edges that wander, a gap, tack welds and spatter."""

from __future__ import annotations

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.weld_world.groove import TICK, Gap, Groove, Relief, Section
from flangeye_emulators.weld_world.settings import WorkpieceTruth
from flangeye_plugins.weld.path import Path

VARIES = 60e-3
"""Period with which the half angle varies along the seam [m]."""

GRAIN = 1e-3
"""Correlation length of spatter along the seam [m]."""


def true_groove(
    points: Floats, section: Section, truth: WorkpieceTruth, rng: np.random.Generator
) -> Groove:
    """Return the groove that is really there.

    Args:
        points: (N, 3) of the CAD's seam in the plane of the work, with its height [m].
        section: The CAD's.
        truth: What differs.
        rng: Draws spatter, and where waves begin.
    """
    root = _wandered(Path(points), truth, rng.uniform(0.0, 2 * np.pi))
    real = Section(section.half_angle + truth.half_angle, section.depth, section.lean + truth.lean)
    gaps = tuple(Gap(gap.start, gap.start + gap.length, gap.side) for gap in truth.gaps)
    return Groove(root, real, gaps, _relief(root.length, real, truth, rng))


def _wandered(path: Path, truth: WorkpieceTruth, phase: float) -> Path:
    if not (truth.wave or truth.bow):
        return path
    s = np.linspace(0.0, path.length, len(path.points))
    aside = truth.wave * np.sin(2 * np.pi * s / truth.wave_length + phase)
    aside += truth.bow * np.sin(np.pi * s / path.length)
    points = path.points.copy()
    points[:, :2] += aside[:, None] * np.stack([-path.tangents[:, 1], path.tangents[:, 0]], axis=1)
    return Path(points)


def _relief(
    length: float, section: Section, truth: WorkpieceTruth, rng: np.random.Generator
) -> Relief:
    s = np.arange(0.0, length + TICK, TICK)
    fill = _grains(s, truth.spatter, rng) - truth.root_gap / 2 / np.tan(section.half_angle)
    for tack in truth.tacks:
        inside = np.clip(np.minimum(s - tack.start, tack.start + tack.length - s) / GRAIN, 0.0, 1.0)
        fill = fill + tack.height * inside
    wider = truth.half_angle_wave * np.sin(2 * np.pi * s / VARIES + rng.uniform(0.0, 2 * np.pi))
    aside = _grains(s, truth.spatter, rng)
    return Relief(tuple(fill.tolist()), tuple(aside.tolist()), tuple(wider.tolist()))


def _grains(s: Floats, sigma: float, rng: np.random.Generator) -> Floats:
    knots = np.arange(0.0, s[-1] + 2 * GRAIN, GRAIN)
    return np.interp(s, knots, sigma * rng.standard_normal(len(knots)))

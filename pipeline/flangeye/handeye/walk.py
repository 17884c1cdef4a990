"""A random walk of what should rest: camera, target, or an odometry's world. Arrays only.

Residuals that are alike in poses near in time are no independent noise: many of them know no
more than few. What wanders is a motion ``W_k`` of the base, or of the hand, at every pose, from one
to the next by a small step that turns about a point, ``W_k = Exp(step) W_{k-1}``. Steps are
independent, so that the precision of all motions is block tridiagonal: they are marginalised
exactly, at a cost linear in the poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from flangeye.handeye.measurements import Measurements
from flangeye.maths.geometry import hat, invert, rotation_exp, rotation_log
from flangeye.types import Floats

Of = Literal["base", "camera", "target"]
"""What walks: the base under what rests in it, or what the hand carries, in the hand."""
FINEST_STEP = 1e-9
"""Of a walk [m, rad]: what does not walk keeps a finite precision."""


class StepSize(NamedTuple):
    """Standard deviations of a step, per axis: a turn [rad], a shift [m], of the scale's log."""

    turn: float
    shift: float
    growth: float = 1.0


NO_WALK = StepSize(1.0, 1.0)
"""Where nothing walks, the size of its steps is of no account."""


@dataclass(frozen=True, eq=False)
class Walk:
    """How it walks.

    Attributes:
        about: (N, 3) what the steps turn about, in ``base``, or in the hand [m].
        grows: Whether the camera's scale walks as well.
        of: What walks.
    """

    about: Floats
    grows: bool = False
    of: Of = "base"

    @property
    def states(self) -> int:
        """How many numbers a step has."""
        return 7 if self.grows else 6

    def local(self) -> Floats:
        """Return (N, s, s): from a motion about the base's origin to one about the point."""
        out = np.tile(np.eye(self.states), (len(self.about), 1, 1))
        out[:, 3:6, :3] = -hat(self.about)
        return out

    def variances(self, size: StepSize) -> Floats:
        """Return (N, s) of the steps.

        The first leads from the place that is to be found to where the walk begins: the mean of a
        walk cannot be told from that place, which so is known no better.
        """
        deviations = np.repeat(np.maximum(size, FINEST_STEP), (3, 3, 1))[: self.states]
        out = np.tile(deviations**2, (len(self.about), 1))
        out[0] *= max(len(out) / 3, 1.0)
        return np.asarray(out)


@dataclass(frozen=True, eq=False)
class Course:
    """Where it walked.

    Attributes:
        motions: (N, 4, 4) of the base; of the hand under what it carries, where that walks.
        growth: (N,) logarithm of the camera's scale.
        of: What walks.
    """

    motions: Floats
    growth: Floats
    of: Of = "base"

    @classmethod
    def still(cls, walk: Walk) -> Course:
        """Return the course of what may walk, and rests."""
        count = len(walk.about)
        return cls(np.tile(np.eye(4), (count, 1, 1)), np.zeros(count), walk.of)

    def moved(self, by: Floats) -> Course:
        """Return the course moved by (N, s): turn and shift about the base's origin, growth."""
        motions = self.motions.copy()
        turn = rotation_exp(by[:, :3])
        motions[:, :3] = turn @ motions[:, :3]
        motions[:, :3, 3] += by[:, 3:6]
        return replace(self, motions=motions, growth=self.growth + by[:, 6:].sum(axis=1))

    def applied(self, measurements: Measurements) -> Measurements:
        """Return what would have been measured, had it walked and nobody said so."""
        s = replace(measurements, centres=measurements.centres * np.exp(self.growth)[:, None])
        if self.of == "base":
            return replace(s, b=self.motions @ s.b)
        back = invert(self.motions)
        return replace(s, a=s.a @ back) if self.of == "camera" else replace(s, b=s.b @ back)

    def steps(self, walk: Walk) -> Floats:
        """Return the (N, s) steps that led here, each about its point."""
        before = np.concatenate([np.eye(4)[None], self.motions[:-1]])
        made = self.motions @ invert(before)
        shifts = (made[:, :3, :3] @ walk.about[..., None])[..., 0] + made[:, :3, 3] - walk.about
        growth = np.diff(self.growth, prepend=0.0)[:, None]
        out = np.concatenate([rotation_log(made[:, :3, :3]), shifts, growth], axis=1)
        return np.asarray(out[:, : walk.states])

"""What an estimate finds, and what measurements say of it near some values. Arrays only.

Unknown places are moved by (rotation, translation), ``R' = Exp(phi) R`` and ``t' = t + tau``, in
the parent's frame. The residual of a measurement is what takes the predicted target in the camera
to the measured one, in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from flangeye.handeye.components import FINEST, Noise
from flangeye.handeye.measurements import Seen
from flangeye.handeye.walk import Course
from flangeye.maths.geometry import rotation_exp
from flangeye.types import Floats


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Values of the unknowns.

    Attributes:
        places: (K, 4, 4) of what stands still.
        tilt: (2,) of all normals, about the target's x and y [rad].
        nuisance: (k,) of the arms.
        course: Where the base walked; None where it rests.
    """

    places: Floats
    tilt: Floats = field(default_factory=lambda: np.zeros(2))
    nuisance: Floats = field(default_factory=lambda: np.zeros(0))
    course: Course | None = None

    @classmethod
    def of_loop(cls, x: Floats, y: Floats, z: Floats) -> Unknowns:
        """Return the three of a loop A X M = Y B Z."""
        return cls(np.array([x, y, z]))

    @property
    def x(self) -> Floats:
        """(4, 4) camera carrier to camera, of a loop."""
        return np.asarray(self.places[0])

    @property
    def y(self) -> Floats:
        """(4, 4) second base in the first, of a loop."""
        return np.asarray(self.places[1])

    @property
    def z(self) -> Floats:
        """(4, 4) target in its carrier, of a loop."""
        return np.asarray(self.places[2])

    @property
    def of_places(self) -> int:
        """How many numbers move the places: the first of a step."""
        return 6 * len(self.places)

    @property
    def before_nuisance(self) -> int:
        """How many numbers of a step come before the nuisances': of places, and two of the tilt."""
        return self.of_places + 2

    def moved(self, step: Floats) -> Unknowns:
        """Return the unknowns moved by (6 K + 2 + k,)."""
        of_places, tilt, nuisance = np.split(step, [self.of_places, self.before_nuisance])
        turns, shifts = np.swapaxes(of_places.reshape(-1, 2, 3), 0, 1)
        places = self.places.copy()
        places[:, :3, :3] = rotation_exp(turns) @ places[:, :3, :3]
        places[:, :3, 3] += shifts
        return replace(
            self, places=places, tilt=self.tilt + tilt, nuisance=self.nuisance + nuisance
        )


@dataclass(frozen=True, eq=False)
class Linear:
    """What is predicted at some values of the unknowns.

    Attributes:
        residuals: (N, 6).
        jacobian: (N, 6, 6 K + 2 + k) of what is predicted.
        of_arms: (N, 6, 6) covariance that the arms' noise has in the camera; none if not stated.
        drift: (N, 6, s) of what is predicted by a motion of the base, and of the camera's scale;
            none where it rests.
    """

    residuals: Floats
    jacobian: Floats
    of_arms: Floats
    drift: Floats

    def where(self, chosen: NDArray[np.bool_]) -> Linear:
        """Return some of the measurements."""
        each = self.residuals, self.jacobian, self.of_arms, self.drift
        return Linear(*(of_all[chosen] for of_all in each))


def weights_of(seen: Seen, linear: Linear, noise: Noise) -> Floats:
    """Return the (N, 6, 6) inverse covariances, zero across what was not measured."""
    scale = np.repeat(np.sqrt([noise.normal_scale, noise.centre_scale]), 3)
    extra = np.diag(np.repeat([noise.tilt + FINEST**2, noise.pose + FINEST**2], 3))
    own = seen.covariances + noise.arms * linear.of_arms
    extra[5, 5] += noise.depth
    covariance = own * np.outer(scale, scale) + extra
    if seen.are_poses:
        return np.asarray(np.linalg.inv(covariance))
    p = seen.projectors
    return np.asarray(p @ np.linalg.inv(p @ covariance @ p + (np.eye(6) - p)) @ p)

"""What a solver knows, as arrays; and errors common to all poses that it may estimate along."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Observation

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Evidence:
    """N poses.

    Attributes:
        centres: (N, 3) circle centres in ``camera`` [m].
        centre_covariances: (N, 3, 3) in ``camera`` [m^2].
        normals: (N, 3) in ``camera``; NaN where none was measured.
        normal_covariances: (N, 3, 3) in ``camera``; NaN likewise.
        tcps: (N, 3) the same centres as the arm reports them, in ``base`` [m].
        flanges: (N, 3, 3) base_R_flange.
        levers: (N, 3) from the flange frame's origin to the centre that is seen, in ``base``:
            zero for the flange's own circle.
    """

    centres: Floats
    centre_covariances: Floats
    normals: Floats
    normal_covariances: Floats
    tcps: Floats
    flanges: Floats
    levers: Floats

    def __len__(self) -> int:
        return len(self.centres)

    @property
    def has_normal(self) -> Mask:
        """(N,) where a normal was measured."""
        return np.asarray(np.isfinite(self.normals[:, 0]))

    @property
    def axes(self) -> Floats:
        """(N, 3) the flange's axis in ``base``, outwards."""
        return self.flanges[:, :, 2]

    def where(self, mask: Mask) -> Evidence:
        """Return the poses of a mask."""
        return Evidence(
            self.centres[mask],
            self.centre_covariances[mask],
            self.normals[mask],
            self.normal_covariances[mask],
            self.tcps[mask],
            self.flanges[mask],
            self.levers[mask],
        )

    def without_normals(self, mask: Mask) -> Evidence:
        """Return the same poses, the normals of a mask left out."""
        return replace(self, normals=np.where(mask[:, None], np.nan, self.normals))


def evidence_of(observations: Sequence[Observation]) -> Evidence:
    """Collect observations into arrays."""
    circles = [o.circle for o in observations]
    none, no_covariance = np.full(3, np.nan), np.full((3, 3), np.nan)
    return Evidence(
        centres=np.array([c.centre for c in circles]),
        centre_covariances=np.array([c.covariance for c in circles]),
        normals=np.array([none if c.normal is None else c.normal for c in circles]),
        normal_covariances=np.array(
            [no_covariance if c.normal_covariance is None else c.normal_covariance for c in circles]
        ),
        tcps=np.array([o.tcp_in_base for o in observations]),
        flanges=np.array([o.base_T_flange.rotation for o in observations]),
        levers=np.array([o.tcp_in_base - o.base_T_flange.translation for o in observations]),
    )


@dataclass(frozen=True, eq=False)
class Nuisance:
    """k small numbers, common to all poses, that move where the flange is expected.

    Attributes:
        moves: (N, 3, k) displacement of the flange's centre in ``base`` by each.
        turns: (N, 3, k) rotation vector of the flange in ``base`` by each.
        prior: (k,) standard deviation known beforehand; infinite when nothing is known.
        mean: (k,) value expected beforehand.
    """

    moves: Floats
    turns: Floats
    prior: Floats
    mean: Floats

    def where(self, mask: Mask) -> Nuisance:
        """Return the effects on the poses of a mask."""
        return Nuisance(self.moves[mask], self.turns[mask], self.prior, self.mean)

    def and_also(self, other: Nuisance) -> Nuisance:
        """Return both sets of numbers, these first."""
        return Nuisance(
            np.concatenate([self.moves, other.moves], axis=2),
            np.concatenate([self.turns, other.turns], axis=2),
            np.concatenate([self.prior, other.prior]),
            np.concatenate([self.mean, other.mean]),
        )


def common_tilt(flanges: Floats, deviation: float) -> Nuisance:
    """Return a tilt of the face against the flange's axis, in two directions [rad].

    The plate's flatness, the zeros of the last joints and the scanner tilt all normals alike:
    many normals are together no better than that.
    """
    still = np.zeros((len(flanges), 3, 2))
    return Nuisance(still, flanges[:, :, :2], np.full(2, deviation), np.zeros(2))


def tool_offset(flanges: Floats) -> Nuisance:
    """Return an offset of the circle's centre from the flange frame's origin, in it [m]."""
    return Nuisance(flanges, np.zeros_like(flanges), np.full(3, np.inf), np.zeros(3))

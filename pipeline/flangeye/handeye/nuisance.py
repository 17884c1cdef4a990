"""Small numbers common to all poses that move the arms: errors of theirs, estimated along."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats, Mask


@dataclass(frozen=True, eq=False)
class Nuisance:
    """k small numbers.

    Attributes:
        camera: (N, 6, k) twist by each of the frame that carries the camera, in it.
        target: (N, 6, k) the same of the frame that carries the target.
        seen: (N, 6, k) by which each turns and moves what is predicted, in ``camera``.
        prior: (k,) standard deviation known beforehand; infinite where nothing is known.
        mean: (k,) value expected beforehand.
        sized: (k,) whether the prior is itself estimated, one for all that are.
        shared: (k,) whether it is an error that the features brought along.
    """

    camera: Floats
    target: Floats
    seen: Floats
    prior: Floats
    mean: Floats
    sized: Mask
    shared: Mask

    def __len__(self) -> int:
        return len(self.prior)

    def where(self, chosen: Mask | NDArray[np.intp]) -> Nuisance:
        """Return the effects on some of the poses."""
        effects = self.camera[chosen], self.target[chosen], self.seen[chosen]
        return Nuisance(*effects, self.prior, self.mean, self.sized, self.shared)

    def and_also(self, other: Nuisance) -> Nuisance:
        """Return both sets of numbers, these first."""
        return Nuisance(
            np.concatenate([self.camera, other.camera], axis=2),
            np.concatenate([self.target, other.target], axis=2),
            np.concatenate([self.seen, other.seen], axis=2),
            np.concatenate([self.prior, other.prior]),
            np.concatenate([self.mean, other.mean]),
            np.concatenate([self.sized, other.sized]),
            np.concatenate([self.shared, other.shared]),
        )

    def joined(self, other: Nuisance) -> Nuisance:
        """Return the same numbers, which move what the others' effects say as well."""
        return replace(
            self,
            camera=self.camera + other.camera,
            target=self.target + other.target,
            seen=self.seen + other.seen,
        )

    def without_sized(self) -> Nuisance:
        """Return those whose size is known."""
        kept = ~self.sized
        return Nuisance(
            self.camera[:, :, kept],
            self.target[:, :, kept],
            self.seen[:, :, kept],
            self.prior[kept],
            self.mean[kept],
            self.sized[kept],
            self.shared[kept],
        )

    def of_size(self, size: float) -> Nuisance:
        """Return the same, its sized numbers expected to be of a size."""
        return replace(self, prior=np.where(self.sized, size, self.prior))


def no_nuisance(count: int) -> Nuisance:
    """Return none, for so many poses."""
    return nuisance_of(np.zeros((count, 6, 0)), np.zeros((count, 6, 0)), 1.0)


def nuisance_seen(effects: Floats, deviation: float, shared: bool = False) -> Nuisance:
    """Return numbers of mean zero and one deviation by what each does to what is seen (N, 6, k)."""
    still = np.zeros_like(effects)
    return nuisance_of(still, still, deviation, seen=effects, shared=shared)


def nuisance_of(
    camera: Floats,
    target: Floats,
    deviation: float,
    sized: bool = False,
    seen: Floats | None = None,
    shared: bool = False,
) -> Nuisance:
    """Return numbers of mean zero and one deviation, from their (N, 6, k) effects."""
    k, seen = camera.shape[2], np.zeros_like(camera) if seen is None else seen
    kinds = np.full(k, sized), np.full(k, shared)
    return Nuisance(camera, target, seen, np.full(k, deviation), np.zeros(k), *kinds)

r"""Errors of a depth scanner that are the same at every pose: a smooth distortion, rounded edges.

Held-out poses do not show these errors, since they have them as well; only their size is known,
from the scanner's model. The distortion is a field of :mod:`flangeye.maths.arm_correction` over the
view (right, down, depth, each from -1 to 1), without the rigid motion nearest to it over the whole
volume: that part is where the camera is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from flangeye.estimation.effects.effect import Effect
from flangeye.estimation.graph import Linear, Problem, Sightings
from flangeye.maths.arm_correction import features, powers
from flangeye.models.scanners import ScannerModel
from flangeye.types import Floats
from flangeye.types.geometry import levers, stack_rows

TIMES = 1.1
"""Factor by which the true calibration error may differ from the file's, one sigma: data sheets
state it for every device of the type. Without this prior it would absorb errors of the arm."""


def scanner_effects(problem: Problem, scanner: ScannerModel | None) -> list[Effect]:
    """Return the scanner's distortion, and how it rounds the edges of circles."""
    seen = problem.seen
    effects = []
    if scanner is not None and seen.by_depth.any():
        effects.append(_distortion(scanner, seen))
    placed = all(problem.frames[target].place is not None for _, target in problem.ends)
    size = 0.0 if placed else _edge_size(seen)
    if size > 0:
        effects.append(Effect("rounded edges", _edges, size, TIMES, kind="scanner"))
    return effects


def _distortion(scanner: ScannerModel, seen: Sightings) -> Effect:
    field = DistortionField(scanner)
    moves = field.moves(seen) * seen.by_depth[:, None, None]
    # A turn counts like what it does so far away [m]
    scaled = moves * np.repeat([0.3, 1.0], 3)[:, None]
    _, sizes, ways = np.linalg.svd(stack_rows(scaled), full_matrices=False)
    # Combinations of weights that hardly move a session's targets are left out
    block = partial(_distorted, field, ways[sizes > 0.05 * sizes[0]].T)
    return Effect("scanner distortion", block, 1.0, TIMES, kind="scanner")


def _distorted(field: DistortionField, kept: Floats, problem: Problem, linear: Linear) -> Floats:
    s = problem.seen
    return np.asarray((field.moves(s) * s.by_depth[:, None, None]) @ kept)


def _edges(problem: Problem, linear: Linear) -> Floats:
    """Return (N, 6, 1): the shift of centres towards the camera's side of a tilted face.

    A scanner rounds an edge off if the wall behind it is in view, and cuts it off on the other
    side. So a tilted circle's centre lies too far from the camera's side, in proportion to the
    tilt. Only tilted views determine the distance of a circle of unknown place.
    """
    s = problem.seen
    out = np.zeros((len(s), 6, 1))
    out[:, 3:, 0] = _along(s) * (s.by_depth & (s.ranks == 5))[:, None]
    return out


def _along(s: Sightings) -> Floats:
    """Return (N, 3) the direction to the camera projected onto the face: as long as its tilt."""
    normals = s.rotations[:, :, 2]
    far = np.linalg.norm(s.centres, axis=1)
    to_camera = -s.centres / np.where(far > 0, far, 1.0)[:, None]
    return np.asarray(to_camera - (to_camera * normals).sum(axis=1)[:, None] * normals)


def _edge_size(s: Sightings) -> float:
    """Return the edge rounding [m]: the standard deviation that fits state for a tilted centre."""
    rows = s.by_depth & (s.ranks == 5)
    tilts = (_along(s)[rows] ** 2).sum()
    # All face the camera to a milliradian: seen alike
    if not rows.any() or tilts <= 1e-3**2 * rows.sum():
        return 0.0
    own, normals = s.covariances[rows, 3:, 3:], s.rotations[rows, :, 2]
    across = np.einsum("na,nab,nb->n", normals, own, normals)
    return float(np.sqrt((np.trace(own, axis1=1, axis2=2) - across).sum() / tilts))


@dataclass(frozen=True)
class DistortionField:
    """A scanner's distortion field, linear in weights of unit variance."""

    scanner: ScannerModel

    @property
    def _depths(self) -> tuple[float, float]:
        """Middle and half width of the range of depths [m]."""
        near, far = self.scanner.range
        return (near + far) / 2, (far - near) / 2

    @property
    def _slopes(self) -> Floats:
        return np.tan(np.array(self.scanner.field_of_view) / 2)

    @cached_property
    def _over_volume(self) -> tuple[Floats, float]:
        """Return the rigid part (6, K) of each basis field, and the factor to the file's error.

        The rigid part is not a distortion: it only moves the camera. Without it, the field is
        scaled to the calibration error [m] of the scanner's file.
        """
        middle, half = self._depths
        grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 7)] * 3), axis=-1).reshape(-1, 3)
        depths = middle + half * grid[:, 2:]
        points = np.concatenate([grid[:, :2] * self._slopes * depths, depths], axis=1)
        raw, motions = self._raw(points), self._motions(points)
        rigid = np.linalg.lstsq(stack_rows(motions), stack_rows(raw), rcond=None)[0]
        bent = raw - motions @ rigid
        rms = float(np.sqrt((bent**2).sum(axis=(1, 2)).mean()))
        return np.asarray(rigid), self.scanner.calibration_error / rms

    def moves(self, s: Sightings) -> Floats:
        """Return the (N, 6, K) turns and shifts of targets by each unit weight, in ``camera``."""
        across, along, normals = (s.rotations[:, :, i] for i in range(3))
        radius = 30e-3  # to each side of a target [m]: a flange's radius
        bent = [(self.at(s.centres + radius * t) - self.at(s.centres - radius * t))
                / (2 * radius) for t in (across, along)]  # fmt: skip
        # A plate takes the field's gradient over it: its normal tilts by the rise along its two
        # axes, and it rolls by half the curl
        rising = [np.einsum("ni,nik->nk", normals, each)[:, None] for each in bent]
        turning = np.einsum("ni,nik->nk", along, bent[0]) - np.einsum("ni,nik->nk", across, bent[1])
        turned = (
            across[..., None] * rising[1]
            - along[..., None] * rising[0]
            + normals[..., None] * turning[:, None] / 2
        )
        return np.concatenate([turned, self.at(s.centres)], axis=1)

    def at(self, points: Floats) -> Floats:
        """Return displacements (N, 3, K) [m] of points (N, 3) of the view for each unit weight."""
        rigid, scale = self._over_volume
        return np.asarray(scale * (self._raw(points) - self._motions(points) @ rigid))

    def _raw(self, points: Floats) -> Floats:
        middle, half = self._depths
        rays = points / points[:, 2:]
        view = np.concatenate([rays[:, :2] / self._slopes, (points[:, 2:] - middle) / half], axis=1)
        # Where two rays cross that are equally uncertain, what is across them is better known than
        # what is along, in the ratio of the baseline to the root of two squared distances.
        across = np.eye(3)[:, :2] * min(self.scanner.baseline / middle / np.sqrt(2), 1.0)
        ways = np.concatenate(
            [rays[..., None], np.broadcast_to(across, (len(points), 3, 2))], axis=2
        )
        # A calibrated scanner bends its volume once or twice, and has no ripples.
        columns = features(view, powers(3))[:, None, :, None] * ways[:, :, None, :]
        return np.asarray(columns.reshape(len(points), 3, -1))

    def _motions(self, points: Floats) -> Floats:
        return levers(points - np.array([0.0, 0.0, self._depths[0]]))

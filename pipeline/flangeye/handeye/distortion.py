"""What a scanner's own smooth distortion does to what it measured. Arrays only.

It is the same at every pose, so that neither residuals nor poses held out show it: only its size is
known, by the scanner's model, and what it may do belongs into the covariance. The field
is that of :mod:`flangeye.maths.smooth_field` over the view (right, down, depth, each from -1 to 1),
without the rigid motion nearest to it over the whole volume: that part is where the camera is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from flangeye.handeye.measurements import Measurements
from flangeye.handeye.nuisance import Nuisance, no_nuisance, nuisance_of
from flangeye.maths.geometry import hat, stack_rows
from flangeye.maths.smooth_field import features
from flangeye.models.scanners import ScannerModel
from flangeye.types import Floats, Mask

POWERS = tuple(p for p in product(range(4), repeat=3) if sum(p) <= 3)
"""A scanner that was calibrated bends its volume once or twice, and has no ripples."""
GRID = np.stack(np.meshgrid(*[np.linspace(-1, 1, 7)] * 3), axis=-1).reshape(-1, 3)
"""The view, evenly."""
RADIUS = 30e-3
"""A target is turned by what it is bent over so much to each side [m]."""
NEGLIGIBLE = 0.05
"""Ways to move the targets of a session that are, by their rms, this share of the largest."""
LEAST_TILT = 1e-3
"""Circles that all face the camera to this [rad] are seen alike."""
LEVER = 0.3
"""A turn counts like what it does so far away [m]."""


def distortion_of(scanner: ScannerModel, measurements: Measurements, seen: Mask) -> Nuisance:
    """Return the few ways in which a distortion moves the targets of a session.

    Args:
        scanner: Says how large it is (``calibration_error``).
        measurements: N of them.
        seen: (N,) which were measured by the scanner's depth.
    """
    moves = _Field(scanner).moves(measurements) * seen[:, None, None]
    scaled = moves * np.repeat([LEVER, 1.0], 3)[:, None]
    _, sizes, ways = np.linalg.svd(stack_rows(scaled), full_matrices=False)
    kept = ways[sizes > NEGLIGIBLE * sizes[0]].T
    still = np.zeros((len(measurements), 6, kept.shape[1]))
    return nuisance_of(still, still, 1.0, seen=moves @ kept)


def edges_of(measurements: Measurements, seen: Mask) -> Nuisance:
    """Return how the centres of circles may move all alike with the view of them.

    Where the wall behind an edge is in view, a scanner rounds the edge off; on the other side it
    breaks off. So a centre lies too far from the camera's side, by the more the more the face is
    tilted. Tilting also is what tells how far away a circle is whose place is unknown: no residual
    shows the one in the other. The size is what the fits state of their centres in the face, as if
    all of it were this.

    Args:
        measurements: N of them.
        seen: (N,) which were measured by the scanner's depth.
    """
    s, seen = measurements, seen & measurements.has_normal
    normals, to_camera = s.rotations[:, :, 2], -s.centres
    to_camera = to_camera / np.linalg.norm(to_camera, axis=1)[:, None]
    along = to_camera - (to_camera * normals).sum(axis=1)[:, None] * normals
    own = s.covariances[:, 3:, 3:]
    across = np.einsum("na,nab,nb->n", normals, own, normals)
    in_face = np.trace(own, axis1=1, axis2=2) - across
    tilts = (along[seen] ** 2).sum()
    if tilts <= LEAST_TILT**2 * seen.sum():  # centres without a face, too
        return no_nuisance(len(s))
    size = float(np.sqrt(in_face[seen].sum() / tilts))
    moves = np.zeros((len(s), 6, 1))
    moves[seen, 3:, 0] = along[seen]
    still = np.zeros_like(moves)
    return nuisance_of(still, still, size, seen=moves)


@dataclass(frozen=True)
class _Field:
    """A field of the scanner's size, linear in weights of unit variance."""

    scanner: ScannerModel

    @property
    def _depths(self) -> tuple[float, float]:
        """Middle of the range, and half of it [m]."""
        near, far = self.scanner.range
        return (near + far) / 2, (far - near) / 2

    @property
    def _slopes(self) -> Floats:
        return np.tan(np.array(self.scanner.field_of_view) / 2)

    @cached_property
    def _over_volume(self) -> tuple[Floats, float]:
        """Return the rigid motions (6, K) nearest to each weight's, and the scale to the size."""
        middle, half = self._depths
        depths = middle + half * GRID[:, 2:]
        points = np.concatenate([GRID[:, :2] * self._slopes * depths, depths], axis=1)
        raw, motions = self._raw(points), self._motions(points)
        rigid = np.linalg.lstsq(stack_rows(motions), stack_rows(raw), rcond=None)[0]
        bent = raw - motions @ rigid
        rms = float(np.sqrt((bent**2).sum(axis=(1, 2)).mean()))
        return np.asarray(rigid), self.scanner.calibration_error / rms

    def moves(self, s: Measurements) -> Floats:
        """Return (N, 6, K): how each weight turns and moves a target, in ``camera``."""
        across, along, normals = (s.rotations[:, :, i] for i in range(3))
        bent = [(self._at(s.centres + RADIUS * t) - self._at(s.centres - RADIUS * t))
                / (2 * RADIUS) for t in (across, along)]  # fmt: skip
        rising = [np.einsum("ni,nik->nk", normals, each)[:, None] for each in bent]
        turning = np.einsum("ni,nik->nk", along, bent[0]) - np.einsum("ni,nik->nk", across, bent[1])
        turned = (
            across[..., None] * rising[1]
            - along[..., None] * rising[0]
            + normals[..., None] * turning[:, None] / 2
        )
        return np.concatenate([turned, self._at(s.centres)], axis=1)

    def _at(self, points: Floats) -> Floats:
        """Return (N, 3, K) by how much each weight moves points (N, 3) of the view [m]."""
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
        columns = features(view, POWERS)[:, None, :, None] * ways[:, :, None, :]
        return np.asarray(columns.reshape(len(points), 3, -1))

    def _motions(self, points: Floats) -> Floats:
        about = points - np.array([0.0, 0.0, self._depths[0]])
        still = np.broadcast_to(np.eye(3), (len(points), 3, 3))
        return np.concatenate([-hat(about), still], axis=2)

"""Coarse search for a part in a scan with clutter and occlusion.

Pairs of oriented points that are alike on the scan and on the CAD (Drost et al. 2010) each give a
pose of the part; every pose is then held against what the scanner saw along its rays, for and
against. No order of the points, no table and no upright part is assumed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats
from flangeye_plugins.seam.part import CadPart
from flangeye_plugins.seam.points import DepthMap, Oriented, spread_over_normals

Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Candidates:
    """Poses (K, 4, 4) ``camera_T_part`` and how well each agrees with the scan, best first."""

    poses: Floats
    scores: Floats


@dataclass(frozen=True, eq=False)
class SeamModel:
    """Samples of a part: points that a scan should show, and points where there is nothing.

    Attributes:
        surface: Samples of the CAD, normals outwards.
        beyond: Points where its faces have ended, with the normals of those faces.
    """

    surface: Oriented
    beyond: Oriented

    def thinned(self, count: int, rng: np.random.Generator) -> SeamModel:
        """Return ``count`` of either."""
        return SeamModel(
            self.surface.take(rng.permutation(len(self.surface))[:count]),
            self.beyond.take(rng.permutation(len(self.beyond))[:count]),
        )


def model_of(part: CadPart, rng: np.random.Generator, by: float) -> SeamModel:
    """Return samples of a part, with empty points ``by`` [m] beyond its edges."""
    return SeamModel(part.sample(rng), part.beyond_edges(rng, by))


def find_poses(
    scan: Oriented, part: CadPart, seen: DepthMap, rng: np.random.Generator
) -> Candidates:
    """Return distinct candidates for ``camera_T_part``.

    Args:
        scan: Thinned, normals towards the camera, in ``camera``.
        part: The CAD.
        seen: The whole scan.
        rng: Draws the points and pairs.
    """
    size = part.diagonal
    # How far the scan may be from a pose of the part, along a ray, as a share of the diagonal.
    tolerance = 0.02
    model = model_of(part, rng, 1.5 * tolerance * size)
    points = 700  # that pairs are made of, on the scan and on the CAD
    spread = spread_over_normals(scan, points, rng)
    poses = _hypotheses(spread, spread_over_normals(model.surface, points, rng), size, rng)
    # Samples of the CAD a pose is judged by, at first
    scores = agreement(poses, model.thinned(100, rng), seen, tolerance * size)
    poses = poses[_distinct(Candidates(poses, scores), size)]
    # And for the best
    scores = agreement(poses, model.thinned(1000, rng), seen, tolerance * size)
    order = np.argsort(-scores, kind="stable")
    return Candidates(poses[order], scores[order])


def agreement(poses: Floats, model: SeamModel, seen: DepthMap, tolerance: float) -> Floats:
    """Return (K,) scores: share of expected points seen, less contradictions.

    Args:
        poses: (K, 4, 4) ``camera_T_part``.
        model: What the part should look like.
        seen: The scan.
        tolerance: Along a ray [m].
    """
    near, through = shares(poses, model.surface, seen, tolerance)
    going_on, _ = shares(poses, model.beyond, seen, tolerance)
    return np.asarray(near - through - going_on)


def shares(
    poses: Floats, surface: Oriented, seen: DepthMap, tolerance: float
) -> tuple[Floats, Floats]:
    """Return (K,) shares of the surface towards the scanner that were seen, and refuted."""
    if not len(surface):
        return np.zeros(len(poses)), np.zeros(len(poses))
    # Points that are looked at at once
    chunk = max(1, 400_000 // len(surface))
    parts = [
        _shares(poses[i : i + chunk].astype(np.float32), surface, seen, tolerance)
        for i in range(0, len(poses), chunk)
    ]
    near, through = np.concatenate([np.zeros((2, 0)), *parts], axis=1)
    return near, through


def _shares(
    poses: NDArray[np.float32], surface: Oriented, seen: DepthMap, tolerance: float
) -> Floats:
    turns = poses[:, :3, :3].transpose(0, 2, 1)
    points = surface.points.astype(np.float32) @ turns + poses[:, None, :3, 3]
    normals = surface.normals.astype(np.float32) @ turns
    lengths = np.linalg.norm(points, axis=2)
    # The steepest incidence at which a surface is expected to be seen
    facing = -np.einsum("kmi,kmi->km", points, normals) > 0.3 * lengths
    # What looks away is put where no ray goes.
    points[~facing] = [1e3, 0.0, 1.0]
    near, through = seen.evidence(points, tolerance)
    return np.asarray(np.stack([near, through]) / np.maximum(facing.mean(axis=1), 1e-6))


def _hypotheses(scan: Oriented, model: Oriented, size: float, rng: np.random.Generator) -> Floats:
    """Return (K, 4, 4) poses that lay a pair of the CAD on a pair of the scan."""
    i, j = _pairs(scan, size)
    scan_pairs = 6000
    chosen = rng.permutation(len(i))[:scan_pairs]
    i, j = i[chosen], j[chosen]
    k, m = _pairs(model, size)
    first, second = _alike(_keys(scan, i, j, size), _keys(model, k, m, size), rng)
    scan_frames = _frames(scan, i[first], j[first])
    model_frames = _frames(model, k[second], m[second])
    return _fit(scan_frames, model_frames)


def _pairs(surface: Oriented, size: float) -> tuple[Ints, Ints]:
    """Return indices of the ordered pairs that say something about a pose."""
    points, normals = surface.points, surface.normals
    squares = (points**2).sum(axis=1)
    apart = np.sqrt(np.maximum(squares[:, None] + squares - 2 * points @ points.T, 0.0))
    # A pair is at least this share of the part's diagonal apart: closer ones give no direction
    shortest = 0.12
    good = (apart > shortest * size) & (apart < size)
    # The normals of a pair differ by this at least: pairs on one plane say nothing
    turned = float(np.radians(20))
    good &= normals @ normals.T < np.cos(turned)
    i, j = np.nonzero(good)
    return i, j


def _features(surface: Oriented, i: Ints, j: Ints) -> tuple[Floats, Floats]:
    """Return (P,) distances and (P, 3) angles: of both normals to the line, and between them."""
    line = surface.points[j] - surface.points[i]
    length = np.linalg.norm(line, axis=1)
    line = line / length[:, None]
    cosines = np.stack(
        [
            np.einsum("ni,ni->n", surface.normals[i], line),
            np.einsum("ni,ni->n", surface.normals[j], line),
            np.einsum("ni,ni->n", surface.normals[i], surface.normals[j]),
        ],
        axis=1,
    )
    return length, np.arccos(np.clip(cosines, -1.0, 1.0))


def _keys(surface: Oriented, i: Ints, j: Ints, size: float) -> Ints:
    length, angles = _features(surface, i, j)
    bins = np.column_stack([length / size * 40, angles / float(np.radians(12))]).astype(int)
    return np.asarray(bins @ [1_000_000, 10_000, 100, 1])


def _alike(scan: Ints, model: Ints, rng: np.random.Generator) -> tuple[Ints, Ints]:
    """Return indices of pairs of equal key, at most ``MATCHES`` for each of the scan."""
    order = rng.permutation(len(model))
    order = order[np.argsort(model[order], kind="stable")]
    start = np.searchsorted(model[order], scan, "left")
    # Pairs of the CAD that are tried for a pair of the scan
    count = np.minimum(np.searchsorted(model[order], scan, "right") - start, 16)
    first = np.repeat(np.arange(len(scan)), count)
    within = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
    return first, order[np.repeat(start, count) + within]


def _frames(surface: Oriented, i: Ints, j: Ints) -> Floats:
    """Return (P, 4, 4): origin amid the pair, x along it, z as the normals lean across it."""
    a, b = surface.points[i], surface.points[j]
    x = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    # Unequal weights: the normals of a groove's walls would cancel.
    lean = surface.normals[i] + 0.618 * surface.normals[j]
    z = lean - np.einsum("ni,ni->n", lean, x)[:, None] * x
    z /= np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-9)
    frames = np.tile(np.eye(4), (len(i), 1, 1))
    frames[:, :3, 0], frames[:, :3, 1], frames[:, :3, 2] = x, np.cross(z, x), z
    frames[:, :3, 3] = (a + b) / 2
    return frames


def _fit(scan: Floats, model: Floats) -> Floats:
    """Return the poses that take the model's frames onto the scan's."""
    rotation = scan[:, :3, :3] @ model[:, :3, :3].transpose(0, 2, 1)
    out = np.tile(np.eye(4), (len(scan), 1, 1))
    out[:, :3, :3] = rotation
    out[:, :3, 3] = scan[:, :3, 3] - np.einsum("nij,nj->ni", rotation, model[:, :3, 3])
    return out


def _distinct(found: Candidates, size: float) -> Ints:
    """Return the indices of the best of each group of poses that are nearly one, best first."""
    order = np.argsort(-found.scores, kind="stable")
    kept: list[int] = []
    while len(order) and len(kept) < 40:
        best = order[0]
        kept.append(int(best))
        order = order[~_near(found.poses[best], found.poses[order], size)]
    return np.array(kept, dtype=np.intp)


def _near(pose: Floats, others: Floats, size: float) -> NDArray[np.bool_]:
    traces = np.einsum("ij,kij->k", pose[:3, :3], others[:, :3, :3])
    shifts = np.linalg.norm(others[:, :3, 3] - pose[:3, 3], axis=1)
    # One pose, where they differ by less in angle, and in place as a share of the diagonal
    return np.asarray((traces > 1 + 2 * np.cos(float(np.radians(6)))) & (shifts < 0.03 * size))

"""Scans of welded joints by a ray caster of its own: convex plates, a pinhole camera, its faults.

Plates are intersections of half-spaces; a ray meets one where it enters the last of them. Nothing here
is shared with what finds the seam, nor with the emulators.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

MM = 1e-3
LENGTH, WIDE = 0.12, 0.06
"""Of the plates, along and across the seam, from it [m]."""


@dataclass
class Plate:
    """A convex body: points with ``normals @ p <= offsets``."""

    normals: np.ndarray
    offsets: np.ndarray

    def meet(self, origins, directions):
        """Return how far along each ray the body is entered, and the normal there."""
        # A row for each face: along a column of few numbers NumPy is ten times slower.
        rate = np.ascontiguousarray((directions @ self.normals.T).T)
        away = np.ascontiguousarray((self.offsets - np.atleast_2d(origins) @ self.normals.T).T)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = away / rate
        enter = np.where(rate < 0, at, -np.inf)
        leave = np.where(rate > 0, at, np.inf)
        outside = ((rate == 0) & (away < 0)).any(axis=0)
        first, normals = enter.max(axis=0), np.zeros(directions.shape)
        hit = (first < leave.min(axis=0)) & (first > 1e-6) & ~outside
        normals[hit] = self.normals[enter[:, hit].argmax(axis=0)]
        return np.where(hit, first, np.inf), normals

    def moved(self, pose):
        normals = self.normals @ pose[:3, :3].T
        return Plate(normals, self.offsets + normals @ pose[:3, 3])


def prism(section, start=-LENGTH / 2, end=LENGTH / 2):
    """Return a convex section (K, 2) of y and z, given anticlockwise, drawn along x."""
    section = np.asarray(section, float)
    step = np.roll(section, -1, axis=0) - section
    outwards = np.column_stack([0 * step[:, 0], step[:, 1], -step[:, 0]])
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    offsets = np.einsum("ki,ki->k", outwards[:, 1:], section)
    normals = np.vstack([outwards, [[1, 0, 0], [-1, 0, 0]]])
    return Plate(normals, np.concatenate([offsets, [end, -start]]))


def box(low, high):
    eye = np.eye(3)
    return Plate(np.vstack([eye, -eye]), np.concatenate([high, -np.asarray(low)]))


def _rect(low_y, low_z, high_y, high_z):
    return [(low_y, low_z), (high_y, low_z), (high_y, high_z), (low_y, high_z)]


def plates_of(joint, rng):
    """Return the plates of a joint whose seam is the x axis, z out of it, and the seam's two ends."""
    t = rng.uniform(6, 12) * MM
    short = rng.uniform(-50, -40) * MM, rng.uniform(40, 50) * MM
    full = -LENGTH / 2, LENGTH / 2
    if joint in ("vee", "bevel"):
        lean = [np.tan(np.radians(rng.uniform(25, 40))) for _ in range(2)]
        lean = [0.0, np.tan(np.radians(rng.uniform(35, 50)))] if joint == "bevel" else lean
        left = [(-WIDE, 0), (0, 0), (-t * lean[0], t), (-WIDE, t)]
        right = [(0, 0), (WIDE, 0), (WIDE, t), (t * lean[1], t)]
        return [prism(left), prism(right)], full
    if joint == "butt":
        gap = rng.uniform(1.2, 3.0) * MM
        return [prism(_rect(-WIDE, -t, -gap / 2, 0)), prism(_rect(gap / 2, -t, WIDE, 0))], full
    if joint == "lap":
        t = rng.uniform(3, 8) * MM
        upper = prism(_rect(-WIDE, 0, 0, t), *short)
        return [upper, prism(_rect(-WIDE, -t, WIDE, 0))], short
    if joint == "fillet":
        height = rng.uniform(30, 50) * MM
        return [prism(_rect(-t, 0, 0, height), *short), prism(_rect(-WIDE, -t, WIDE, 0))], short
    down = prism(_rect(-WIDE, 0, 0, t))  # the corner, open: the edges meet at the root
    return [down, prism(_rect(0, -WIDE, t, 0))], full


@dataclass
class Scan:
    """Points (N, 3) in ``camera``, the pose of the joint there, and the seam (2, 3) there."""

    points: np.ndarray
    camera_T_joint: np.ndarray
    seam: np.ndarray
    bodies: list = field(default_factory=list)


TURNS = {"corner": 45.0, "fillet": 45.0, "lap": 15.0}
"""By how much the joint's z leans away from where the scanner stands best [deg]."""


def scan_of(joint, seed, pitch=0.35 * MM, noise=0.08 * MM, faults=True, plates=None, tilt=25.0):
    """Return one scan of a joint, at a random place before the camera, up to ``tilt`` askew.

    Faults: 10 % of the pixels and some patches missing, mixed pixels at edges, second bounces of a
    polished joint, patches that are off, and blocks that lie about, some of them on the seam.
    """
    rng = np.random.default_rng([seed, sorted(JOINTS).index(joint) if joint in JOINTS else 99])
    plates, ends = plates or plates_of(joint, rng)
    distance = rng.uniform(0.5, 0.8)
    pose = _pose(rng, TURNS.get(joint, 0.0), distance, tilt)
    clutter = _clutter(rng) if faults else []
    bodies = [plate.moved(pose) for plate in [*plates, *clutter]]
    rays, shape = _rays(0.1 / distance, pitch / distance)
    depth, normals = _first(bodies, np.zeros(3), rays)
    # The bench lies behind the part.
    depth = np.minimum(depth, (distance + 0.12) / rays[:, 2])
    if faults:
        depth = _faulty(depth, rays, normals, bodies, shape, rng)
    depth = depth + noise * _grain(rng, shape)
    depth = depth[keep := np.isfinite(depth)]
    seam = np.array([[ends[0], 0, 0], [ends[1], 0, 0]]) @ pose[:3, :3].T + pose[:3, 3]
    return Scan(depth[:, None] * rays[keep], pose, seam, bodies)


def seen_by(bodies, pitch, half=0.12, noise=0.08 * MM, seed=0):
    """Return what a camera at the origin sees of bodies, without faults; pitch and half of a ray."""
    rays, _ = _rays(half, pitch)
    depth = _first(bodies, np.zeros(3), rays)[0]
    depth = depth + noise * np.random.default_rng(seed).normal(size=len(depth))
    kept = np.isfinite(depth)
    return depth[kept, None] * rays[kept]


def _rays(half, pitch):
    """Return unit rays (N, 3) through a square image, and the image's shape."""
    ticks = np.arange(-half, half, pitch)
    x, y = np.meshgrid(ticks, ticks)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), x.shape


JOINTS = ("vee", "bevel", "butt", "lap", "fillet", "corner")


def _pose(rng, turn, distance, tilt):
    """Return camera_T_joint: z towards the camera but for ``turn`` about x and a random tilt."""
    upright = Rotation.from_euler("x", np.pi)
    lean = Rotation.from_euler("XYX", [*rng.uniform(-tilt, tilt, 2), turn], degrees=True)
    spin = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi))
    pose = np.eye(4)
    pose[:3, :3] = (spin * upright * lean).as_matrix()
    pose[:3, 3] = [rng.uniform(-0.02, 0.02), rng.uniform(-0.02, 0.02), distance]
    return pose


def _clutter(rng):
    """Return blocks that lie about: four somewhere, one across a part of the seam."""
    out = []
    for place in range(5):
        size = rng.uniform(3, 10, 3) * MM
        x = rng.uniform(-0.05, 0.05)
        y = rng.uniform(8, 50) * MM * rng.choice([-1, 1]) if place else rng.uniform(-4, 4) * MM
        z = rng.uniform(0, 8) * MM
        out.append(box([x, y, z] - size / 2, [x, y, z] + size / 2))
    return out


def _first(bodies, origin, rays):
    depth, normals = np.full(len(rays), np.inf), np.zeros((len(rays), 3))
    for body in bodies:
        at, normal = body.meet(origin, rays)
        nearer = at < depth
        depth = np.where(nearer, at, depth)
        normals[nearer] = normal[nearer]
    return depth, normals


def _faulty(depth, rays, normals, bodies, shape, rng):
    depth = depth.copy()
    points = depth[:, None] * rays
    # A second bounce: what is polished shows what it mirrors, as far away as light went.
    slant = np.einsum("ni,ni->n", rays, normals)
    mirrored = rays - 2 * slant[:, None] * normals
    shiny = _patches(rng, shape, 6, 4) & (slant < 0)
    with np.errstate(invalid="ignore"):
        second, _ = _first(bodies, points[shiny] - 1e-6 * rays[shiny], mirrored[shiny])
    shown = np.flatnonzero(shiny)[np.isfinite(second) & (second < 0.1)]
    depth[shown] += second[np.isfinite(second) & (second < 0.1)]
    # Highlights: smooth patches that are off by up to a millimetre.
    for _ in range(2):
        depth[_patches(rng, shape, 1, 4)] += rng.normal(0, 0.7 * MM)
    # Mixed pixels: half of those beside a jump are somewhere between its two sides.
    grid = depth.reshape(shape)
    beside = np.roll(grid, 1, axis=int(rng.integers(2)))
    with np.errstate(invalid="ignore"):
        jump = (np.abs(beside - grid) > 1 * MM) & (rng.random(shape) < 0.5)
    share = rng.random(shape)
    grid = np.where(jump, share * grid + (1 - share) * beside, grid)
    grid[(rng.random(shape) < 0.1) | _patches(rng, shape, 8, 4).reshape(shape)] = np.inf
    return grid.ravel()


def _patches(rng, shape, count, radius):
    """Return a mask of discs of up to ``radius`` [mm at a pitch of 0.35 mm] anywhere in the image."""
    rows, columns = np.indices(shape)
    out = np.zeros(shape, bool)
    for _ in range(count):
        r, c = rng.uniform(0.2, 0.8, 2) * shape
        out |= (rows - r) ** 2 + (columns - c) ** 2 < (rng.uniform(1, radius) / 0.35) ** 2
    return out.ravel()


def _grain(rng, shape):
    """Return noise of unit size: half of its power shared by neighbouring pixels."""
    white = rng.normal(size=(2, *shape))
    smooth = sum(np.roll(white[0], (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 3
    return ((smooth + white[1]) / np.sqrt(2)).ravel()

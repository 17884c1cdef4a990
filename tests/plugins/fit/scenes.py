"""Flange faces as point clouds, made by hand: every answer is known."""

import numpy as np

from flangeye.models.loading import load_model
from flangeye.models.targets import Flange, flange_of, load_standard
from flangeye.types import CAMERA, FlangeCloud, PointCloud
from flangeye.types.geometry import basis_of_plane

CENTRE = np.array([0.05, -0.03, 0.7])
NORMAL = np.array([0.2, -0.1, -1.0]) / np.linalg.norm([0.2, -0.1, -1.0])


def flange(robot: str = "ur5", standard: str = "50-4-M6") -> Flange:
    """Return a robot's flange."""
    return flange_of(load_model("robots", robot).flange, load_standard(standard))


def face(
    model: Flange,
    arc: float = 2 * np.pi,
    noise: float = 5e-5,
    pitch: float = 0.35e-3,
    seed: int = 0,
    stray: int = 0,
) -> np.ndarray:
    """Return (N, 3) points of the face in its own plane, seen over ``arc``, with depth noise."""
    rng = np.random.default_rng(seed)
    ticks = np.arange(-model.outer, model.outer, pitch)
    x, y = (a.ravel() for a in np.meshgrid(ticks, ticks))
    x, y = x + rng.uniform(0, pitch, x.size), y + rng.uniform(0, pitch, y.size)
    radius, angle = np.hypot(x, y), np.arctan2(y, x) % (2 * np.pi)
    keep = (radius < model.rim) & (radius > (model.bore or 0)) & (angle <= arc)
    pin = model.pin
    openings = [*((a, model.hole) for a in model.holes), (pin, model.pin_hole)] if pin else []
    for turn, size in openings:
        at = model.pitch * np.array([np.cos(turn), np.sin(turn)])
        keep &= np.hypot(x - at[0], y - at[1]) > size
    flat = np.stack([x[keep], y[keep], rng.normal(0, noise, keep.sum())], axis=1)
    outside = rng.uniform(-1.3, 1.3, (stray, 3)) * [model.outer, model.outer, 5e-3]
    return np.concatenate([flat, outside])


def placed(points: np.ndarray, centre=CENTRE, normal=NORMAL) -> FlangeCloud:
    """Return the face as a scanner sees it, its rough centre 2 mm and its normal 1 degree off."""
    xyz = centre + points @ basis_of_plane(normal)
    rough = normal + 0.0175 * basis_of_plane(normal)[0]
    return FlangeCloud(
        PointCloud(CAMERA, xyz.astype(np.float32)),
        centre + np.array([1e-3, -1e-3, 1e-3]),
        rough / np.linalg.norm(rough),
    )

"""Scenes cast by hand, pixel by pixel: tables, flanges and things that are not quite flanges."""

from collections.abc import Callable

import numpy as np

from flangeye.models.targets import Flange
from flangeye.types import BASE, CAMERA, FLANGE, Capture, PointCloud, Transform, by_frame
from flangeye.types.geometry import basis_of_plane

CENTRE = np.array([0.05, -0.04, 0.6])
ASIDE = np.array([-0.1, 0.08, 0.65])


def towards_scanner(centre=CENTRE, tilt=0.3) -> np.ndarray:
    """Return the unit normal of something at ``centre``, ``tilt`` off the line of sight [rad]."""
    sight = -centre / np.linalg.norm(centre)
    return np.cos(tilt) * sight + np.sin(tilt) * basis_of_plane(sight)[0]


class Scene:
    """What a pinhole scanner sees; the nearest surface wins in every pixel."""

    def __init__(self, columns: int = 400, rows: int = 300, pitch: float = 1e-3) -> None:
        u = (np.arange(columns) - columns / 2) * pitch / 0.6
        v = (np.arange(rows) - rows / 2) * pitch / 0.6
        self.rays = np.ones((rows, columns, 3))
        self.rays[..., 0], self.rays[..., 1] = u, v[:, None]
        self.depth = np.full((rows, columns), np.inf)

    def plane(self, centre, normal, inside: Callable = lambda flat: True) -> "Scene":
        """Add the part of a plane whose coordinates about ``centre`` are ``inside``."""
        depth = (normal @ centre) / (self.rays @ normal)
        flat = (depth[..., None] * self.rays - centre) @ basis_of_plane(normal)[:2].T
        seen = np.where(inside(flat) & (depth > 0), depth, np.inf)
        self.depth = np.minimum(self.depth, seen)
        return self

    def table(self, depth: float = 0.9) -> "Scene":
        """Add a plane that fills the view."""
        return self.plane(np.array([0, 0, depth]), np.array([0.05, 0.03, -1.0]))

    def ring(self, inner, outer, centre=ASIDE, normal=None, holes=()) -> "Scene":
        """Add a flat ring with round holes, each (x, y, radius)."""

        def inside(flat):
            radius = np.hypot(flat[..., 0], flat[..., 1])
            keep = (radius >= inner) & (radius <= outer)
            for x, y, size in holes:
                keep &= np.hypot(flat[..., 0] - x, flat[..., 1] - y) > size
            return keep

        return self.plane(centre, towards_scanner(centre) if normal is None else normal, inside)

    def flange(self, model: Flange, centre=CENTRE, normal=None) -> "Scene":
        """Add a flange's face, the wrist behind it, and the floor of the bore."""
        normal = towards_scanner(centre) if normal is None else normal
        assert model.pin is not None
        places = [(angle, model.hole) for angle in model.holes] + [(model.pin, model.pin_hole)]
        holes = [(model.pitch * np.cos(a), model.pitch * np.sin(a), size) for a, size in places]
        behind = centre - model.details.thickness * normal
        self.ring(0.0, model.details.wrist / 2, behind, normal)
        return self.ring(model.bore, model.rim, centre, normal, holes)

    def scan(self, noise: float = 5e-5, missing: float = 0.0, seed: int = 0) -> np.ndarray:
        """Return (H, W, 3) points [m], NaN where nothing is seen."""
        rng = np.random.default_rng(seed)
        depth = np.where(np.isfinite(self.depth), self.depth, np.nan)
        depth = depth + rng.normal(0, noise, depth.shape)
        depth[rng.random(depth.shape) < missing] = np.nan
        return (depth[..., None] * self.rays).astype(np.float32)


def capture(xyz: np.ndarray) -> Capture:
    """Return points as a capture."""
    return Capture("0007", PointCloud(CAMERA, xyz), by_frame(Transform(BASE, FLANGE, np.eye(4))))

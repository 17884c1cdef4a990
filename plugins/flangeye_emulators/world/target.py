"""A calibration sphere on a stub, in ``flange``."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from flangeye.maths.geometry import rigid
from flangeye.models.targets import Sphere
from flangeye_emulators.world.mesh import COARSE, Mesh, capsule, lathe

SEGMENTS = 360
"""Of the sphere's circles: at a radius of 20 mm its facets are within 1 um of its surface."""


@lru_cache(maxsize=8)
def sphere_mesh(sphere: Sphere) -> Mesh:
    """Return the sphere."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, SEGMENTS // 2 + 1)
    radius, height = sphere.radius * np.cos(latitude), sphere.radius * np.sin(latitude)
    profile = list(zip(radius.tolist(), height.tolist(), strict=True))
    return lathe(profile, SEGMENTS).moved(rigid(np.eye(3), np.array(sphere.centre_in_flange)))


@lru_cache(maxsize=8)
def stub_mesh(sphere: Sphere) -> Mesh:
    """Return the rod that holds the sphere: along z, from the flange's face into the sphere."""
    x, y, z = sphere.centre_in_flange
    # Radius of the stub over that of the sphere
    return capsule(np.array([x, y, 0.0]), np.array([x, y, z]), 0.25 * sphere.radius, COARSE)

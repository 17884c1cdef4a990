"""What surfaces do to light, as far as a scanner is disturbed by it.

The figures are judgements, set so that simulated scans resemble published ones: noise on a bare
metal flange 1.2 times and on a black anodised one 1.5 times what the makers state for a white
diffuse target, hardly any hole in the face at moderate incidence, and none of it at a highlight.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from flangeye.models.robots import Finish


@dataclass(frozen=True)
class Material:
    """How one surface answers the projector.

    Attributes:
        albedo: Share of the light it returns in all directions.
        gloss: Share of the points that are lost in the middle of a highlight.
        grain: Standard deviation of depth, over that on a white diffuse surface.
    """

    albedo: float
    gloss: float = 0.0
    grain: float = 1.0


PAINTED = Material(albedo=0.6)
METAL = Material(albedo=0.35, gloss=0.6, grain=1.2)
ANODISED = Material(albedo=0.08, gloss=0.3, grain=1.5)
POLISHED = Material(albedo=0.25, gloss=0.9, grain=1.3)
MATT = Material(albedo=0.8)
RUBBER = Material(albedo=0.03, grain=1.5)
WALL = Material(albedo=0.8)
TABLE = Material(albedo=0.3)

FINISHES: Mapping[Finish, Material] = {
    "painted": PAINTED,
    "metal": METAL,
    "anodised": ANODISED,
}

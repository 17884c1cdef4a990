"""A structured-light scanner: a camera, a projector beside it, and the errors of both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.models.scanners import ScannerModel
from flangeye.types import Mask
from flangeye_emulators.world import edges
from flangeye_emulators.world.distortion import Distortion
from flangeye_emulators.world.grain import correlated_normal, normal_quantile
from flangeye_emulators.world.raycast import Hits, Image, Scene, pixels_of

FAINTEST = 0.012
"""Least share of the light that a point must return, of what a white surface at mid range and
facing both camera and projector returns: black anodising is lost beyond about 65 degrees."""

HIGHLIGHT = float(np.radians(6.0))
"""Half width of a highlight: angle at which its strength has fallen to 1/e."""

GRAZING = float(np.cos(np.radians(80.0)))
"""Cosine of the incidence beyond which no scanner decodes its pattern."""

EDGE_NOISE = 1.5
"""What a step adds to the noise beside it, as a share of it; it fades within a pixel."""


@dataclass(frozen=True, eq=False)
class _View:
    """What the camera and the projector see of the scene, before any error.

    Attributes:
        depth: (H, W) z of the first surface [m]; far beyond the range where there is none.
        seen: (H, W) whether it is in range and both camera and projector see it.
        cosine: (H, W) of the incidence of the camera's ray.
        strength: (H, W) share of the light that returns, see ``FAINTEST``.
        dazzled: (H, W) probability that a highlight spoils it.
    """

    depth: Image
    seen: Mask
    cosine: Image
    strength: Image
    dazzled: Image


class StructuredLight:
    """One scanner, with the distortion it happens to have.

    The depth noise grows with the square of the depth and with one over the cosine of incidence,
    as the deviations from the plane in published scans do, and neighbouring pixels share it.
    """

    def __init__(
        self, scanner: ScannerModel, resolution: float, noise: float, rng: np.random.Generator
    ) -> None:
        """Set up the scanner.

        Args:
            scanner: From the catalogue.
            resolution: Scale of the image's columns and rows.
            noise: Scale of the temporal noise and of the distortion; 0 gives exact depths.
            rng: Draws the distortion.
        """
        self.scanner = scanner
        self.pixels = pixels_of(scanner, resolution)
        self.noise = noise
        self._middle = np.float32((scanner.near + scanner.far) / 2)
        self._grain = scanner.noise_grain * resolution
        self._distortion = Distortion(scanner, self.pixels, noise * scanner.calibration_error, rng)
        lean = scanner.convergence
        # The camera leans towards the projector, which therefore stands a little before it.
        self.projector = scanner.baseline * np.array([np.cos(lean), 0.0, np.sin(lean)])
        self._inverse_length = 1 / np.linalg.norm(self.pixels.directions, axis=-1)

    def scan(self, scene: Scene, rng: np.random.Generator) -> Image:
        """Return the organised scan, (H, W, 3) in ``camera`` [m], NaN where nothing was measured.

        Args:
            scene: What stands before the scanner, in ``camera``.
            rng: Draws this scan's noise.
        """
        hits = scene.look(self.pixels)
        view = self._view(scene, hits)
        grain = correlated_normal(view.depth.shape, self._grain, rng)
        width = view.depth * np.float32(self.pixels.size)
        beside = edges.steps(view.depth, width)
        distance = edges.distance_to(beside)
        measured = self._decoded(view, distance, grain)
        depth = edges.rounded(view.depth, width, self._grain)
        depth += self._depth_noise(view, scene.figure("grain", hits.body), distance) * grain
        depth += self._distortion.depth_error(depth)
        edges.fly(depth, beside & measured, rng)
        points = self._distortion.points(depth)
        points[~measured] = np.nan
        return points

    def _view(self, scene: Scene, hits: Hits) -> _View:
        scanner, pixels = self.scanner, self.pixels
        depth = np.minimum(hits.depth, np.float32(2 * scanner.far))
        seen = (depth >= scanner.near) & (depth <= scanner.far)
        beams = pixels.directions * depth[..., None]
        beams -= self.projector.astype(np.float32)
        seen &= self._in_projection(beams) & ~scene.hidden(self.projector, beams)
        cosine = np.abs(np.einsum("ijk,ijk->ij", hits.normals, pixels.directions))
        cosine *= self._inverse_length
        from_beam = np.abs(np.einsum("ijk,ijk->ij", hits.normals, beams))
        from_beam /= np.sqrt(np.einsum("ijk,ijk->ij", beams, beams))
        strength = scene.figure("albedo", hits.body) * cosine * from_beam
        strength *= (self._middle / depth) ** 2
        dazzled = self._dazzled(scene.figure("gloss", hits.body), hits.normals, beams, seen)
        return _View(depth, seen, cosine, strength, dazzled)

    def _in_projection(self, beams: Image) -> Mask:
        if self.scanner.projection is None:
            return np.ones(beams.shape[:2], dtype=bool)
        # The projector leans towards the camera as much as the camera leans towards it.
        turn = 2 * self.scanner.convergence
        cos, sin = np.float32(np.cos(turn)), np.float32(np.sin(turn))
        x, y, z = beams[..., 0], beams[..., 1], beams[..., 2]
        ahead, aside = cos * z - sin * x, cos * x + sin * z
        half_x, half_y = np.tan(np.asarray(self.scanner.projection, dtype=np.float32) / 2)
        return np.asarray((np.abs(aside) <= half_x * ahead) & (np.abs(y) <= half_y * ahead))

    def _dazzled(self, gloss: Image, normals: Image, beams: Image, seen: Mask) -> Image:
        """Return the probability of a lost point: highest where the surface mirrors the beam."""
        out = np.zeros_like(gloss)
        shiny = np.nonzero((gloss > 0) & seen)
        to_camera = -_unit(self.pixels.directions[shiny])
        halfway = _unit(to_camera - _unit(beams[shiny]))
        cosine = np.minimum(np.abs((normals[shiny] * halfway).sum(axis=-1)), 1.0)
        out[shiny] = gloss[shiny] * np.exp(-((np.arccos(cosine) / HIGHLIGHT) ** 2))
        return out

    def _decoded(self, view: _View, distance: Image, grain: Image) -> Mask:
        """Return which points the scanner measures at all."""
        # Turned images of the grain are as good as new ones, and cost nothing.
        patchy, ragged = grain[::-1], grain[:, ::-1]
        out = view.seen & (view.cosine > GRAZING)
        out &= view.strength * (1 + np.float32(0.3) * patchy) > FAINTEST
        out &= ~edges.lost(distance, self.scanner.edge_loss, ragged)
        at = np.nonzero(out & (view.dazzled > 0.01))
        out[at] = patchy[at] > normal_quantile(view.dazzled[at])
        return out

    def _depth_noise(self, view: _View, surface: Image, distance: Image) -> Image:
        """Return the standard deviation of the depth (H, W) [m]."""
        sigma = np.float32(self.noise * self.scanner.temporal_noise) * surface
        sigma *= (view.depth / self._middle) ** 2 / np.maximum(view.cosine, np.float32(0.1))
        close = np.nonzero(distance < 3)
        sigma[close] *= 1 + np.float32(EDGE_NOISE) * np.exp(-distance[close])
        return np.asarray(sigma)


def _unit(vectors: Image) -> Image:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))

"""A structured-light scanner: a camera, a projector beside it, and the errors of both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.models.scanners import ScannerModel
from flangeye.types import Mask
from flangeye_emulators.world import scan_errors
from flangeye_emulators.world.raycast import Hits, Image, RaycastScene, bands, pixels_of, through
from flangeye_emulators.world.scan_errors import Distortion, correlated_normal, normal_quantile


@dataclass(frozen=True, eq=False)
class _View:
    """What the camera and the projector see in some rows, before any error.

    Attributes:
        depth: (R, W) z of the first surface [m].
        cosine: (R, W) of the incidence of the camera's ray.
        strength: (R, W) share of the light that returns, see ``FAINTEST``.
        dazzled: (R, W) probability that a highlight spoils it.
        grain: (R, W) what the surface makes of the noise, see ``Material``.
    """

    depth: Image
    cosine: Image
    strength: Image
    dazzled: Image
    grain: Image


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
        # Eight pixels beyond what is lost, a step has no part in any error.
        self._reach = int(np.ceil(scanner.edge_loss)) + 8
        self._distortion = Distortion(scanner, self.pixels, noise * scanner.calibration_error, rng)
        lean = scanner.convergence
        # The camera leans towards the projector, which therefore stands a little before it.
        self.projector = scanner.baseline * np.array([np.cos(lean), 0.0, np.sin(lean)])
        self._inverse_length: Image = 1 / np.linalg.norm(self.pixels.directions, axis=-1)

    def scan(self, scene: RaycastScene, rng: np.random.Generator) -> Image:
        """Return the organised scan, (H, W, 3) in ``camera`` [m], NaN where nothing was measured.

        Args:
            scene: What stands before the scanner, in ``camera``.
            rng: Draws this scan's noise.
        """
        hits = scene.look(self.pixels)
        np.minimum(hits.depth, np.float32(2 * self.scanner.far), out=hits.depth)
        measured = self._illuminated(scene, hits.depth)
        grain = correlated_normal(hits.depth.shape, self._grain, rng)
        width = hits.depth * np.float32(self.pixels.size)
        beside = scan_errors.steps(hits.depth, width)
        distance = scan_errors.distance_within(self._reach, beside)
        depth = scan_errors.rounded(hits.depth, width, self._grain)
        to_light = hits.facing(self.projector)
        for rows in bands(depth.shape):
            view = self._view(scene, hits, to_light, rows)
            self._decode(
                view, distance[rows], (grain[::-1][rows], grain[rows, ::-1]), measured[rows]
            )
            sigma = self._depth_noise(view, distance[rows])
            depth[rows] += sigma * grain[rows]
            depth[rows] += self._distortion.depth_error(depth[rows], rows)
        scan_errors.fly(depth, beside & measured, rng)
        np.copyto(depth, np.float32(np.nan), where=~measured)
        return self._distortion.points(depth)

    def _illuminated(self, scene: RaycastScene, depth: Image) -> Mask:
        """Return which points (H, W) are in range and see the projector's light."""
        seen = np.empty(depth.shape, dtype=bool)
        for rows in bands(depth.shape):
            near, far = self.scanner.near, self.scanner.far
            seen[rows] = (depth[rows] >= near) & (depth[rows] <= far)
            seen[rows] &= self._in_projection(*self._beams(depth, rows))
        return np.asarray(seen & ~scene.hidden(self.projector, self.pixels, depth, seen))

    def _beams(self, depth: Image, rows: slice) -> tuple[Image, Image, Image]:
        """Return x, y and z (R, W) of the beams from the projector to the points of some rows."""
        x, y, z = self.projector.astype(np.float32)
        pixels, depth = self.pixels, depth[rows]
        return pixels.x * depth - x, pixels.y[rows, None] * depth - y, depth - z

    def _in_projection(self, x: Image, y: Image, z: Image) -> Mask:
        if self.scanner.projection is None:
            return np.ones(x.shape, dtype=bool)
        # The projector leans towards the camera as much as the camera leans towards it.
        turn = 2 * self.scanner.convergence
        cos, sin = np.float32(np.cos(turn)), np.float32(np.sin(turn))
        ahead, aside = cos * z - sin * x, cos * x + sin * z
        half_x, half_y = np.tan(np.asarray(self.scanner.projection, dtype=np.float32) / 2)
        return np.asarray((np.abs(aside) <= half_x * ahead) & (np.abs(y) <= half_y * ahead))

    def _view(self, scene: RaycastScene, hits: Hits, to_light: Image, rows: slice) -> _View:
        """Return what is seen in some rows.

        Args:
            scene: What stands before the scanner.
            hits: What the camera's rays meet there.
            to_light: (H, W) product of the surface's normal and the projector's position.
            rows: Which rows.
        """
        depth, slant, body = hits.depth[rows], hits.slant[rows], hits.body[rows]
        x, y, z = self._beams(hits.depth, rows)
        length = np.sqrt(x * x + y * y + z * z)
        to_camera = slant * self._inverse_length[rows]
        to_projector = (depth * slant - to_light[rows]) / length
        cosine = np.abs(to_camera)
        strength = scene.figure("albedo", body) * cosine * np.abs(to_projector)
        strength *= (self._middle / depth) ** 2
        gloss = scene.figure("gloss", body)
        shiny = np.flatnonzero(gloss > 0)
        inverse = self._inverse_length[rows]
        images: tuple[Image, ...] = gloss, to_camera, to_projector, x, y, z, inverse, length
        lustre, here, there, x, y, z, inverse, length = (
            image.ravel().take(shiny) for image in images
        )
        across, down = through(self.pixels, shiny + rows.start * depth.shape[1])
        along = across * x + down * y + z
        dazzled = np.zeros_like(gloss)
        dazzled.ravel()[shiny] = lustre * _highlight(here + there, along * inverse / length)
        return _View(depth, cosine, strength, dazzled, scene.figure("grain", body))

    def _decode(
        self, view: _View, distance: Image, grains: tuple[Image, Image], measured: Mask
    ) -> None:
        """Forget, in place, the points that the scanner does not measure after all."""
        # Turned images of the grain are as good as new ones, and cost nothing.
        patchy, ragged = grains
        # No scanner decodes its pattern beyond
        measured &= view.cosine > float(np.cos(np.radians(80.0)))
        # Of what a white surface at mid range and facing both camera and projector
        # returns: black anodising is lost beyond about 65 degrees
        measured &= view.strength * (1 + np.float32(0.3) * patchy) > 0.012
        measured &= ~scan_errors.lost(distance, self.scanner.edge_loss, ragged)
        at = np.flatnonzero(measured & (view.dazzled > 0.01))
        measured.ravel()[at] = patchy.ravel().take(at) > normal_quantile(
            view.dazzled.ravel().take(at)
        )

    def _depth_noise(self, view: _View, distance: Image) -> Image:
        """Return the standard deviation of the depth (R, W) [m]."""
        sigma = np.float32(self.noise * self.scanner.temporal_noise) * view.grain
        sigma *= (view.depth / self._middle) ** 2 / np.maximum(view.cosine, np.float32(0.1))
        close = np.flatnonzero(distance < 3)
        near = distance.ravel().take(close)
        # What a step adds to the noise beside it, as a share of it; it fades within a pixel
        sigma.ravel()[close] *= 1 + np.float32(1.5) * np.exp(-near)
        return np.asarray(sigma)


def _highlight(cosines: Image, between: Image) -> Image:
    """Return the strength of a highlight: one where the surface mirrors the beam to the camera.

    Args:
        cosines: (N,) sum of the cosines between the normal and the camera's ray and the beam.
        between: (N,) cosine between the ray and the beam.
    """
    # The halfway vector is the sum of two unit vectors, of length sqrt(2 + 2 cos).
    halfway = np.minimum(np.abs(cosines) / np.sqrt(2 + 2 * between), np.float32(1.0))
    # Half width of a highlight: angle at which its strength has fallen to 1/e
    return np.asarray(np.exp(-((np.arccos(halfway) / float(np.radians(6.0))) ** 2)))

"""A time-of-flight camera: one eye, its lamp beside it, and the errors of measuring phases."""

from __future__ import annotations

import numpy as np

from flangeye.models.scanners import ScannerModel
from flangeye.types import Mask
from flangeye_emulators.world import scan_errors
from flangeye_emulators.world.raycast import Hits, Image, RaycastScene, pixels_of
from flangeye_emulators.world.scan_errors import Distortion, correlated_normal, normal_quantile

DIGIT = 1e-3
"""Depths are whole millimetres."""


class TimeOfFlight:
    """One camera, with the distortion it happens to have. Interface as ``StructuredLight``."""

    def __init__(
        self, scanner: ScannerModel, resolution: float, noise: float, rng: np.random.Generator
    ) -> None:
        """Set up the camera; the arguments are those of ``StructuredLight``."""
        self.scanner = scanner
        self.pixels = pixels_of(scanner, resolution)
        self.noise = noise
        self._middle = np.float32((scanner.near + scanner.far) / 2)
        self._grain = scanner.noise_grain * resolution
        self._distortion = Distortion(scanner, self.pixels, noise * scanner.calibration_error, rng)
        self._length = np.linalg.norm(self.pixels.directions, axis=-1)

    def scan(self, scene: RaycastScene, rng: np.random.Generator) -> Image:
        """Return the organised scan, (H, W, 3) in ``camera`` [m], NaN where nothing was measured.

        Args:
            scene: What stands before the camera, in ``camera``.
            rng: Draws this scan's noise.
        """
        hits = scene.look(self.pixels)
        depth = np.minimum(hits.depth, np.float32(2 * self.scanner.far))
        cosine = np.abs(hits.slant) / self._length
        strength = scene.figure("albedo", hits.body) * cosine * (self._middle / depth) ** 2
        grain = correlated_normal(depth.shape, self._grain, rng)
        distance = scan_errors.distance_to(
            scan_errors.steps(depth, depth * np.float32(self.pixels.size))
        )
        measured = self._measured(scene, hits, cosine, strength, grain)
        measured &= ~scan_errors.lost(distance, self.scanner.edge_loss, grain[:, ::-1])
        depth = _mixed(depth, strength)
        depth += self._error(scene, hits, depth, strength, distance) / self._length
        depth += self._sigma(scene, hits, depth, strength) / self._length * grain
        points = self._distortion.points(_digits(depth) if self.noise else depth)
        points[~measured] = np.nan
        return points

    def _measured(
        self, scene: RaycastScene, hits: Hits, cosine: Image, strength: Image, grain: Image
    ) -> Mask:
        out = (hits.depth >= self.scanner.near) & (hits.depth <= self.scanner.far)
        # Least share of the light of a white surface at mid range that still gives a phase
        out &= strength > 0.01
        angle = np.arccos(np.minimum(cosine, 1.0))
        # The lamp is beside the lens: a mirror returns its light where it faces the camera.
        # Half width of the mirror image of the lamp, which saturates pixels
        highlight = float(np.radians(3.0))
        dazzled = scene.figure("gloss", hits.body) * np.exp(-((angle / highlight) ** 2))
        at = np.nonzero(out & (dazzled > 0.01))
        out[at] = grain[::-1][at] > normal_quantile(dazzled[at])
        return np.asarray(out)

    def _error(
        self, scene: RaycastScene, hits: Hits, depth: Image, strength: Image, distance: Image
    ) -> Image:
        """Return what every scan of the same scene is wrong by, along the ray (H, W) [m]."""
        swing = np.float32(self.noise * self.scanner.calibration_error * np.sqrt(2) / 3)
        # Period of the systematic error in distance [m]: half the wavelength of light modulated at
        # 400 MHz, an overtone of the highest of the frequencies such cameras measure at
        wiggle = swing * np.sin(2 * np.pi / np.float32(0.1874) * depth * self._length)
        gloss = scene.figure("gloss", hits.body)
        # Error beside a step on bare metal, from light that took a longer way [m]; a published scan
        # of a metal flange is off by this much around its holes
        multipath = np.float32(self.noise * 4e-3) * (gloss / max(float(gloss.max()), 1e-6))
        # Distance from the step over which that error fades [px]
        multipath *= np.exp(-distance / np.float32(6.0))
        return np.asarray(wiggle + multipath + self._distortion.depth_error(depth))

    def _sigma(self, scene: RaycastScene, hits: Hits, depth: Image, strength: Image) -> Image:
        """Return the standard deviation along the ray (H, W) [m]."""
        sigma = np.float32(self.noise * self.scanner.temporal_noise)
        # Share of the noise that does not depend on the distance; the rest grows with its
        # square
        floor = 0.3
        growth = floor + (1 - floor) * (depth * self._length / self._middle) ** 2
        # Shot noise: the less light, the more of it; the distance is already in the growth.
        light = np.maximum(strength * (depth / self._middle) ** 2, np.float32(0.01))
        return np.asarray(sigma * growth * scene.figure("grain", hits.body) / np.sqrt(light))


def _mixed(depth: Image, strength: Image) -> Image:
    """Return the depths pixels report that see a spot: the mean, weighted by the light.

    For differences well below the wavelength the sum of the phasors has that phase.
    """
    import cv2

    light = strength + np.float32(1e-6)
    spot = 0.6  # that one pixel sees, standard deviation [px]: what makes pixels fly at edges
    blur = {"ksize": (5, 5), "sigmaX": spot, "sigmaY": spot}
    return np.asarray(
        cv2.GaussianBlur(depth * light, **blur) / cv2.GaussianBlur(light, **blur)  # type: ignore[call-overload]
    )


def _digits(depth: Image) -> Image:
    return np.asarray(np.rint(depth / np.float32(DIGIT)) * np.float32(DIGIT))

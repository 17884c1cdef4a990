"""Simulated scanners with their typical errors, by measurement principle.

A structured-light scanner has a camera and a projector beside it. A time-of-flight camera has one
lens with a lamp beside it, and errors of phase measurement. At depth steps both round edges, lose
points and create flying pixels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye.models.scanners import ScannerModel
from flangeye.plugin.stage import Params, PlaceParams
from flangeye.types import BASE, CAMERA, Floats, Indices, Mask, Transform
from flangeye.units import Angle, Length, param
from flangeye_emulators.world import scanner
from flangeye_emulators.world.raycast import (
    FloatImage,
    Hits,
    Pixels,
    RaycastScene,
    SolidBody,
    bands,
    pixels_of,
    through,
)

DEPTH_STEP = 5.0
"""A step is a change of depth between neighbours of more than this many widths of a pixel: a
surface seen at less than 79 degrees to its normal changes less."""


DEGREE = 3
"""Highest total degree of the polynomials: bends of the volume, no ripples."""


def steps(depth: FloatImage, width: FloatImage) -> Mask:
    """Return the mask (H, W) of pixels with a neighbour beyond a depth step.

    Args:
        depth: (H, W) depth [m], finite.
        width: Width of a pixel at that depth [m].
    """
    import cv2

    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return _beyond(
        lambda part: cv2.morphologyEx(part, cv2.MORPH_GRADIENT, cross), depth, DEPTH_STEP, width
    )


def _beyond(
    change: Callable[[FloatImage], NDArray[Any]],
    depth: FloatImage,
    widths: float,
    width: FloatImage,
) -> Mask:
    """Return the mask (H, W) where depth changes to a neighbour by more than ``widths`` pixels."""
    out = np.empty(depth.shape, dtype=bool)
    for rows in bands(depth.shape):
        first = max(rows.start - 1, 0)
        found = change(depth[first : rows.stop + 1])[rows.start - first :]
        limit = np.float32(widths) * width[rows]
        np.greater(np.abs(found[: len(limit)]), limit, out=out[rows])
    return out


def distance_to(marked: Mask) -> FloatImage:
    """Return each pixel's distance (H, W) to the nearest marked one [px]."""
    import cv2

    # The 3 x 3 approximation errs by 5 % at most, and only the first few pixels matter.
    return np.asarray(cv2.distanceTransform((~marked).view(np.uint8), cv2.DIST_L2, 3))


def distance_within(reach: int, marked: Mask) -> FloatImage:
    """Return :func:`distance_to` up to ``reach`` [px]; larger distances may be overestimated.

    It takes half the time, because most of an image is far from any step.
    """
    out = np.full(marked.shape, np.inf, dtype=np.float32)
    for rows in bands(marked.shape):
        first = max(rows.start - reach, 0)
        part = marked[first : rows.stop + reach]
        there = np.flatnonzero(part.any(axis=0))
        if len(there):
            columns = slice(max(there[0] - reach, 0), there[-1] + reach + 1)
            found = distance_to(part[:, columns])[rows.start - first :]
            out[rows, columns] = found[: len(out[rows])]
    return out


def lost(distance: Indices | FloatImage, loss: float, grain: FloatImage) -> Mask:
    """Return the mask of pixels that a scanner drops near depth steps.

    Args:
        distance: Distance to the nearest pixel beside a step [px]; the step is half a pixel
            farther.
        loss: Mean width of the dropped strip [px].
        grain: Standard normal values, with the correlation of the scanner's noise.
    """
    # Standard deviation of the line along which points are lost [px]; published scans of a rim are
    # rough by 0.16 to 0.25 mm at 0.2 to 0.3 mm a pixel
    return np.asarray(distance + 0.5 < loss + 0.5 * grain)


def rounded(depth: FloatImage, width: FloatImage, blur: float) -> FloatImage:
    """Return depths with rounded creases, like those smoothed by a scanner.

    Two Gaussian averages over 5 x 5 pixels of the same surface are applied near bends and steps;
    elsewhere they would change nothing. Beside a step the average is one-sided and displaces the
    edge of an oblique face by 0.1 mm, as in published scans.

    Args:
        depth: (H, W) depth [m], finite.
        width: Width of a pixel at that depth [m].
        blur: Standard deviation of each average [px].
    """
    import cv2

    if blur < 0.2:  # narrower than the pixel itself
        return depth
    # A bend is a second difference of depth of more than this many widths of a pixel: a crease of
    # 12 degrees, or a radius of five pixels
    bends = _beyond(lambda part: cv2.Laplacian(part, cv2.CV_32F), depth, 0.2, width)
    bends = cv2.dilate(bends.view(np.uint8), np.ones((9, 9), np.uint8)) > 0
    # The average looks two pixels to each side; the image ends there.
    bends[:2], bends[-2:], bends[:, :2], bends[:, -2:] = False, False, False, False
    at = np.flatnonzero(bends)
    out, wide = depth.copy(), width.ravel()
    # What stays in a core's cache at once.
    some = np.array_split(at, 1 + len(at) // 8192)
    # Averages, one after the other; two of them round a chamfer of 1 mm as published scans show it
    for _ in range(2):
        means = [_local_average(out, part, wide.take(part), blur) for part in some]
        out.ravel()[at] = np.concatenate(means)
    return out


def _local_average(depth: FloatImage, at: Indices, width: FloatImage, blur: float) -> FloatImage:
    flat, columns = depth.ravel(), depth.shape[1]
    centre = flat.take(at)
    total, weights = np.zeros_like(centre), np.zeros_like(centre)
    gates = [np.float32(DEPTH_STEP * max(reach, 1)) * width for reach in range(3)]
    corner = at - (2 * columns + 2)
    for dy, dx in product(range(-2, 3), repeat=2):
        neighbour = flat[(dy + 2) * columns + dx + 2 :].take(corner)
        near = np.abs(neighbour - centre) < gates[max(abs(dx), abs(dy))]
        weight = np.float32(np.exp(-(dx * dx + dy * dy) / (2 * blur**2))) * near
        total += np.multiply(weight, neighbour, out=neighbour)
        weights += weight
    return total / weights


def fly(depth: FloatImage, beside: Mask, rng: np.random.Generator) -> None:
    """Turn some pixels beside a depth step into flying pixels between its sides, in place.

    A pixel that sees both sides reports a depth in between, closer to the side it sees more of.

    Args:
        depth: (H, W) depth [m], finite.
        beside: (H, W) mask of measured pixels beside a step.
        rng: Random generator.
    """
    at = np.flatnonzero(beside)
    # Share of the surviving points beside a step that lie between its two sides
    at = at[rng.random(len(at)) < 0.06]
    around = _neighbours(depth, at)
    near, far, own = around.min(axis=0), around.max(axis=0), depth.ravel()[at]
    other = np.where(own - near < far - own, far, near)
    mix = (0.9 * rng.random(len(at)) ** 2).astype(np.float32)
    depth.ravel()[at] = own + mix * (other - own)


def _neighbours(depth: FloatImage, at: Indices) -> FloatImage:
    """Return depths (9, N) at and around pixels at flat indices; the border is replicated."""
    (rows, columns), (row, column) = depth.shape, np.divmod(at, depth.shape[1])
    return np.stack([
        depth[np.clip(row + dy, 0, rows - 1), np.clip(column + dx, 0, columns - 1)]
        for dy in (-1, 0, 1) for dx in (-1, 0, 1)
    ])  # fmt: skip


def correlated_normal(shape: tuple[int, ...], width: float, rng: np.random.Generator) -> FloatImage:
    """Return an image (H, W) of spatially correlated standard normal values.

    Args:
        shape: Shape (H, W) of the image.
        width: Standard deviation of the Gaussian filter that correlates neighbours [px]; two
            pixels d apart then correlate by exp(-d^2 / (4 width^2)).
        rng: Random generator.
    """
    import cv2

    white = rng.standard_normal(shape, dtype=np.float32)
    if width < 0.3:  # the filter would be the pixel itself
        return white
    size = 2 * int(np.ceil(3 * width)) + 1
    kernel = cv2.getGaussianKernel(size, width, cv2.CV_32F)
    # Filtering divides the deviation by this much; at the border the filter reflects the image,
    # and the deviation is a little higher there.
    scale = np.float32(1 / (kernel**2).sum())
    blurred = cv2.sepFilter2D(white, cv2.CV_32F, kernel, kernel)
    return np.asarray(np.multiply(blurred, scale, out=blurred))


def normal_quantile(probability: FloatImage | Floats) -> FloatImage:
    """Return the standard normal quantile of a probability, accurate to 0.02.

    A logistic approximation is accurate enough for the random effects that use it.
    """
    p = np.asarray(np.clip(probability, 1e-6, 1 - 1e-6), dtype=np.float64)
    return np.asarray(np.log(p / (1 - p)) / 1.702, dtype=np.float32)


class Distortion:
    """A scanner's distortion: a low-order polynomial field over its measuring volume.

    Legendre polynomials are orthogonal over the box of (column, row, depth), so the field's mean
    square is the sum of the squared coefficients, by which the field is scaled. Constant and tilted
    fields are left out: they only move the camera's frame, which is not observable.
    """

    def __init__(
        self, scanner: ScannerModel, pixels: Pixels, rms: float, rng: np.random.Generator
    ) -> None:
        """Draw a random field whose depth error has the given rms over the volume [m]."""
        rows, columns = pixels.shape
        self._middle = (scanner.near + scanner.far) / 2
        self._half = (scanner.far - scanner.near) / 2
        down = np.polynomial.legendre.legvander(np.linspace(-1, 1, rows), DEGREE)
        across = np.polynomial.legendre.legvander(np.linspace(-1, 1, columns), DEGREE)
        coefficients = _drawn(rms, rng, depth=True)
        # One image for each power of the depth, in single precision: an error of 0.1 mm keeps
        # seven digits.
        self._terms = [
            (down @ coefficients[:, :, k] @ across.T).astype(np.float32) for k in range(DEGREE + 1)
        ]
        # Error across the view over error along it: depth comes from the small angle between camera
        # and projector, and so is worse than the camera's own directions
        sideways = [_drawn(rms * (1 / 3) / self._middle, rng, depth=False) for _ in "xy"]
        for flat, direction in zip(sideways, (pixels.x, pixels.y[:, None]), strict=True):
            shift = down @ flat[:, :, 0] @ across.T
            self._terms.append((direction + shift).astype(np.float32))

    def depth_error(self, depth: FloatImage, rows: slice = slice(None)) -> FloatImage:
        """Return the depth error (R, W) in a slice of rows [m]."""
        w = (depth - np.float32(self._middle)) / np.float32(self._half)
        first, second, third, fourth = (term[rows] for term in self._terms[: DEGREE + 1])
        # Legendre's P2 and P3 by Horner's rule.
        cubic = fourth * (np.float32(2.5) * w * w - np.float32(1.5))
        return np.asarray(first + w * (second + cubic) + third * (np.float32(1.5) * w * w - 0.5))

    def points(self, depth: FloatImage) -> FloatImage:
        """Return the reported points (H, W, 3) for depths (H, W), with lateral errors only."""
        out = np.empty((*depth.shape, 3), dtype=np.float32)
        for rows in bands(depth.shape):
            np.multiply(self._terms[-2][rows], depth[rows], out=out[rows, :, 0])
            np.multiply(self._terms[-1][rows], depth[rows], out=out[rows, :, 1])
            out[rows, :, 2] = depth[rows]
        return out


def _drawn(rms: float, rng: np.random.Generator, depth: bool) -> Floats:
    """Return random Legendre coefficients (row, column, depth) of a field with the given rms."""
    size = DEGREE + 1
    out = np.zeros((size, size, size))
    for i, j, k in product(range(size), repeat=3):
        rigid = k == 0 and i + j <= 1
        if i + j + k <= DEGREE and not rigid and (depth or k == 0):
            # Legendre's P_n has the mean square 1 / (2 n + 1).
            norm = np.sqrt((2 * i + 1) * (2 * j + 1) * (2 * k + 1))
            out[i, j, k] = rng.standard_normal() * norm
    mean_square = sum(
        out[i, j, k] ** 2 / ((2 * i + 1) * (2 * j + 1) * (2 * k + 1))
        for i, j, k in product(range(size), repeat=3)
    )
    return np.asarray(out * (rms / np.sqrt(mean_square)))


@dataclass(frozen=True, eq=False)
class _View:
    """What camera and projector see in a slice of R rows, before errors.

    Attributes:
        depth: (R, W) z of the first surface [m].
        cosine: (R, W) cosine of the camera ray's incidence.
        strength: (R, W) returned share of the light; see ``FAINTEST``.
        dazzled: (R, W) probability that a highlight saturates the pixel.
        grain: (R, W) noise factor of the surface; see ``Material``.
    """

    depth: FloatImage
    cosine: FloatImage
    strength: FloatImage
    dazzled: FloatImage
    grain: FloatImage


class DepthCamera:
    """Common part of the simulated scanners: pixels, noise, and the unit's distortion."""

    def __init__(
        self, scanner: ScannerModel, resolution: float, noise: float, rng: np.random.Generator
    ) -> None:
        """Set up the scanner.

        Args:
            scanner: The scanner's model.
            resolution: Scale of the image's columns and rows.
            noise: Scale of the temporal noise and of the distortion; 0 gives exact depths.
            rng: Random generator of the distortion.
        """
        self.scanner = scanner
        self.pixels = pixels_of(scanner, resolution)
        self.noise = noise
        self._middle = np.float32((scanner.near + scanner.far) / 2)
        self._grain = scanner.noise_grain * resolution
        self._distortion = Distortion(scanner, self.pixels, noise * scanner.calibration_error, rng)
        self._length = np.linalg.norm(self.pixels.directions, axis=-1)


class StructuredLight(DepthCamera):
    """A structured-light scanner: a camera with a projector beside it.

    The depth noise is proportional to depth squared over the cosine of incidence, like the
    deviations from planes in published scans, and is correlated between neighbouring pixels.
    """

    def __init__(
        self, scanner: ScannerModel, resolution: float, noise: float, rng: np.random.Generator
    ) -> None:
        """Set up camera and projector."""
        super().__init__(scanner, resolution, noise, rng)
        # Eight pixels beyond what is lost, a step has no part in any error.
        self._reach = int(np.ceil(scanner.edge_loss)) + 8
        lean = scanner.convergence
        # The camera leans towards the projector, which therefore stands a little before it.
        self.projector = scanner.baseline * np.array([np.cos(lean), 0.0, np.sin(lean)])
        self._inverse_length: FloatImage = 1 / self._length

    def scan(self, scene: RaycastScene, rng: np.random.Generator) -> FloatImage:
        """Return the organised scan (H, W, 3) in ``camera`` [m]; missing points are NaN.

        Args:
            scene: Bodies in ``camera``.
            rng: Random generator of this scan's noise.
        """
        hits = scene.look(self.pixels)
        np.minimum(hits.depth, np.float32(2 * self.scanner.far), out=hits.depth)
        measured = self._illuminated(scene, hits.depth)
        grain = correlated_normal(hits.depth.shape, self._grain, rng)
        width = hits.depth * np.float32(self.pixels.size)
        beside = scanner.steps(hits.depth, width)
        distance = scanner.distance_within(self._reach, beside)
        depth = scanner.rounded(hits.depth, width, self._grain)
        to_light = hits.facing(self.projector)
        for rows in bands(depth.shape):
            view = self._view(scene, hits, to_light, rows)
            self._decode(
                view, distance[rows], (grain[::-1][rows], grain[rows, ::-1]), measured[rows]
            )
            sigma = self._depth_noise(view, distance[rows])
            depth[rows] += sigma * grain[rows]
            depth[rows] += self._distortion.depth_error(depth[rows], rows)
        scanner.fly(depth, beside & measured, rng)
        np.copyto(depth, np.float32(np.nan), where=~measured)
        return self._distortion.points(depth)

    def _illuminated(self, scene: RaycastScene, depth: FloatImage) -> Mask:
        """Return the mask (H, W) of points in range and lit by the projector."""
        seen = np.empty(depth.shape, dtype=bool)
        for rows in bands(depth.shape):
            near, far = self.scanner.near, self.scanner.far
            seen[rows] = (depth[rows] >= near) & (depth[rows] <= far)
            seen[rows] &= self._in_projection(*self._beams(depth, rows))
        return np.asarray(seen & ~scene.hidden(self.projector, self.pixels, depth, seen))

    def _beams(self, depth: FloatImage, rows: slice) -> tuple[FloatImage, FloatImage, FloatImage]:
        """Return x, y and z (R, W) of the projector's beams to the points in a slice of rows."""
        x, y, z = self.projector.astype(np.float32)
        pixels, depth = self.pixels, depth[rows]
        return pixels.x * depth - x, pixels.y[rows, None] * depth - y, depth - z

    def _in_projection(self, x: FloatImage, y: FloatImage, z: FloatImage) -> Mask:
        if self.scanner.projection is None:
            return np.ones(x.shape, dtype=bool)
        # The projector leans towards the camera as much as the camera leans towards it.
        turn = 2 * self.scanner.convergence
        cos, sin = np.float32(np.cos(turn)), np.float32(np.sin(turn))
        ahead, aside = cos * z - sin * x, cos * x + sin * z
        half_x, half_y = np.tan(np.asarray(self.scanner.projection, dtype=np.float32) / 2)
        return np.asarray((np.abs(aside) <= half_x * ahead) & (np.abs(y) <= half_y * ahead))

    def _view(self, scene: RaycastScene, hits: Hits, to_light: FloatImage, rows: slice) -> _View:
        """Return the depth view of a slice of rows.

        Args:
            scene: Bodies in ``camera``.
            hits: Hits of the camera's rays on the scene.
            to_light: (H, W) dot product of the surface's normal and the projector's position.
            rows: Rows of the image.
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
        images: tuple[FloatImage, ...] = gloss, to_camera, to_projector, x, y, z, inverse, length
        lustre, here, there, x, y, z, inverse, length = (
            image.ravel().take(shiny) for image in images
        )
        across, down = through(self.pixels, shiny + rows.start * depth.shape[1])
        along = across * x + down * y + z
        dazzled = np.zeros_like(gloss)
        dazzled.ravel()[shiny] = lustre * _highlight(here + there, along * inverse / length)
        return _View(depth, cosine, strength, dazzled, scene.figure("grain", body))

    def _decode(
        self,
        view: _View,
        distance: FloatImage,
        grains: tuple[FloatImage, FloatImage],
        measured: Mask,
    ) -> None:
        """Clear the mask, in place, of the points that the scanner fails to measure."""
        # Turned images of the grain are as good as new ones, and cost nothing.
        patchy, ragged = grains
        # No scanner decodes its pattern beyond
        measured &= view.cosine > float(np.cos(np.radians(80.0)))
        # Of what a white surface at mid range and facing both camera and projector
        # returns: black anodising is lost beyond about 65 degrees
        measured &= view.strength * (1 + np.float32(0.3) * patchy) > 0.012
        measured &= ~scanner.lost(distance, self.scanner.edge_loss, ragged)
        at = np.flatnonzero(measured & (view.dazzled > 0.01))
        measured.ravel()[at] = patchy.ravel().take(at) > normal_quantile(
            view.dazzled.ravel().take(at)
        )

    def _depth_noise(self, view: _View, distance: FloatImage) -> FloatImage:
        """Return the standard deviation of the depth (R, W) [m]."""
        sigma = np.float32(self.noise * self.scanner.temporal_noise) * view.grain
        sigma *= (view.depth / self._middle) ** 2 / np.maximum(view.cosine, np.float32(0.1))
        close = np.flatnonzero(distance < 3)
        near = distance.ravel().take(close)
        # What a step adds to the noise beside it, as a share of it; it fades within a pixel
        sigma.ravel()[close] *= 1 + np.float32(1.5) * np.exp(-near)
        return np.asarray(sigma)


def _highlight(cosines: FloatImage, between: FloatImage) -> FloatImage:
    """Return the strength of a highlight: one where the surface mirrors the beam into the camera.

    Args:
        cosines: (N,) sum of the cosines of normal and camera ray, and of normal and beam.
        between: (N,) cosine between the ray and the beam.
    """
    # The halfway vector is the sum of two unit vectors, of length sqrt(2 + 2 cos).
    halfway = np.minimum(np.abs(cosines) / np.sqrt(2 + 2 * between), np.float32(1.0))
    # Half width of a highlight: angle at which its strength has fallen to 1/e
    return np.asarray(np.exp(-((np.arccos(halfway) / float(np.radians(6.0))) ** 2)))


class TimeOfFlight(DepthCamera):
    """A time-of-flight camera."""

    def scan(self, scene: RaycastScene, rng: np.random.Generator) -> FloatImage:
        """Return the organised scan (H, W, 3) in ``camera`` [m]; missing points are NaN.

        Args:
            scene: Bodies in ``camera``.
            rng: Random generator of this scan's noise.
        """
        hits = scene.look(self.pixels)
        depth = np.minimum(hits.depth, np.float32(2 * self.scanner.far))
        cosine = np.abs(hits.slant) / self._length
        strength = scene.figure("albedo", hits.body) * cosine * (self._middle / depth) ** 2
        grain = correlated_normal(depth.shape, self._grain, rng)
        distance = scanner.distance_to(scanner.steps(depth, depth * np.float32(self.pixels.size)))
        measured = self._measured(scene, hits, cosine, strength, grain)
        measured &= ~scanner.lost(distance, self.scanner.edge_loss, grain[:, ::-1])
        depth = _mixed(depth, strength)
        depth += self._error(scene, hits, depth, strength, distance) / self._length
        depth += self._sigma(scene, hits, depth, strength) / self._length * grain
        points = self._distortion.points(_digits(depth) if self.noise else depth)
        points[~measured] = np.nan
        return points

    def _measured(
        self,
        scene: RaycastScene,
        hits: Hits,
        cosine: FloatImage,
        strength: FloatImage,
        grain: FloatImage,
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
        self,
        scene: RaycastScene,
        hits: Hits,
        depth: FloatImage,
        strength: FloatImage,
        distance: FloatImage,
    ) -> FloatImage:
        """Return the error along the ray (H, W) [m] that all scans of a scene share."""
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

    def _sigma(
        self, scene: RaycastScene, hits: Hits, depth: FloatImage, strength: FloatImage
    ) -> FloatImage:
        """Return the standard deviation of the random error along the ray (H, W) [m]."""
        sigma = np.float32(self.noise * self.scanner.temporal_noise)
        # Share of the noise that does not depend on the distance; the rest grows with its
        # square
        floor = 0.3
        growth = floor + (1 - floor) * (depth * self._length / self._middle) ** 2
        # Shot noise: the less light, the more of it; the distance is already in the growth.
        light = np.maximum(strength * (depth / self._middle) ** 2, np.float32(0.01))
        return np.asarray(sigma * growth * scene.figure("grain", hits.body) / np.sqrt(light))


def _mixed(depth: FloatImage, strength: FloatImage) -> FloatImage:
    """Return the depths of pixels that see a finite spot: the mean weighted by the light.

    For depth differences well below the modulation wavelength this is the phase of the sum of the
    returned phasors.
    """
    import cv2

    light = strength + np.float32(1e-6)
    spot = 0.6  # that one pixel sees, standard deviation [px]: what makes pixels fly at edges
    blur = {"ksize": (5, 5), "sigmaX": spot, "sigmaY": spot}
    return np.asarray(
        cv2.GaussianBlur(depth * light, **blur) / cv2.GaussianBlur(light, **blur)  # type: ignore[call-overload]
    )


def _digits(depth: FloatImage) -> FloatImage:
    # Depths are whole millimetres.
    digit = 1e-3
    return np.asarray(np.rint(depth / np.float32(digit)) * np.float32(digit))


class CameraPose(PlaceParams):
    """The scanner's pose in ``base``."""

    position: tuple[Length, Length, Length] = param(("600 mm", "-12.5 mm", "1000 mm"))
    """The paper's (17): 1 m above the table."""
    rpy: tuple[Angle, Angle, Angle] = param(("180 deg", "0 deg", "-90 deg"))
    """Roll, pitch, yaw; the default looks down."""

    @property
    def base_T_camera(self) -> Floats:
        """Pose (4, 4) of the scanner in ``base`` [m]; the user interface draws it there."""
        return self.matrix


class ScannerQuality(Params):
    """Errors of a simulated scanner beyond its model."""

    noise: float = Field(1.0, ge=0)
    """Scale of the scanner's noise and distortion."""
    resolution: float = Field(1.0, gt=0, le=1)
    """Scale of the scanner's columns and rows."""


def scanner_of(
    scanner: ScannerModel, resolution: float, noise: float, rng: np.random.Generator
) -> StructuredLight | TimeOfFlight:
    """Return the simulated scanner of a model, with a random distortion."""
    kind = StructuredLight if scanner.principle == "structured light" else TimeOfFlight
    return kind(scanner, resolution, noise, rng)


def before_camera(bodies: Sequence[SolidBody], base_T_camera: Floats) -> RaycastScene:
    """Return the scene of bodies given in ``base``, moved to ``camera``."""
    camera_T_base = Transform(BASE, CAMERA, base_T_camera).inverse().matrix
    return RaycastScene([body.moved(camera_T_base) for body in bodies])

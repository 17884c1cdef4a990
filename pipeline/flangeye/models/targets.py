"""Targets of a scan: the flange with its bolt pattern, or a sphere."""

from __future__ import annotations

from math import pi
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from flangeye.errors import RecipeError, StageError
from flangeye.files.paths import bundled
from flangeye.files.words import nearest
from flangeye.maths.circles import distances
from flangeye.models.model import Model, read_model
from flangeye.models.robots import FlangeDetails, RobotModel
from flangeye.types import Floats
from flangeye.units import Length


class Flange(BaseModel):
    """The circle to look for on this robot, as the recipe states it. All SI, radii.

    Attributes:
        name: Shown in messages and reports.
        rim: Radius of the visible edge: outer radius less its chamfer, or the wrist circle.
        outer: Nominal outer radius.
        bore: Radius of the bore's visible edge (nominal plus chamfer), or None.
        pitch: Radius of the circle the threads lie on.
        holes: Angles of the threaded holes about the flange's z [rad].
        hole: Radius of a threaded hole as it shows on the face.
        pin: Angle of the locating-pin hole [rad], or None.
        pin_hole: Radius of the pin hole.
        details: The robot's own data.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    name: str
    rim: float
    outer: float
    bore: float | None
    pitch: float
    holes: tuple[float, ...]
    hole: float
    pin: float | None
    pin_hole: float
    details: FlangeDetails

    @property
    def behind(self) -> float:
        """Distance of the circle behind the origin of ``flange``, for a circle on the wrist [m]."""
        return self.details.thickness if self.bore is None else 0.0

    @property
    def radii(self) -> dict[str, float]:
        """The radii to expect by name: rim, and bore if the flange shows one [m]."""
        return {"rim": self.rim} | ({} if self.bore is None else {"bore": self.bore})


def plate_of(robot: RobotModel) -> Flange:
    """Return the plate that an arm's own file names.

    Raises:
        RecipeError: The arm's file names no plate.
    """
    if robot.flange.standard is None:
        raise RecipeError(
            f"{robot.model}: which plate it carries is not known; write feature: "
            "{standard: ISO 9409-1-50-4-M6} ('flangeye standards' lists them)"
        )
    return flange_of(robot.flange, load_standard(robot.flange.standard))


def flange_of(details: FlangeDetails, standard: FlangeStandard) -> Flange:
    """Return the circle of ``standard`` as seen on an arm."""
    # A scan shows the flat face: chamfers make its rim smaller than nominal, and its holes larger
    n, pin = standard.threads, details.pin_angle
    # The pin hole lies on a bisector of the threads (ISO 9409-1, clause 4).
    holes = tuple((pin or 0.0) + pi / n + 2 * pi * i / n for i in range(n))
    return Flange(
        name=standard.designation,
        # The plane fit sees the flat face only, which ends where the chamfer begins.
        rim=standard.outer / 2 - details.rim_chamfer,
        outer=standard.outer / 2,
        bore=standard.centring / 2 + details.bore_chamfer,
        pitch=standard.pitch_circle / 2,
        holes=holes,
        hole=standard.thread / 2 + details.countersink,
        pin=pin,
        pin_hole=standard.pin / 2 + details.countersink,
        details=details,
    )


def wrist_circle_of(details: FlangeDetails, diameter: float) -> Flange:
    """Return the wrist's outer circle of ``diameter`` [m]: for scanners too coarse for the rim."""
    return Flange(
        name=f"wrist circle {diameter * 1e3:g} mm",
        rim=diameter / 2,
        outer=diameter / 2,
        bore=None,
        pitch=0.0,
        holes=(),
        hole=0.0,
        pin=None,
        pin_hole=0.0,
        details=details,
    )


class Sphere(BaseModel):
    """A calibration sphere. All SI.

    Attributes:
        size: Radius of the sphere; None if it is estimated.
        centre_in_flange: Centre of the sphere in the carrying frame, usually ``flange``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    size: float | None
    centre_in_flange: tuple[float, float, float]

    @property
    def radius(self) -> float:
        """Radius of the sphere [m].

        Raises:
            StageError: It is not known.
        """
        if self.size is None:
            raise StageError(
                "feature.sphere.diameter is unknown: segment.sphere and fit.sphere find it in "
                "scans; to simulate them, or for profiles of a line scanner, write the diameter"
            )
        return self.size


class FlangeStandard(Model):
    """One row of ISO 9409-1: the plate's nominal dimensions. Diameters, as the standard gives."""

    designation: str
    pitch_circle: Length
    """d1, diameter of the circle the threads lie on."""
    outer: Length
    """d2, outer diameter."""
    centring: Length
    """d3, diameter of the centring bore."""
    threads: int = Field(ge=0)
    """N, number of threaded holes."""
    thread: Length
    """d4, nominal diameter of the thread."""
    pin: Length
    """d5, diameter of the locating-pin hole on the pitch circle."""
    source: str
    verified: bool
    """Whether two independent sources agree on every value."""


def load_standard(designation: str) -> FlangeStandard:
    """Return the plate with this designation; blanks, case and the leading ISO do not matter.

    Raises:
        RecipeError: It is not in the table; names the designations that are.
    """
    wanted = _designation_key(designation)
    for row in known_standards():
        if _designation_key(row.designation) == wanted:
            return row
    known = [row.designation for row in known_standards()]
    close = nearest(designation, known, n=3, cutoff=0.4) or known
    raise RecipeError(f"no flange standard '{designation}'; known: {', '.join(close)}")


def known_standards() -> tuple[FlangeStandard, ...]:
    """Return the plates of the table, smallest first."""
    return read_model(bundled("data") / "standards" / "iso9409-1.yaml", StandardTable).plates


def _designation_key(text: str) -> str:
    return text.upper().replace(" ", "").removeprefix("ISO").removeprefix("9409-1-")


class StandardTable(Model):
    """The content of ``data/standards/iso9409-1.yaml``."""

    title: str
    plates: tuple[FlangeStandard, ...]


TICKS = 720
"""Half a degree: 0.2 mm on the pitch circle of the most common flange."""


class HoleMatch(NamedTuple):
    """The rotation at which the gaps of a face match the flange's holes best.

    Attributes:
        angle: From the first axis to the flange's x axis, about the normal [rad], in (-pi, pi].
        score: Emptiness of the pattern's holes less that of the rest of the ring, at most 1.
        rival: The best score elsewhere.
    """

    angle: float
    score: float
    rival: float


def match_holes(flat: Floats, flange: Flange) -> HoleMatch | None:
    """Return the angle of the hole pattern in a face, or None if no pattern is recognised.

    The face has no points in a hole. The emptiness of a ring about the pitch circle, by angle, is
    compared with the known pattern at every rotation.

    Args:
        flat: (N, 2) points of the face about its centre, in the axes of ``basis_of_plane`` [m].
        flange: Flange whose pattern is sought; a flange without holes has none.
    """
    if not flange.holes:
        return None
    # A ring half as wide as the holes: wider, the face beside a hole would fill it.
    empty = emptiness(flat, flange.pitch, 0.5 * flange.hole)
    if empty is None:
        return None
    scores = _correlate(empty, hole_pattern(flange))
    best = int(np.argmax(scores))
    apart = np.abs((np.arange(TICKS) - best + TICKS // 2) % TICKS - TICKS // 2)
    # Elsewhere begins a quarter of the way to the next hole
    rival = float(scores[apart > TICKS / (4 * len(flange.holes))].max())
    angle = 2 * np.pi * (best + _vertex(scores, best)) / TICKS
    return HoleMatch(float(_wrap(angle)), float(scores[best]), rival)


def roll_angle(flat: Floats, flange: Flange) -> float | None:
    """Return the angle of the flange's x axis in the face's own axes, or None if not visible.

    The pin hole decides between the rotations that the threads alone leave equal. On the published
    clouds the right rotation scores 0.77 to 0.91, the next best 0.62 to 0.69; where the pin hole
    is out of sight both are equal, and there is no answer.

    Args:
        flat: See :func:`match_holes`.
        flange: Flange whose pattern is searched.
    """
    match = match_holes(flat, flange) if flange.pin is not None else None
    # On the published clouds the next best rotation scores below 0.9 of the right one.
    if match is None or match.score < 0.5 or match.rival > 0.9 * match.score:
        return None
    return match.angle


def emptiness(flat: Floats, pitch: float, half_width: float) -> Floats | None:
    """Return the emptiness of a ring at ``TICKS`` angles, from 0 (full) to 1 (empty).

    Args:
        flat: (N, 2) points about the centre [m].
        pitch: Radius of the ring [m].
        half_width: Half its width [m].

    Returns:
        (TICKS,), or None when there are too few points to see a hole.
    """
    # Counted by angle: the face fills every tick of the ring but those over a hole.
    x, y = flat.T.compress(np.abs(distances(flat) - pitch) < half_width, axis=1)
    turn = np.arctan2(y, x) / (2 * np.pi) * TICKS
    count = np.bincount(np.floor(turn).astype(np.intp) % TICKS, minlength=TICKS).astype(float)
    # As narrow a window as the points allow, half a hole wide at most.
    for reach in range(2, max(3, int(half_width / pitch * TICKS / (2 * np.pi)) + 1)):
        smooth = sum(np.roll(count, k) for k in range(-reach, reach + 1))
        # Holes take less than a quarter of the ring: so full is a place on the face
        usual = float(np.percentile(smooth, 75))
        # Points a place that is not a hole must hold, for an empty place to mean anything
        if usual >= 5:
            return np.asarray(np.clip(1.0 - smooth / usual, 0.0, 1.0))
    return None


def hole_pattern(flange: Flange) -> Floats:
    """Return (TICKS,) ones where the flange's own ring is empty, zeros elsewhere."""
    angles = (np.arange(TICKS) + 0.5) / TICKS * 2 * np.pi
    pattern = np.zeros(TICKS)
    for middle, half in _openings(flange):
        pattern[np.abs(_wrap(angles - middle)) < half] = 1.0
    return pattern


def _openings(flange: Flange) -> list[tuple[float, float]]:
    """Return the middle and half width [rad] of every opening on the pitch circle."""
    openings = [(hole, np.arcsin(flange.hole / flange.pitch)) for hole in flange.holes]
    if flange.pin is not None:
        openings.append((flange.pin, np.arcsin(flange.pin_hole / flange.pitch)))
    for recess in flange.details.recesses:
        across = (recess.width / 2) ** 2 - (flange.pitch - recess.radius) ** 2
        if across > 0:
            # The round end of the slot adds half a chord at the height of the pitch circle.
            openings.append((recess.angle, recess.half_span + np.sqrt(across) / recess.radius))
    return openings


def _correlate(empty: Floats, pattern: Floats) -> Floats:
    """Return, for every rotation, the mean emptiness in the pattern's holes minus that beside."""
    # Circular correlation: the emptiness under the pattern, summed, at every rotation at once
    spectrum = np.fft.rfft(empty) * np.conj(np.fft.rfft(pattern))
    inside = np.fft.irfft(spectrum, TICKS)
    holes = pattern.sum()
    return np.asarray(inside / holes - (empty.sum() - inside) / (TICKS - holes))


def _vertex(scores: Floats, best: int) -> float:
    """Return how far from ``best`` the peak's centre of mass lies, in ticks."""
    near = np.arange(-6, 7)
    height = scores[(best + near) % len(scores)]
    # A centre of mass: the correlation of holes with hard edges has a triangular peak, which a
    # parabola fits badly.
    height = np.clip(height - height.min(), 0.0, None)
    return float(near @ height / height.sum()) if height.sum() > 0 else 0.0


def _wrap(angle: Floats | float) -> Floats:
    # Into (-pi, pi]: half a turn is always +pi
    return np.asarray(np.pi - (np.pi - angle) % (2 * np.pi))

"""Targets of a scan: the robot's flange circle, or a sphere."""

from __future__ import annotations

from math import pi

from pydantic import BaseModel, ConfigDict, Field

from flangeye.errors import RecipeError, StageError
from flangeye.files.paths import bundled
from flangeye.files.words import nearest
from flangeye.models.model import Model, read_model
from flangeye.models.robots import FlangeDetails, RobotModel
from flangeye.units import Length, param


class Flange(BaseModel):
    """The circle to look for, as this robot and this recipe have it. All SI, radii.

    Attributes:
        name: For people.
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
        """How far the circle lies behind the origin of ``flange``: a wrist's circle does [m]."""
        return self.details.thickness if self.bore is None else 0.0

    @property
    def radii(self) -> dict[str, float]:
        """The radii to expect by name: rim, and bore if the flange shows one [m]."""
        return {"rim": self.rim} | ({} if self.bore is None else {"bore": self.bore})


def plate_of(robot: RobotModel) -> Flange:
    """Return the plate that an arm's own file names.

    Raises:
        RecipeError: It names none.
    """
    if robot.flange.standard is None:
        raise RecipeError(
            f"{robot.model}: which plate it carries is not known; write feature: "
            "{standard: ISO 9409-1-50-4-M6} ('flangeye standards' lists them)"
        )
    return flange_of(robot.flange, load_standard(robot.flange.standard))


def flange_of(details: FlangeDetails, standard: FlangeStandard) -> Flange:
    """Return the circle of ``standard`` as it shows on an arm."""
    n, pin = standard.threads, details.pin_angle
    # The pin hole lies on a bisector of the threads (ISO 9409-1, clause 4).
    holes = tuple((pin or 0.0) + pi / n + 2 * pi * i / n for i in range(n))
    return Flange(
        name=standard.designation,
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
        size: Radius of the sphere, None where it is to be found.
        centre_in_flange: Its centre in the frame that carries it, mostly ``flange``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    size: float | None
    centre_in_flange: tuple[float, float, float]

    @property
    def radius(self) -> float:
        """The radius [m].

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
    pitch_circle: Length = param(description="d1, diameter of the circle the threads lie on.")
    outer: Length = param(description="d2, outer diameter.")
    centring: Length = param(description="d3, diameter of the centring bore.")
    threads: int = Field(ge=0, description="N, number of threaded holes.")
    thread: Length = param(description="d4, nominal diameter of the thread.")
    pin: Length = param(description="d5, diameter of the locating-pin hole on the pitch circle.")
    source: str
    verified: bool = Field(description="Whether two independent sources agree on every value.")


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
    """The file ``data/standards/iso9409-1.yaml``."""

    title: str
    plates: tuple[FlangeStandard, ...]

"""What recipes name instead of describing: flange standards, robots, scanners.

Each is a YAML file under ``data/``, or a file of the user's own, with units on every value and
its source beside it. Here they become checked models in SI units.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from flangeye.errors import RecipeError
from flangeye.shipped import shipped
from flangeye.units import Angle, Length, param
from flangeye.yamlfile import read_yaml


class Model(BaseModel):
    """Base of everything read from ``data/``: frozen, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, defer_build=True)


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


class Recess(Model):
    """A slot milled into the face along a circle, with round ends, such as Franka's three."""

    angle: Angle = param(description="Of its middle, about the flange's z.")
    radius: Length = param(gt=0, description="Of the circle its centre line follows.")
    half_span: Angle = param(description="Half the angle its centre line covers, ends aside.")
    width: Length = param(gt=0)
    depth: Length = param(gt=0)


Finish = Literal["painted", "metal", "anodised"]


class FlangeDetails(Model):
    """What a scanner sees of one robot's flange and the standard does not fix."""

    standard: str = Field(description="Designation, for example ISO 9409-1-50-4-M6.")
    rim_chamfer: Length = param("0 mm", description="Radial width of the chamfer at the rim.")
    bore_chamfer: Length = param("0 mm", description="Radial width of the chamfer at the bore.")
    bore_depth: Length = param("6 mm", description="Depth of the centring bore.")
    thickness: Length = param("6 mm", description="Height of the plate above the wrist.")
    pin_angle: Angle = param("90 deg", description="Where the pin hole is, about the flange's z.")
    wrist: Length = param(description="Diameter of the wrist's housing behind the plate.")
    wrist_length: Length = param("40 mm", description="Length of that housing, from the face.")
    countersink: Length = param("0 mm", description="Radial width of the chamfer at the holes.")
    hole_depth: Length = param("9 mm", description="Depth of the threaded holes and the pin hole.")
    recesses: tuple[Recess, ...] = ()
    finish: Finish = Field("metal", description="What the face is made of, as a scanner sees it.")
    source: str


class Joint(Model):
    """One revolute joint: Denavit-Hartenberg parameters and limits."""

    a: Length = param("0 mm")
    alpha: Angle = param("0 deg")
    d: Length = param("0 mm")
    theta: Angle = param("0 deg", description="Offset added to the joint's angle.")
    lower: Angle = param("-360 deg")
    upper: Angle = param("360 deg")


class Volume(Model):
    """A capsule that stands for a piece of the arm, fixed to a link."""

    link: int = Field(ge=0, description="0 is the base, n the last link.")
    start: tuple[Length, Length, Length]
    end: tuple[Length, Length, Length]
    radius: Length = param(gt=0)


class RobotModel(Model):
    """An arm: its kinematics, its flange, and roughly the space it fills."""

    model: str
    maker: str
    convention: Literal["standard", "modified"] = Field(description="Denavit-Hartenberg variant.")
    joints: tuple[Joint, ...]
    flange_offset: Length = param("0 mm", description="Last link to the flange's face, along z.")
    flange: FlangeDetails
    volumes: tuple[Volume, ...] = ()
    repeatability: Length
    joint_accuracy: Angle = param(description="Standard deviation of a joint's zero.")
    source: str


@dataclass(frozen=True)
class SecondRobot:
    """The arm of a recipe that carries the target before the camera on the first."""

    model: RobotModel


class ScannerModel(Model):
    """A 3D scanner: what it sees, how finely, and how wrongly."""

    model: str
    maker: str
    principle: Literal["structured light", "time of flight"]
    columns: int = Field(gt=0)
    rows: int = Field(gt=0)
    field_of_view: tuple[Angle, Angle] = Field(description="Horizontal, vertical; full angles.")
    near: Length
    far: Length
    baseline: Length = param("0 mm", description="Camera to projector, along the image's x.")
    convergence: Angle = param(
        "0 deg",
        description="From the baseline's normal to the camera's axis, towards the projector.",
    )
    projection: tuple[Angle, Angle] | None = Field(
        None,
        description="The projector's field, horizontal and vertical; all of space if not given.",
    )
    temporal_noise: Length = param(description="Standard deviation of depth at mid range.")
    noise_grain: float = Field(
        0.0, ge=0, description="Filter that correlates neighbouring noise, standard deviation [px]."
    )
    edge_loss: float = Field(0.0, ge=0, description="Width lost along a step in depth [px].")
    calibration_error: Length = param(description="Smooth distortion over the volume, rms.")
    source: str


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


def flange_of(robot: RobotModel, standard: FlangeStandard) -> Flange:
    """Return the circle of ``standard`` as it shows on ``robot``."""
    details = robot.flange
    n = standard.threads
    # The pin hole lies on a bisector of the threads (ISO 9409-1, clause 4).
    holes = details.pin_angle + np.pi / n + 2 * np.pi * np.arange(n) / n if n else np.zeros(0)
    return Flange(
        name=standard.designation,
        rim=standard.outer / 2 - details.rim_chamfer,
        outer=standard.outer / 2,
        bore=standard.centring / 2 + details.bore_chamfer,
        pitch=standard.pitch_circle / 2,
        holes=tuple(float(h) for h in holes),
        hole=standard.thread / 2 + details.countersink,
        pin=details.pin_angle,
        pin_hole=standard.pin / 2 + details.countersink,
        details=details,
    )


def wrist_circle_of(robot: RobotModel, diameter: float) -> Flange:
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
        details=robot.flange,
    )


class Sphere(BaseModel):
    """A calibration sphere that the flange carries. All SI.

    Attributes:
        radius: Of the sphere.
        centre_in_flange: Its centre in ``flange``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    radius: float
    centre_in_flange: tuple[float, float, float]


M = TypeVar("M", bound=Model)


def load_model(kind: Literal["robots", "scanners"], name: str, near: Path | None = None) -> Any:
    """Return the robot or scanner ``name``: a shipped model, or a path to a file of one's own.

    Args:
        kind: Folder under ``data/``.
        name: Model name, or a path ending in ``.yaml``; relative to ``near`` if not found here.
        near: Folder of the recipe.

    Raises:
        RecipeError: There is no such model (the nearest are named), or its file is wrong.
    """
    cls: type[Model] = RobotModel if kind == "robots" else ScannerModel
    if name.endswith((".yaml", ".yml")):
        path = Path(name) if Path(name).exists() or near is None else near / name
        return read_model(path, cls)
    path = shipped("data") / kind / f"{name}.yaml"
    if not path.is_file():
        known = sorted(p.stem for p in path.parent.glob("*.yaml"))
        close = difflib.get_close_matches(name, known, n=2) or known
        raise RecipeError(f"no {kind[:-1]} '{name}'; known: {', '.join(close)}, or a .yaml file")
    return read_model(path, cls)


def load_standard(designation: str) -> FlangeStandard:
    """Return the plate with this designation; blanks, case and the leading ISO do not matter.

    Raises:
        RecipeError: It is not in the table; names the designations that are.
    """
    table = read_model(shipped("data") / "standards" / "iso9409-1.yaml", StandardTable)
    wanted = _designation_key(designation)
    for row in table.plates:
        if _designation_key(row.designation) == wanted:
            return row
    known = [row.designation for row in table.plates]
    close = difflib.get_close_matches(designation, known, n=3, cutoff=0.4) or known
    raise RecipeError(f"no flange standard '{designation}'; known: {', '.join(close)}")


def _designation_key(text: str) -> str:
    return text.upper().replace(" ", "").removeprefix("ISO").removeprefix("9409-1-")


class StandardTable(Model):
    """The file ``data/standards/iso9409-1.yaml``."""

    title: str
    plates: tuple[FlangeStandard, ...]


def read_model(path: Path, cls: type[M]) -> M:
    """Read one YAML file into a model.

    Raises:
        RecipeError: Every mistake, with file and line.
    """
    document = read_yaml(path)
    try:
        return cls.model_validate(document.data)
    except ValidationError as error:
        problems = [
            f"{path}:{document.line(e['loc'])}: {'.'.join(map(str, e['loc']))}: {e['msg']}"
            for e in error.errors()
        ]
        raise RecipeError("\n".join(problems)) from None

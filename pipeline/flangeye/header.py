"""The sections of a recipe above its steps, as people write them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from flangeye.stage import Choose, Chosen
from flangeye.units import Acceleration, Angle, AngularSpeed, Length, Speed, param


class Section(BaseModel):
    """Base of a recipe's sections."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        validate_default=True,
        arbitrary_types_allowed=True,
        defer_build=True,
    )


class BoxSection(Section):
    """A box along the axes of the robot's base."""

    centre: tuple[Length, Length, Length]
    size: tuple[Length, Length, Length]


class LimitsSection(Section):
    """What the arm must keep to; required where a driver is named, for a real arm may be there."""

    box: BoxSection = Field(description="The flange's centre stays inside, in the robot's base.")
    speed: Speed = param("100 mm/s", gt=0, le=1.0, description="Of the flange.")
    acceleration: Acceleration = param("300 mm/s^2", gt=0, le=3.0, description="Of the flange.")
    joint_speed: AngularSpeed = param("30 deg/s", gt=0, description="Of every joint.")
    joints: tuple[tuple[Angle, Angle], ...] | None = Field(
        None, description="Lower and upper angle of each joint; the model's own when not given."
    )


class RobotSection(Section):
    """Which arm, and how to reach it."""

    model: str = Field(description="A model of data/robots, or a .yaml file of your own.")
    driver: Annotated[Chosen, Choose("robot")] | None = Field(
        None, description="How to reach the real arm, for example {ur_rtde: {host: 192.168.1.10}}."
    )
    limits: LimitsSection | None = Field(None, description="What the arm must keep to.")


class SecondRobotSection(Section):
    """The arm that carries the target before the first one's camera."""

    model: str = Field(description="A model of data/robots, or a .yaml file of your own.")


class ScannerSection(Section):
    """Which scanner, and how to reach it."""

    model: str = Field(description="A model of data/scanners, or a .yaml file of your own.")
    driver: Annotated[Chosen, Choose("scanner")] | None = Field(
        None, description="How to reach the real scanner, for example {watched_folder: {path: …}}."
    )


class SphereSection(Section):
    """A calibration sphere that the flange carries."""

    diameter: Length = Field(gt=0)
    centre: tuple[Length, Length, Length] = Field(
        description="Where its centre is in the flange frame: origin in the face, z outwards."
    )


class FeatureSection(Section):
    """Which circle to look for; by default the flange the robot's file names."""

    standard: str | None = Field(
        None, description="Designation such as ISO 9409-1-50-4-M6, or a .yaml file of your own."
    )
    wrist_circle: Length | None = Field(
        None, description="Diameter of the wrist's outer circle, for scanners too coarse for a rim."
    )
    sphere: SphereSection | None = Field(
        None, description="A calibration sphere on the flange, to be looked for in its place."
    )


class PlaceSection(Section):
    """Where the target is, in the frame that carries it."""

    position: tuple[Length, Length, Length] = param(("0 mm", "0 mm", "0 mm"))
    rpy: tuple[Angle, Angle, Angle] = param(
        ("0 deg", "0 deg", "0 deg"),
        description="Roll, pitch, yaw; the target's z points towards the scanner.",
    )


class ConfigurationSection(Section):
    """Who carries the camera and who the target; what has to be found follows."""

    name: Literal["eye-on-base", "eye-in-hand", "eye-on-arm", "two-arms"] = "eye-on-base"
    camera: str | None = Field(
        None,
        description="Frame that carries the camera: base, flange, or link1, link2, … for "
        "eye-on-arm.",
    )
    target: str | None = Field(
        None, description="Frame that carries the target: flange, base or flange2."
    )
    place: Literal["known", "unknown"] | PlaceSection = Field(
        "known",
        description="Where the target is in that frame: known (at the origin, as the robot's own "
        "circles are), unknown (a marker), or its position and rpy.",
    )


class WorkspaceSection(BoxSection):
    """Where the work is, in the robot's base; errors are reported over this box."""


class LogSection(Section):
    """What goes into run.mcap besides the results, which always do."""

    clouds: Literal["preview", "full"] = Field(
        "preview", description="Raw scans: thinned for viewing, or whole, to segment again later."
    )


class Header(Section):
    """A recipe, its steps not yet checked."""

    title: str = Field(description="One line for people.")
    description: str = Field("", description="More lines for people.")
    robot: RobotSection | None = None
    second_robot: SecondRobotSection | None = None
    scanner: ScannerSection | None = None
    configuration: ConfigurationSection = Field(default_factory=ConfigurationSection)
    feature: FeatureSection = Field(default_factory=FeatureSection)
    workspace: WorkspaceSection | None = None
    seed: int = Field(0, ge=0, description="The only source of randomness.")
    log: LogSection = Field(default_factory=LogSection)
    steps: list[Any] = Field(min_length=1, description="Stages in order, each with parameters.")

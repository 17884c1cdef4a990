"""The sections of a recipe above its steps, as people write them."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, GetJsonSchemaHandler, field_validator, model_validator
from pydantic_core import CoreSchema

from flangeye.errors import StageError
from flangeye.files.clouds import FileUnit
from flangeye.models.robots import RobotModel
from flangeye.motion.limits import MotionLimits
from flangeye.plugin.stage import BoundPart, Choose, Params, PlaceParams
from flangeye.units import Acceleration, Angle, AngularSpeed, Length, Speed, param


class RecipeSection(Params):
    """Base of a recipe's sections."""


Positive = Annotated[Length, Field(gt=0)]


class BoxSection(RecipeSection):
    """A box along the axes of the robot's base."""

    centre: tuple[Length, Length, Length]
    size: tuple[Positive, Positive, Positive]


class LimitsSection(RecipeSection):
    """The arm's motion limits; required with a driver, which may move a real arm."""

    box: BoxSection
    """The flange's centre stays inside, in the robot's base."""
    speed: Speed = param("100 mm/s", gt=0, le=1.0)
    """Largest speed of the flange."""
    acceleration: Acceleration = param("300 mm/s^2", gt=0, le=3.0)
    """Largest acceleration of the flange."""
    joint_speed: AngularSpeed = param("30 deg/s", gt=0)
    """Largest speed of any joint."""
    joints: tuple[tuple[Angle, Angle], ...] | None = None
    """Lower and upper angle of each joint; the model's own when not given."""

    def for_robot(self, robot: RobotModel) -> MotionLimits:
        """Return these limits, within those of a robot itself.

        Raises:
            StageError: They are not for this arm: another number of joints, or an empty range.
        """
        # The recipe may narrow the model's ranges and never widens them
        lower = np.array([joint.lower for joint in robot.joints])
        upper = np.array([joint.upper for joint in robot.joints])
        if self.joints is not None:
            if len(self.joints) != len(lower):
                raise StageError(
                    f"robot.limits.joints: {len(self.joints)} ranges, but a {robot.model} has "
                    f"{len(lower)} joints; give one [lower, upper] for each"
                )
            lower = np.maximum(lower, [low for low, _ in self.joints])
            upper = np.minimum(upper, [high for _, high in self.joints])
        if empty := [i + 1 for i in np.flatnonzero(lower >= upper)]:
            raise StageError(
                f"robot.limits.joints: no angle is left for joint {', '.join(map(str, empty))} of "
                f"a {robot.model}; the lower limit comes first"
            )
        centre, size = np.asarray(self.box.centre), np.asarray(self.box.size)
        return MotionLimits(
            centre - size / 2, centre + size / 2,
            self.speed, self.acceleration, self.joint_speed, lower, upper,
        )  # fmt: skip


class NamedSection(RecipeSection):
    """A section that may be one word, its model: ``robot: ur10e``."""

    word: ClassVar[str] = "model"

    @model_validator(mode="before")
    @classmethod
    def _from_a_word(cls, given: Any) -> Any:
        return {cls.word: given} if isinstance(given, str) else given

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        what = "A model's name." if cls.word == "model" else "Its parent frame."
        word = {"type": "string", "description": what}
        section = super().__get_pydantic_json_schema__(core_schema, handler)
        return {"anyOf": [section, word]}


class SecondRobotSection(NamedSection):
    """The arm that carries the target before the first one's camera."""

    model: str
    """A model that 'flangeye robots' lists, or a .yaml file of your own."""


class RobotSection(NamedSection):
    """Which arm, and how to reach it; its plate alone where an archive has the flange's poses."""

    model: str | None = None
    """A model that 'flangeye robots' lists, or a .yaml file of your own."""
    urdf: str | None = None
    """A URDF file, instead of a model; xacro expanded."""
    base: str | None = None
    """With urdf: the link that is the controller's base; found if not given."""
    flange: str | None = None
    """Designation of the plate, such as ISO 9409-1-50-4-M6. With urdf: the link at the plate's
    face, z outwards, found if not given; feature then names the plate."""
    packages: dict[str, str] = Field(default_factory=dict)
    """With urdf: folders of the packages its meshes are in."""
    factory: str | None = None
    """A UR's factory calibration, so that the arm is as it was built: the controller's
    calibration.conf, or the ROS driver's kinematics .yaml."""
    driver: Annotated[BoundPart, Choose("robot")] | None = None
    """How to reach the real arm, for example {ur_rtde: {host: 192.168.1.10}}."""
    limits: LimitsSection | None = None
    """Motion limits of the arm."""

    @model_validator(mode="after")
    def _names_something(self) -> RobotSection:
        if self.model and self.urdf:
            raise ValueError("give either a model or a urdf, not both")
        if self.urdf and self.factory:
            raise ValueError(
                "a urdf brings its own calibration, so that factory has no effect: make the URDF "
                "with it (xacro ur.urdf.xacro kinematics_params:=FILE), or name a model, model: "
                "ur5e, with factory"
            )
        if not self.urdf and (self.base or self.packages):
            raise ValueError("base and packages belong to a urdf; name the urdf too")
        if not (self.model or self.urdf or self.flange):
            raise ValueError(
                "name the arm: model: ur10e ('flangeye robots' lists them), urdf: arm.urdf, or, "
                "where the flange's poses are recorded, its plate alone: flange: "
                "ISO 9409-1-50-4-M6"
            )
        return self


class ScannerSection(NamedSection):
    """Which scanner, and how to reach it; a name and a range do for an archive."""

    model: str | None = None
    """A model that 'flangeye scanners' lists, or a .yaml file of your own."""
    name: str | None = None
    """Name of a scanner without a model."""
    range: tuple[Length, Length] | None = None
    """Nearest and farthest it sees; archives in another unit are noticed."""
    driver: Annotated[BoundPart, Choose("scanner")] | None = None
    """How to reach the real scanner, for example {watched_folder: {path: …}}."""

    @model_validator(mode="after")
    def _names_something(self) -> ScannerSection:
        if bool(self.model) == bool(self.name):
            raise ValueError(
                "name the scanner: model: phoxi-m ('flangeye scanners' lists them), or one that "
                "has no model: {name: ACME 3000, range: [300 mm, 900 mm]}"
            )
        if self.range and not 0 <= self.range[0] < self.range[1]:
            raise ValueError("range: the nearest comes first, for example [300 mm, 900 mm]")
        return self


class SphereSection(RecipeSection):
    """A calibration sphere."""

    diameter: Annotated[Length, Field(gt=0)] | Literal["unknown"]
    """If it is unknown, the depth of the sphere's centre is far less accurate."""
    centre: tuple[Length, Length, Length]
    """Position of the sphere's centre in the frame that carries it; in the flange frame the origin
    is in the face and z points outwards."""


class FeatureSection(RecipeSection):
    """The circle to look for; by default the flange in the robot's file."""

    standard: str | None = None
    """Designation such as ISO 9409-1-50-4-M6, or a .yaml file of your own."""
    wrist_circle: Length | None = None
    """Diameter of the wrist's outer circle, for scanners too coarse for a rim."""
    sphere: SphereSection | None = None
    """A calibration sphere on the flange, used as the target in place of the flange."""


class TargetSection(NamedSection):
    """A body of known shape on the flange, used as the target in place of the flange."""

    word: ClassVar[str] = "body"

    body: str
    """A mesh beside the recipe (STL, PLY, OBJ, glTF, 3MF, STEP), a bundled body, or robot: the
    arm's own links at its joint angles, by its URDF's meshes."""
    links: dict[int, str] = Field({})
    """robot: meshes in metres, by the number of the joint in whose frame each is drawn (0: the
    base); default: those of the URDF."""
    unit: FileUnit | None = None
    """Unit of the mesh's coordinates; found from its size if not given."""
    at: str = "flange"
    """Frame in which the mesh is drawn: flange, link1, link2, … of the arm, or base; unknown: the
    body is fixed to the arm's flange, and its pose on the flange is estimated."""


PlaceChoice = Literal["known", "unknown"] | PlaceParams


class ConfigurationSection(RecipeSection):
    """Who carries the camera and the target; the unknown transforms follow."""

    name: Literal["eye-on-base", "eye-in-hand", "eye-on-arm", "two-arms"] = "eye-on-base"
    camera: str | None = None
    """Frame that carries the camera: base, flange, or link1, link2, … for eye-on-arm."""
    target: str | None = None
    """Frame that carries the target: flange, base or flange2."""
    place: PlaceChoice = "known"
    """Where the target is in that frame: known (at the origin, as the robot's own circles are),
    unknown (a marker), or its position and rpy."""


FrameName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", min_length=1)]


class MountedSection(RecipeSection):
    """Where something of a cell is mounted, by default at a known place."""

    on: str = "base"
    """Frame that it is mounted on: base, or an arm, rail or positioner of the cell by name."""
    place: PlaceChoice = "known"
    """Pose in that frame: known (at its origin), unknown (to be estimated), or position and rpy."""


class CellArmSection(SecondRobotSection, MountedSection):
    """An arm of a cell."""


class AxisSection(MountedSection):
    """Common section of rails and positioners."""

    axis: tuple[float, float, float]
    """Direction of the axis in the frame that it is mounted on."""

    @field_validator("axis")
    @classmethod
    def _points_somewhere(cls, axis: tuple[float, float, float]) -> tuple[float, float, float]:
        if not any(axis):
            raise ValueError("the axis has no direction; write for example [1, 0, 0]")
        return axis


class RailSection(AxisSection):
    """A rail of a cell."""

    travel: tuple[Length, Length] = param(("-1 m", "1 m"))
    """Lowest and highest."""


class PositionerSection(AxisSection):
    """A positioner of a cell: a plate that turns."""

    travel: tuple[Angle, Angle] = param(("-180 deg", "180 deg"))
    """Lowest and highest."""


class StandingSection(NamedSection, MountedSection):
    """A camera or target of a cell; may be one word, its parent frame."""

    word: ClassVar[str] = "on"

    link: int | None = Field(None, ge=1)
    """Which link of that arm it is on, from 1; its flange if not given."""
    place: PlaceChoice = "unknown"
    """Where it is on that: unknown (to be found), or known."""


class CellSection(RecipeSection):
    """A cell of several cameras, arms, rails and targets, solved in one run."""

    arms: dict[FrameName, CellArmSection] = Field(default_factory=dict)
    rails: dict[FrameName, RailSection] = Field(default_factory=dict)
    positioners: dict[FrameName, PositionerSection] = Field(default_factory=dict)
    cameras: dict[FrameName, StandingSection] = Field(min_length=1)
    targets: dict[FrameName, StandingSection] = Field(min_length=1)


class WorkspaceSection(BoxSection):
    """Where the work is, in the robot's base; errors are reported over this box."""


class LogSection(RecipeSection):
    """Data that run.mcap contains besides the results."""

    clouds: Literal["preview", "full"] = "preview"
    """Raw scans: thinned for viewing, or whole, to segment again later."""


class Header(RecipeSection):
    """A recipe, its steps not yet checked."""

    title: str
    """One line shown in reports."""
    description: str = ""
    """A longer description."""
    robot: RobotSection | None = None
    second_robot: SecondRobotSection | None = None
    scanner: ScannerSection | None = None
    configuration: ConfigurationSection = Field(default_factory=ConfigurationSection)
    cell: CellSection | None = None
    feature: FeatureSection = Field(default_factory=FeatureSection)
    target: TargetSection | None = None
    workspace: WorkspaceSection | None = None
    seed: int = Field(0, ge=0)
    """The only source of randomness."""
    log: LogSection = Field(default_factory=LogSection)
    steps: list[Any] = Field(min_length=1)
    """Stages in order, each with parameters."""

"""Values of a recipe's header for its stages, by type: models, mounting, devices.

The value of a section with a mistake is None, so that the mistake is reported once, in the section,
and not again by every step that needs the value.
"""

from collections.abc import Callable, Hashable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flangeye import types as t
from flangeye.devices import RobotDriver, ScannerDriver
from flangeye.errors import RecipeError
from flangeye.models.bodies import ARM, TargetBody, arm_body, load_body
from flangeye.models.cell import Cell
from flangeye.models.configuration import CARRIERS, LINK, ORIGIN, Configuration, Triple
from flangeye.models.loading import load_model
from flangeye.models.model import read_model
from flangeye.models.robots import FlangeDetails, RobotModel, SecondRobot
from flangeye.models.scanners import ScannerData, ScannerModel
from flangeye.models.targets import (
    Flange,
    FlangeStandard,
    Sphere,
    flange_of,
    load_standard,
    wrist_circle_of,
)
from flangeye.plugin.stage import BoundPart, PlaceParams
from flangeye.units import SI
from flangeye.workflow.recipe.header import (
    FeatureSection,
    Header,
    LimitsSection,
    PlaceChoice,
    RobotSection,
    ScannerSection,
    TargetSection,
)

Context = dict[type, Any]
Complain = Callable[[Sequence[Hashable], str], None]


def context_of(header: Header, folder: Path, complain: Complain) -> Context:
    """Return the values that a recipe's sections provide, and report every mistake.

    Args:
        header: Sections of the recipe.
        folder: Folder of the recipe; files it names are beside it.
        complain: Called with place and text of each mistake.
    """
    context: Context = {t.Seed: header.seed}
    offer = partial(_offer, context, complain)
    if header.workspace:
        context[t.Box] = t.Box(np.array(header.workspace.centre), np.array(header.workspace.size))
    if sphere := header.feature.sphere:
        size = None if sphere.diameter == "unknown" else sphere.diameter / 2
        context[Sphere] = Sphere(size=size, centre_in_flange=sphere.centre)
    if (robot := header.robot) and (robot.model or robot.urdf):
        place = ("robot", "model" if robot.model else "urdf")
        offer(RobotModel, place, lambda: _arm(robot, header.feature.standard, folder))
    if target := header.target:
        offer(
            TargetBody, ("target", "body"), lambda: body_of(target, context.get(RobotModel), folder)
        )
    if scanner := header.scanner:
        offer(ScannerData, ("scanner", "model"), lambda: _scanner(scanner, folder))
        if context[ScannerData] is None or isinstance(context[ScannerData], ScannerModel):
            context[ScannerModel] = context[ScannerData]
    if second := header.second_robot:
        place = ("second_robot", "model")
        offer(SecondRobot, place, lambda: SecondRobot(_model(second.model, folder)))
    if header.cell:
        from flangeye.workflow.recipe.cell import cell_of

        context[Cell] = cell_of(header, partial(_model, folder=folder), complain)
    else:
        offer(Configuration, ("configuration",), lambda: _configuration(header, context))
    carries = context.get(RobotModel) or _carrier(context.get(Cell))
    if _plate_named(header, carries):
        offer(Flange, ("feature",), lambda: _flange(header, carries, folder, context))
    _devices(header, context, complain)
    return context


def _offer(
    context: Context,
    complain: Complain,
    offered: type,
    keys: Sequence[Hashable],
    make: Callable[[], Any],
) -> None:
    # There, but without a value: a step that needs it is not reported as well
    context[offered] = None
    try:
        context[offered] = make()
    except RecipeError as error:
        for line in str(error).splitlines():
            complain(keys, line)


def _arm(section: RobotSection, standard: str | None, folder: Path) -> RobotModel:
    if section.model:
        robot = _model(section.model, folder)
        return _as_built(robot, folder / section.factory) if section.factory else robot
    from flangeye.models.urdf import robot_from_urdf

    packages = {name: folder / path for name, path in section.packages.items()}
    path = folder / str(section.urdf)
    return robot_from_urdf(path, section.base, section.flange, standard, packages)


def body_of(target: TargetSection, robot: RobotModel | None, folder: Path) -> TargetBody:
    """Return the body given by a recipe's ``target`` section.

    Args:
        target: The section.
        robot: The recipe's arm, whose links may be the body.
        folder: Folder of the recipe.

    Raises:
        RecipeError: The file cannot be read, or is outside the allowed folders.
    """
    if target.body != ARM:
        if target.links:
            raise RecipeError(
                f"target.links: is for body: {ARM} only; remove it, or write body: {ARM}"
            )
        return load_body(target.body, target.unit, folder)
    if target.at != "flange":
        raise RecipeError(
            f"body: {ARM} is the whole arm, which no frame carries; remove at: {target.at}"
        )
    return arm_body(robot, target.links, folder)


def _as_built(robot: RobotModel, calibration: Path) -> RobotModel:
    from flangeye.models.factory import as_built

    return as_built(robot, calibration)


def _model(name: str, folder: Path) -> RobotModel:
    robot: RobotModel = load_model("robots", name, folder)
    return robot


def _scanner(section: ScannerSection, folder: Path) -> ScannerData:
    if section.model:
        scanner: ScannerData = load_model("scanners", section.model, folder)
        return scanner
    near, far = map(SI, section.range) if section.range else (None, None)
    return ScannerData(model=str(section.name), near=near, far=far)


def _carrier(cell: Cell | None) -> RobotModel | None:
    """Return the arm of a cell whose flange is the target: the first that carries one."""
    carriers = [cell.frames[target].parent for target in cell.targets] if cell else []
    arms = [cell.movers.get(carrier) for carrier in carriers] if cell else []
    return next((arm for arm in arms if isinstance(arm, RobotModel)), None)


def _plate_named(header: Header, robot: RobotModel | None) -> bool:
    feature = header.feature
    asked = _plate(header)
    return any((feature.standard, feature.wrist_circle, asked, robot and robot.flange.standard))


def _plate(header: Header) -> str | None:
    robot = header.robot
    return robot.flange if robot and not robot.urdf else None


def _flange(header: Header, robot: RobotModel | None, folder: Path, context: Context) -> Flange:
    feature = header.feature
    _refuse_two(feature)
    details = robot.flange if robot else FlangeDetails(standard=_plate(header))
    if not feature.wrist_circle:
        named = feature.standard or _plate(header) or details.standard
        return flange_of(details, _standard(named, folder, context))
    if robot is None:
        raise RecipeError(
            "wrist_circle: how far it lies behind the flange's face is in the robot's file "
            "(flange.thickness); name the robot's model"
        )
    return wrist_circle_of(details, feature.wrist_circle)


def _refuse_two(feature: FeatureSection) -> None:
    if feature.standard and feature.wrist_circle:
        raise RecipeError("give either a standard or a wrist_circle, not both")
    if feature.sphere and feature.wrist_circle:
        raise RecipeError("give either a sphere or a wrist_circle, not both")


def _standard(designation: str | None, folder: Path, context: Context) -> FlangeStandard:
    if not str(designation).endswith((".yaml", ".yml")):
        return load_standard(str(designation))
    own = context[FlangeStandard] = read_model(folder / str(designation), FlangeStandard)
    return own


def _configuration(header: Header, context: Context) -> Configuration:
    """Return the configuration of a recipe, its frames filled in and checked."""
    section = header.configuration
    cameras, targets = CARRIERS[section.name]
    camera, target = section.camera or cameras[0], section.target or targets[0]
    stands = _stands(section.place)
    if body := header.target:
        if section.place != "known":
            raise RecipeError("place: target: {at: …} states a body's place; remove place:")
        stands = None if body.at == "unknown" else stands
        target = target if body.at == "unknown" else _carrier_of(body.at, section.name, context)
        targets = target, *targets
    if LINK in cameras:
        _require_link(section.name, camera, "camera", context)
    elif camera not in cameras:
        raise RecipeError(f"{section.name}: the camera is carried by {cameras[0]}, not by {camera}")
    if target not in targets:
        allowed = " or ".join(targets)
        raise RecipeError(f"{section.name}: the target is carried by {allowed}, not by {target}")
    return Configuration(section.name, camera, target, stands)


def _stands(place: PlaceChoice) -> tuple[Triple, Triple] | None:
    if isinstance(place, PlaceParams):
        return place.position, place.rpy
    return ORIGIN if place == "known" else None


def _carrier_of(at: str, configuration: str, context: Context) -> str:
    """Return the frame that carries a body; a link only where the camera is beside the arm."""
    targets, links = CARRIERS[configuration][1], ""
    if configuration == "eye-on-base":
        if at.startswith(LINK):
            _require_link(configuration, at, "at", context)
            return at
        links = f", {LINK}1, {LINK}2, …"
    if at not in targets:
        from_arm = "; a body on the base needs a camera on the arm, as in eye-in-hand"
        raise RecipeError(
            f"{configuration}: target: {{at: …}} is {', '.join(targets)}{links} or unknown, not "
            f"{at}{from_arm if at == t.BASE else ''}"
        )
    return at


def _require_link(configuration: str, carrier: str, key: str, context: Context) -> None:
    if RobotModel not in context:
        raise RecipeError(
            f"{configuration}: a link's pose is computed by the arm's kinematics; name the robot's "
            "model"
        )
    robot: RobotModel | None = context[RobotModel]
    links = [f"{LINK}{i + 1}" for i in range(len(robot.joints) if robot else 0)]
    if robot and carrier not in links:
        raise RecipeError(
            f"{configuration}: the {'target' if key == 'at' else key} is carried by a link, "
            f"{links[0]} to {links[-1]}, not by {carrier}; write for example {key}: "
            f"{links[len(links) // 2 - 1]}"
        )


def _check_limits(limits: LimitsSection, robot: RobotModel, complain: Complain) -> None:
    """Report limits that exceed the arm's capabilities, which are probably typing errors."""
    if limits.joint_speed > robot.joint_speed:
        complain(
            ("robot", "limits", "joint_speed"),
            f"at most {np.degrees(robot.joint_speed):.4g} deg/s for a {robot.model}, "
            f"not {np.degrees(limits.joint_speed):.4g} deg/s",
        )
    # The nearest point of the box to the base decides whether any of it can be reached
    low = np.asarray(limits.box.centre) - np.asarray(limits.box.size) / 2
    high = low + np.asarray(limits.box.size)
    nearest, most = float(np.linalg.norm(np.clip(0.0, low, high))), 4 * robot.length
    if nearest > robot.length or np.any(high - low > most):
        complain(
            ("robot", "limits", "box"),
            f"is not a box for a {robot.model}, which reaches {robot.length:.2f} m from its base: "
            f"each side is at most {most:.2f} m, and some of it is within reach",
        )


def _devices(header: Header, context: Context, complain: Complain) -> None:
    """Offer the devices the header names, not yet opened, and the limits of the arm."""
    robot, scanner = header.robot, header.scanner
    if robot and robot.driver:
        if robot.limits is None:
            complain(
                ("robot",),
                "a robot with a driver needs limits, for example "
                + "{box: {centre: [500 mm, 0 mm, 400 mm], size: [800 mm, 800 mm, 800 mm]}}",
            )
        context[RobotDriver] = _robot_driver(robot.driver, context.get(RobotModel))
        context[LimitsSection] = robot.limits
        if robot.limits and (model := context.get(RobotModel)):
            _check_limits(robot.limits, model, complain)
    if scanner and scanner.driver:
        context[ScannerDriver] = ScannerDriver(
            scanner.driver.part.name, partial(scanner.driver, context.get(ScannerModel))
        )


def _robot_driver(driver: BoundPart, model: RobotModel | None) -> RobotDriver:
    part, opened = driver.part, partial(driver, model)
    # A driver that talks to a person, or moves nothing, has nothing to command in the first place.
    harmless = opened if part.interactive or part.simulated or part.passive else None
    read = partial(opened, reads_only=True) if part.can_only_read else harmless
    return RobotDriver(part.name, opened, read, part.interactive, part.simulated, part.passive)

"""Checks of a weld before anything moves; every error message says what to change."""

from __future__ import annotations

import numpy as np

from flangeye.devices import RobotDriver
from flangeye.errors import StageError
from flangeye.maths.seam_geometry import tube_radii
from flangeye.models.finger import Finger
from flangeye.motion.limits import MotionLimits
from flangeye.plugin.stage import BoundPart
from flangeye.types import Floats, Seam
from flangeye_plugins.weld.following.model_prior import ModelPrior
from flangeye_plugins.weld.following.steering import Steering, Weave
from flangeye_plugins.weld.frame import LeaningTool, WorkSurface
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.reachability import flange_speed
from flangeye_plugins.weld.settings import ControllerChoice, Following
from flangeye_plugins.weld.touch.tag_observation import TagDetector

SEATING = 1.4
"""Smallest allowed ratio of the force into the joint to the force that lifts the tip."""


def check_finger(finger: Finger, settings: Following) -> None:
    """Refuse a deflection or force beyond the finger's limits, or a tag that OpenCV does not know.

    Raises:
        StageError: The message names the value and its limit.
    """
    TagDetector(finger)
    asked = max(settings.deflection, settings.preload)
    if asked > finger.travel:
        raise StageError(
            f"weld.tactile: a deflection of {asked * 1e3:.3g} mm exceeds the limit "
            f"of finger {finger.model}, {finger.travel * 1e3:.3g} mm"
        )
    force = finger.force(np.array([0.0, settings.deflection, settings.preload]))
    if force is not None and force > finger.largest_force:
        raise StageError(
            f"weld.tactile: deflection and preload press with {force:.2g} N, limit "
            f"{finger.largest_force:.2g} N; lower them, or raise 'largest_force' "
            "in the finger's file"
        )


def check_controller(mode: ControllerChoice, driver: RobotDriver) -> None:
    """Refuse a simulation-only controller on a real arm.

    Raises:
        StageError: The driver does not declare that its arm is simulated.
    """
    if isinstance(mode, BoundPart) and mode.part.simulation_only and not driver.simulated:
        raise StageError(
            f"weld.tactile: {mode.part.name} is known to diverge and runs on a simulated arm "
            f"only; {driver.name} is not one; use mode: tactile"
        )


def check_tool(body: LeaningTool, prior: ModelPrior, settings: Following) -> None:
    """Refuse a tool that cannot hold its tip in the joint, reach the seam or weave as configured.

    Raises:
        StageError: The message names the failed check and the remedy.
    """
    check_seat(prior, settings)
    check_body(body, prior, settings)
    check_weave(body.distance, settings)


def check_seat(prior: ModelPrior, settings: Following) -> None:
    """Refuse settings with which the tip would not stay where the joint's two walls meet.

    Raises:
        StageError: The message says why, and which values would hold the tip.
    """
    if settings.joint == "butt" and prior.joint is None:
        raise StageError(
            "weld.tactile: a butt joint with square edges is felt by a ball that rests on both: "
            f"set 'root_gap', less than {2e3 * prior.radius:.3g} mm for a ball of radius "
            f"{1e3 * prior.radius:.3g} mm, or take a larger tip; a prepared one is joint: groove"
        )
    holding = prior.seating(settings)
    if holding is not None and holding < SEATING:
        deflection, preload = prior.remedy(settings, SEATING)
        raise StageError(
            "weld.tactile: the tip would climb the wall: the preload holds it with "
            f"{holding:.2f} times the force of the deflection, and {SEATING} is needed; lower "
            f"'deflection' to {deflection * 1e3:.2f} mm or raise "
            f"'preload' to {preload * 1e3:.1f} mm"
        )
    reaching = prior.reaching(settings)
    if not prior.two_walls and reaching < SEATING:
        raise StageError(
            "weld.tactile: friction may hold the tip off the wall: the deflection pushes "
            f"with {reaching:.2f} times the plate's friction, and {SEATING} is needed; raise "
            "'deflection', lower 'preload', or lean the tool less ('work_angle')"
        )


def check_body(body: LeaningTool, prior: ModelPrior, settings: Following) -> None:
    """Refuse a lean of the tool that puts the torch too far above or below the seam.

    Raises:
        StageError: The message gives the height and the remedy.
    """
    above = float(body.torch[2]) + (prior.joint.seat(prior.radius)[1] if prior.joint else 0.0)
    if abs(above) > settings.torch_height:
        raise StageError(
            f"weld.tactile: the tool's lean puts its torch {above * 1e3:+.1f} mm above the seam, "
            f"limit {settings.torch_height * 1e3:.3g} mm; change 'travel_angle', or "
            "set torch_up in the finger's file to where the torch's end is"
        )


def check_weave(distance: float, settings: Following) -> None:
    """Refuse a weave that needs a faster rotation of the tool than ``turn_rate``.

    Raises:
        StageError: The message gives the needed speed and the remedy.
    """
    weave = Weave(settings.weave_width, settings.weave_frequency)
    asked, allowed = weave.fastest / distance, Steering.usual * settings.turn_rate
    if asked > allowed:
        raise StageError(
            f"weld.tactile: a weave of {weave.width * 1e3:.3g} mm at "
            f"{weave.frequency:.3g} Hz turns the tool at {np.degrees(asked):.0f} deg/s, "
            f"limit {np.degrees(allowed):.0f} deg/s ({Steering.usual:.0%} of turn_rate); lower "
            f"'weave_frequency' to {weave.frequency * allowed / asked:.2f}, or raise "
            "'turn_rate'"
        )


def check_seam(seam: Seam, surface: WorkSurface, distance: float, settings: Following) -> None:
    """Refuse a seam that this tool cannot follow.

    Raises:
        StageError: The seam is too short, too sharply curved or too uncertain.
    """
    plan = surface.path
    used = settings.set_down + settings.ending
    used += settings.speed * settings.deflection / settings.release
    if plan.length <= used:
        raise StageError(
            f"weld.tactile: the seam is {plan.length * 1e3:.0f} mm long; inset, ending and release "
            f"alone take {used * 1e3:.0f} mm"
        )
    bent = surface.bending(distance)
    # Where the tool leans by more its tip no longer bears on both walls alike.
    if bent > np.radians(30.0):
        raise StageError(
            f"weld.tactile: the seam bends out of its surface so much that over the "
            f"{distance * 1e3:.0f} mm from the torch to the tip the tool would lean by "
            f"{np.degrees(bent):.0f} deg, limit 30 deg; end the plan before the bend, or take a "
            "tool whose torch is nearer to its tip"
        )
    crooked = float(np.abs(tool_angles(plan, distance)).max())
    if crooked > np.radians(60.0):  # beyond, the torch would be pushed
        raise StageError(
            f"weld.tactile: the seam is too curved for a torch {distance * 1e3:.0f} mm behind "
            f"the tip: the tool would be at {np.degrees(crooked):.0f} deg to it, limit "
            "60 deg; end the plan before the bend, or take a tool whose torch "
            "is nearer to its tip"
        )
    fault = float(tube_radii(seam)[0])
    if fault > settings.reach:
        raise StageError(
            f"weld.tactile: the plan's start is uncertain by {fault * 1e3:.1f} mm, the groove is "
            f"sought within {settings.reach * 1e3:.1f} mm; plan the start more accurately, or "
            f"raise 'reach'"
        )


def tool_angles(plan: Path, distance: float) -> Floats:
    """Return the tool's angles to the seam at the torch [rad], with tip and torch on the plan."""
    ahead = np.arange(distance, plan.length + distance, 1e-3)
    tips, _ = plan.evaluate(ahead)
    torches, tangents = plan.evaluate(plan.other_end(ahead, -distance))
    tool = (tips - torches)[:, :2]
    across = tangents[:, 0] * tool[:, 1] - tangents[:, 1] * tool[:, 0]
    return np.asarray(np.arctan2(across, np.einsum("ki,ki->k", tangents, tool)))


def check_speeds(finger: Finger, settings: Following, limits: MotionLimits) -> None:
    """Refuse speeds of flange or joints beyond the recipe's limits.

    Raises:
        StageError: The message names the speed and its limit.
    """
    fastest = flange_speed(finger, settings)
    if fastest > limits.speed:
        raise StageError(
            f"weld.tactile: speed and turn_rate together move the flange at "
            f"{fastest * 1e3:.3g} mm/s, robot.limits.speed allows {limits.speed * 1e3:.3g} mm/s"
        )

"""Commands that feel: force mode, the force sensor's zero, contact."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.controllers.arm import ForceMode
from flangeye_emulators.controllers.motion import Speed
from flangeye_emulators.controllers.poses import rotation_matrix
from flangeye_emulators.controllers.ur.commands.moves import to_pose
from flangeye_emulators.controllers.ur.program import ProgramError, Thread

if TYPE_CHECKING:
    from flangeye_emulators.controllers.ur.script import ControlScript


def force_mode(script: ControlScript) -> None:
    """6, forceMode: give way along axes of a frame that is fixed in the base."""
    kind = script.integer(1)
    plain = 2  # the frame is taken as it is given
    if kind != plain:
        raise ProgramError(f"force mode type {kind} is not simulated; {plain} is")
    script.orders.force = ForceMode(
        base_R_task=rotation_matrix(script.numbers(3, 3)),
        compliant=np.array([script.integer(2 + i) != 0 for i in range(6)]),
        wrench=script.numbers(6),
        fastest=np.abs(script.numbers(12)),
        gain=script.orders.force_gain,
    )
    if not script.runs("force"):
        script.start("force", _keep_force(script))


def _keep_force(script: ControlScript) -> Thread:
    while True:
        script.arm.force_mode = script.orders.force
        yield


def stop_force_mode(script: ControlScript) -> Thread:
    """7, forceModeStop."""
    script.kill("force")
    script.arm.force_mode = None
    script.critical = True
    # Deceleration at the end of force mode [m/s^2]
    yield from script.stop_in_space(10.0)
    script.critical = False


def set_force_gain(script: ControlScript) -> None:
    """21, forceModeSetGainScaling."""
    script.orders.force_gain = min(max(script.number(0), 0.0), 2.0)


def zero_force_sensor(script: ControlScript) -> None:
    """8, zeroFtSensor: what is felt now counts as nothing."""
    script.arm.zero_force()


def steps_since_contact(history: Sequence[tuple[Floats, Floats]], direction: Floats) -> int:
    """Return how many cycles ago the tool touched something, 0 while it touches nothing.

    Args:
        history: (joints, wrench) of the last cycles, the present last.
        direction: (3,) along which contact is looked for; only forces against it count.
    """
    length = float(np.linalg.norm(direction))
    if length == 0.0:
        return 0
    ahead = direction / length
    # Force against the direction that counts as contact [N]; the sensor's precision is 3.5 N
    if -float(history[-1][1][:3] @ ahead) < 5.0:
        return 0
    steps = 0
    for _, wrench in reversed(history):
        # Force at which a contact is taken to have begun [N]
        if -float(wrench[:3] @ ahead) < 0.2:
            break
        steps += 1
    return max(steps, 1)


def contact_steps(script: ControlScript, direction: Floats) -> int:
    """Return the steps since contact along a direction (6,), or along the motion if it is zero."""
    along = direction[:3] if direction.any() else script.arm.twist[:3]
    return steps_since_contact(script.arm.history, along)


def tool_contact(script: ControlScript) -> None:
    """25, toolContact."""
    script.give_integer(contact_steps(script, script.numbers(0)))


def move_until_contact(script: ControlScript) -> Thread:
    """51, moveUntilContact: at a velocity until something is touched, then back to the touch."""
    velocity, direction = script.numbers(0), script.numbers(6)
    motion = Speed(script.arm.twist, velocity, script.number(12), in_space=True)
    while not (steps := contact_steps(script, direction)):
        script.drive(motion)
        yield
    yield from go_back_to_contact(script, steps)


def go_back_to_contact(script: ControlScript, steps: int) -> Thread:
    """Stop, and go back to where the tool was ``steps`` cycles ago."""
    arm = script.arm
    joints = arm.history[-min(steps + 1, len(arm.history))][0]
    contact = arm.chain.stance(joints).base_T_tcp
    # Deceleration after a contact [m/s^2], and how the tool goes back to it: the script's numbers
    yield from script.stop_in_space(3.0)
    # [m/s, m/s^2]
    yield from script.complete(lambda: to_pose(arm, contact, 0.25, 1.2))


INTERNAL_CONTACT = 254


def start_contact_detection(script: ControlScript) -> None:
    """62, startContactDetection: a move in the background ends at the next contact."""
    script.orders.contact_steps = 0
    script.start("contact", _watch_contact(script, script.numbers(0)))


def _watch_contact(script: ControlScript, direction: Floats) -> Thread:
    while contact_steps(script, direction):
        yield
    while not (steps := contact_steps(script, direction)):
        yield
    script.orders.contact_steps = steps
    script.internal = INTERNAL_CONTACT


def stop_contact_detection(script: ControlScript) -> None:
    """63, stopContactDetection; answers whether there was a contact."""
    script.kill("contact")
    script.give_integer(script.orders.contact_steps)


def read_contact_detection(script: ControlScript) -> None:
    """64, readContactDetection."""
    script.give_integer(script.orders.contact_steps)


def end_move_at_contact(script: ControlScript) -> Thread:
    """254, given by the script itself."""
    script.abandon_move()
    yield from go_back_to_contact(script, script.orders.contact_steps)


COMMANDS = {
    6: force_mode,
    7: stop_force_mode,
    8: zero_force_sensor,
    21: set_force_gain,
    25: tool_contact,
    51: move_until_contact,
    62: start_contact_detection,
    63: stop_contact_detection,
    64: read_contact_detection,
    INTERNAL_CONTACT: end_move_at_contact,
}

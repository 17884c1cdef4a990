"""Commands a client sends again and again: velocities, joint angles to follow, jogging."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from flangeye_emulators.controllers.motion import Servo, Speed
from flangeye_emulators.controllers.poses import rotation_matrix
from flangeye_emulators.controllers.ur.commands.moves import joints_at
from flangeye_emulators.controllers.ur.program import ProgramError, Thread
from flangeye_emulators.controllers.ur.script import ServoOrder, SpeedOrder

if TYPE_CHECKING:
    from flangeye_emulators.controllers.ur.script import ControlScript


def order_speed(script: ControlScript, in_space: bool) -> None:
    """9 and 10, speedJ and speedL: hand the order to the speed thread.

    The time in register 7 has no effect: the script's thread says the same again when it is over,
    so an arm goes on at its last velocity until it is stopped. That is what ur_rtde 1.6 does.
    """
    script.orders.speed = SpeedOrder(in_space, script.numbers(0), script.number(6))
    if not script.runs("speed"):
        script.start("speed", _keep_speed(script))


def _keep_speed(script: ControlScript) -> Thread:
    motion: Speed | None = None
    while True:
        order = script.orders.speed
        if order is None:
            return
        if motion is None or motion.in_space is not order.in_space:
            velocity = script.arm.twist if order.in_space else script.arm.speeds
            motion = Speed(velocity, order.target, order.acceleration, order.in_space)
        motion.target, motion.acceleration = order.target, order.acceleration
        script.drive(motion)
        yield


def stop_speed(script: ControlScript) -> Thread:
    """15, speedStop: as the velocity was meant, in space or in joints."""
    deceleration = script.number(0)
    in_space = script.orders.speed is None or script.orders.speed.in_space
    script.kill("speed")
    script.critical = True
    stop = script.stop_in_space if in_space else script.stop_joints
    yield from stop(deceleration)
    script.critical = False


def servo_joints(script: ControlScript) -> None:
    """11, servoJ."""
    _order_servo(script, script.numbers(0))


def servo_in_space(script: ControlScript) -> None:
    """24, servoL."""
    _order_servo(script, joints_at(script.arm, script.numbers(0)))


def _order_servo(script: ControlScript, target: np.ndarray) -> None:
    lookahead = max(script.number(9), 0.03)
    script.orders.servo = ServoOrder(target, lookahead, script.number(10))
    if not script.runs("servo"):
        script.start("servo", _follow(script))


def _follow(script: ControlScript) -> Thread:
    arm = script.arm
    motion = Servo(arm.stance.joints, arm.speeds, arm.speed_limits)
    while True:
        order = script.orders.servo
        if order is None:
            return
        motion.target = order.target
        motion.lookahead, motion.gain = order.lookahead, order.gain
        script.drive(motion)
        yield


def stop_servo(script: ControlScript) -> Thread:
    """16, servoStop."""
    script.kill("servo")
    yield from script.stop_in_space(script.number(0))


def start_jog(script: ControlScript) -> None:
    """41, jogStart: a velocity along the axes that the base, the tool or a frame has now."""
    feature = round(script.number(6))
    axes = np.eye(3)
    # The tool's frame
    if feature == 1:
        axes = script.arm.stance.base_T_tcp[:3, :3]
    # A frame of the caller's
    elif feature == 2:
        axes = rotation_matrix(script.numbers(11, 3))
    elif feature != 0:
        raise ProgramError(f"jog feature {feature} is unknown")
    if script.runs("jog"):
        axes = script.orders.jog_axes
    script.orders.jog_axes = axes
    speed = script.numbers(0)
    twist = np.concatenate([axes @ speed[:3], axes @ speed[3:]])
    script.orders.speed = SpeedOrder(True, twist, script.number(7))
    if not script.runs("jog"):
        script.start("jog", _keep_speed(script))


def stop_jog(script: ControlScript) -> Thread:
    """42, jogStop."""
    script.kill("jog")
    # Deceleration at the end of jogging [m/s^2]
    yield from script.stop_in_space(1.2)


COMMANDS: dict[int, Callable[[ControlScript], Thread | None]] = {
    9: partial(order_speed, in_space=False),
    10: partial(order_speed, in_space=True),
    11: servo_joints,
    15: stop_speed,
    16: stop_servo,
    24: servo_in_space,
    41: start_jog,
    42: stop_jog,
}

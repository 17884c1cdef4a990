"""The commands of the control script by number: handlers that act at once or return a thread.

Moves with an end: in joint angles, straight, along a path, and stops.

Commands a client sends again and again: velocities, joint angles to follow, jogging.

Commands that feel: force mode, the force sensor's zero, contact.

Commands that ask, with answers in the output registers, and commands that set something.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.controllers.arm import BRAKES, ForceMode, SimulatedArm
from flangeye_emulators.controllers.motion import (
    JOINTS,
    POSES,
    ControllerMotion,
    Servo,
    Speed,
    Travel,
    Waypoint,
    joint_move,
    linear_move,
)
from flangeye_emulators.controllers.poses import (
    UnreachableError,
    pose_matrix,
    pose_vector,
    rotation_matrix,
)
from flangeye_emulators.controllers.ur.program import ProgramError, Thread
from flangeye_emulators.controllers.ur.script import ControlScript, Move, ServoOrder, SpeedOrder

Handler = Callable[[ControlScript], Thread | None]

STREAMED = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, *range(66, 72)})
"""Commands the script takes up again in every cycle."""


def joints_at(arm: SimulatedArm, pose: Floats, near: Floats | None = None) -> Floats:
    """Return the joint angles (6,) for a pose (6,), nearest to ``near`` or to the present ones.

    Raises:
        ProgramError: There are none.
    """
    target = pose_matrix(pose)
    here = arm.stance if near is None else arm.chain.stance(near)
    try:
        joints = arm.chain.solve(target, here).joints
        if ((joints >= arm.chain.lower) & (joints <= arm.chain.upper)).all():
            return joints
    except UnreachableError:
        pass
    try:
        return arm.chain.solve_any(target, here.joints)
    except UnreachableError as error:
        raise ProgramError(f"get_inverse_kin: {error}") from None


def to_joints(arm: SimulatedArm, joints: Floats, speed: float, acceleration: float) -> Travel:
    """Return a move to joint angles (6,) at which no joint turns faster than it can."""
    start = arm.stance.joints
    return joint_move(start, joints, min(speed, _fastest(arm, start, joints)), acceleration)


def _fastest(arm: SimulatedArm, start: Floats, end: Floats) -> float:
    """Return the leading joint's speed at which the first joint reaches its limit [rad/s]."""
    way = np.abs(end - start)
    return float(np.min(arm.speed_limits * way.max() / np.maximum(way, 1e-300)))


def to_pose(arm: SimulatedArm, pose: Floats, speed: float, acceleration: float) -> Travel:
    """Return a straight move to a pose (4, 4)."""
    return linear_move(arm.stance.base_T_tcp, pose, speed, acceleration)


def _move(script: ControlScript, plan: Callable[[float, float], ControllerMotion]) -> Thread | None:
    """Do a move with the speed and acceleration in registers 6 and 7, waiting for it or not."""
    speed, acceleration = script.number(6), script.number(7)
    return _do(script, script.complete(lambda: plan(speed, acceleration)))


def _do(script: ControlScript, thread: Thread) -> Thread | None:
    """Run a thread here, or in the background when integer 1 says so."""
    script.abandon_move()
    if script.integer(1) != 1:
        return thread
    script.start("move", script.in_background(thread))
    return None


def move_joints(script: ControlScript) -> Thread | None:
    """1, moveJ: to joint angles."""
    target = script.numbers(0)
    return _move(script, lambda v, a: to_joints(script.arm, target, v, a))


def move_joints_to_pose(script: ControlScript) -> Thread | None:
    """2, moveJ_IK: to a pose, straight in joint angles."""
    target = joints_at(script.arm, script.numbers(0))
    return _move(script, lambda v, a: to_joints(script.arm, target, v, a))


def move_straight(script: ControlScript) -> Thread | None:
    """3, moveL: straight to a pose."""
    target = pose_matrix(script.numbers(0))
    return _move(script, lambda v, a: to_pose(script.arm, target, v, a))


def move_straight_to_joints(script: ControlScript) -> Thread | None:
    """4, moveL_FK: straight to where joint angles put the tool."""
    target = script.arm.chain.stance(script.numbers(0)).base_T_tcp
    return _move(script, lambda v, a: to_pose(script.arm, target, v, a))


def move_path(script: ControlScript) -> Thread | None:
    """45, moveL, moveJ or movePath with several waypoints: those written into the script."""
    return _do(script, along_path(script))


def along_path(script: ControlScript) -> Thread:
    """Go through the script's moves; those of one kind that blend into each other in one go."""
    index = 0
    while index < len(script.path):
        last = _end_of_run(script, index)
        run = list(script.path[index : last + 1])
        yield from _show_and_follow(script, run, index)
        index = last + 1


def _show_and_follow(script: ControlScript, run: list[Move], index: int) -> Thread:
    """Go along moves that blend, and show the number of the one under way."""
    if not script.arm.standing:
        yield from script.stop_joints(BRAKES)
    ride, shown = travel(script.arm, run), -1
    while not ride.done:
        if ride.heading != shown:
            shown = ride.heading
            script.show_progress(index + shown)
        script.drive(ride)
        yield


def _end_of_run(script: ControlScript, index: int) -> int:
    """Return the last move that blends on from the one at ``index``."""
    path = script.path
    while (
        index + 1 < len(path) and path[index].blend > 0 and path[index + 1].kind == path[index].kind
    ):
        index += 1
    return index


def travel(arm: SimulatedArm, run: list[Move]) -> Travel:
    """Return a motion through moves of one kind, from the arm's present place."""
    acceleration = min(move.acceleration for move in run)
    if run[0].kind == "movej":
        targets = [joints_at(arm, m.target) if m.is_pose else m.target for m in run]
        starts = [arm.stance.joints, *targets]
        speeds = [
            min(move.speed, _fastest(arm, *ends))
            for move, ends in zip(run, pairwise(starts), strict=True)
        ]
        return Travel(JOINTS, starts[0], _waypoints(run, targets, speeds), acceleration)
    targets = [
        pose_matrix(m.target) if m.is_pose else arm.chain.stance(m.target).base_T_tcp for m in run
    ]
    speeds = [move.speed for move in run]
    return Travel(POSES, arm.stance.base_T_tcp, _waypoints(run, targets, speeds), acceleration)


def _waypoints(run: list[Move], targets: list[Floats], speeds: list[float]) -> list[Waypoint]:
    return [Waypoint(t, v, move.blend) for t, v, move in zip(targets, speeds, run, strict=True)]


def stop_move(script: ControlScript) -> Thread | None:
    """33 and 34, stopL and stopJ. Which of the two it is, is the script's secret: see Orders."""
    deceleration = script.number(0)
    if script.kill("stop"):
        script.show_progress(None)
    else:
        script.abandon_move()
    if script.integer(1) == 1:
        script.orders.stops_in_space = True
        script.start("stop", script.in_background(script.stop_in_space(deceleration)))
        return None
    if script.orders.stops_in_space:
        return script.stop_in_space(deceleration)
    return script.stop_joints(deceleration)


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
    """15, speedStop: stop in the space of the velocity command, Cartesian or joint."""
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


def force_mode(script: ControlScript) -> None:
    """6, forceMode: comply along axes of a frame fixed in the base."""
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
    """8, zeroFtSensor: the present force becomes zero."""
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
    """254, issued by the script itself."""
    script.abandon_move()
    yield from go_back_to_contact(script, script.orders.contact_steps)


def joint_history(script: ControlScript) -> Floats:
    """Return joint angles some cycles ago."""
    history = script.arm.history
    steps = min(max(script.integer(1), 0), len(history) - 1)
    return history[-1 - steps][0]


def _reaches(script: ControlScript, near: Floats | None = None) -> bool:
    try:
        joints_at(script.arm, script.numbers(0), near)
    except ProgramError:
        return False
    return True


def _inside(script: ControlScript) -> bool:
    """Return whether joint angles are within the limits."""
    joints, chain = script.numbers(0), script.arm.chain
    return bool(((joints >= chain.lower) & (joints <= chain.upper)).all())


NUMBERS: Mapping[int, Callable[[ControlScript], Floats]] = {
    26: lambda s: np.array([s.box.box.cycle]),  # getStepTime
    27: joint_history,  # getActualJointPositionsHistory
    # getInverseKinematics with joint angles to be near to; without, near the present ones
    30: lambda s: joints_at(s.arm, s.numbers(0), s.numbers(6)),
    46: lambda s: joints_at(s.arm, s.numbers(0)),
    # getJointTorques: those that hold against what is touched; the arm has no weight
    38: lambda s: s.arm.stance.jacobian.T @ s.arm.wrench,
    39: lambda s: pose_vector(pose_matrix(s.numbers(0)) @ pose_matrix(s.numbers(6))),  # poseTrans
    40: lambda s: pose_vector(s.arm.chain.flange_T_tcp),  # getTCPOffset
    43: lambda s: s.box.tcp_pose(),  # getForwardKinematics of the present joint angles and tool
    # getForwardKinematics of joint angles and a tool, registers 6 to 11: a client that gives no
    # tool does not write them, so they hold what was there before.
    44: lambda s: pose_vector(s.arm.chain.flange(s.numbers(0)) @ pose_matrix(s.numbers(6))),
    # getActualToolFlangePose
    58: lambda s: pose_vector(s.arm.chain.flange(s.arm.stance.joints)),
}
"""Questions that are answered with numbers."""

INTEGERS: Mapping[int, Callable[[ControlScript], int]] = {
    36: _reaches,  # isPoseWithinSafetyLimits: here, whether the arm reaches it
    37: _inside,  # isJointsWithinSafetyLimits
    47: lambda s: s.arm.standing,  # isSteady
    60: _reaches,  # getInverseKinematicsHasSolution; with joint angles to be near to:
    61: lambda s: _reaches(s, s.numbers(6)),
}
"""Questions that are answered with an integer."""


def set_payload(script: ControlScript) -> None:
    """17 and 65, setPayload and setTargetPayload; a centre of zeros keeps the old one."""
    centre = script.numbers(1, 3)
    script.box.payload = (
        script.number(0),
        centre if centre.any() else script.box.payload[1],
    )


def set_tool(script: ControlScript) -> None:
    """29, setTcp."""
    script.arm.set_tool(pose_matrix(script.numbers(0)))


def protective_stop(script: ControlScript) -> None:
    """31, triggerProtectiveStop."""
    script.box.protective_stop("commanded")


def set_watchdog(script: ControlScript) -> None:
    """35, setWatchdog: stop the program when commands come more slowly than [Hz]."""
    script.box.set_watchdog(script.offset, script.number(0))


def accept(script: ControlScript) -> None:
    """Accept a setting that has no effect on this arm."""
    del script


def _numbers(ask: Callable[[ControlScript], Floats]) -> Callable[[ControlScript], None]:
    return lambda script: script.give_numbers(ask(script))


def _integer(ask: Callable[[ControlScript], int]) -> Callable[[ControlScript], None]:
    return lambda script: script.give_integer(ask(script))


COMMANDS: dict[int, Handler] = {
    1: move_joints,
    2: move_joints_to_pose,
    3: move_straight,
    4: move_straight_to_joints,
    33: stop_move,
    34: stop_move,
    45: move_path,
    9: partial(order_speed, in_space=False),
    10: partial(order_speed, in_space=True),
    11: servo_joints,
    15: stop_speed,
    16: stop_servo,
    24: servo_in_space,
    41: start_jog,
    42: stop_jog,
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
    **{number: _numbers(ask) for number, ask in NUMBERS.items()},
    **{number: _integer(ask) for number, ask in INTEGERS.items()},
    17: set_payload,
    20: accept,  # force mode damping
    29: set_tool,
    31: protective_stop,
    35: set_watchdog,
    56: accept,  # external force sensor through RTDE
    57: accept,  # external force sensor
    59: accept,  # gravity
    65: set_payload,
}

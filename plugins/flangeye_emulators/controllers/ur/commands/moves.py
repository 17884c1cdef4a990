"""Moves with an end: in joint angles, straight, along a path, and stops."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.controllers.arm import BRAKES, SimulatedArm
from flangeye_emulators.controllers.motion import ControllerMotion, Travel, joint_move, linear_move
from flangeye_emulators.controllers.poses import UnreachableError, pose_matrix
from flangeye_emulators.controllers.route import JOINTS, POSES, Waypoint
from flangeye_emulators.controllers.ur.program import ProgramError, Thread
from flangeye_emulators.controllers.ur.script import Move

if TYPE_CHECKING:
    from flangeye_emulators.controllers.ur.script import ControlScript


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
    """Return the ride through moves of one kind, from where the arm stands."""
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


COMMANDS = {
    1: move_joints,
    2: move_joints_to_pose,
    3: move_straight,
    4: move_straight_to_joints,
    33: stop_move,
    34: stop_move,
    45: move_path,
}

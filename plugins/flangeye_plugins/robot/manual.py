"""``robot.manual``: no connection; an operator moves the arm and types its pose."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Iterator
from typing import ClassVar, NamedTuple, TextIO

import numpy as np
from pydantic import Field, field_validator

from flangeye.devices import ArmMode, Device, DeviceError, Robot, RobotState
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import Params, part
from flangeye.types import BASE, FLANGE, Floats, Transform
from flangeye.types.geometry import rotation_log
from flangeye.types.pose_formats import CONVENTIONS, AngleUnit, LengthUnit, PoseConvention


class OperatorConsole:
    """Prints to the terminal, and reads typed lines without blocking.

    It does not use a reading thread, because a thread that waits for input crashes the interpreter
    at exit.
    """

    def __init__(self, heard: TextIO | None = None, said: TextIO | None = None) -> None:
        """Use standard input and standard error unless other streams are given."""
        self._heard = (sys.stdin if heard is None else heard).fileno()
        self._said = sys.stderr if said is None else said
        self._buffer = b""
        self._ended = False

    def say(self, text: str) -> None:
        """Print a line for the operator."""
        self._said.write(text + "\n")
        self._said.flush()

    def line(self, patience: float) -> str | None:
        """Return the next typed line, skipping blank ones; None if there is none yet.

        Args:
            patience: Longest wait for a line [s].

        Raises:
            EOFError: The input has ended.
        """
        while (line := self._take()) is None:
            if self._ended:
                raise EOFError
            if not select.select([self._heard], [], [], patience)[0]:
                return None
            more = os.read(self._heard, 65536)
            self._ended = not more
            # The last line may have no end.
            self._buffer += more or b"\n"
        return line

    def _take(self) -> str | None:
        while b"\n" in self._buffer:
            first, _, self._buffer = self._buffer.partition(b"\n")
            if text := first.decode("utf-8", "replace").strip():
                return text
        return None


class ManualParams(Params):
    """Parameters of ``robot.manual``."""

    convention: str = Field(description=f"How the pendant shows a pose: {', '.join(CONVENTIONS)}.")
    length: LengthUnit | None = None
    """Unit of the pendant's positions, where it is not the usual one."""
    # Distance from the requested pose beyond which the entry is queried [m]
    distance: ClassVar[float] = 0.02
    # Rotation from the requested pose beyond which the entry is queried [rad]
    angle: ClassVar[float] = float(np.radians(5))

    @field_validator("convention")
    @classmethod
    def _known(cls, name: str) -> str:
        if name not in CONVENTIONS:
            raise ValueError(f"no convention '{name}'; known: {', '.join(CONVENTIONS)}")
        return name


@part("robot.manual", interactive=True)
def robot_manual(model: RobotModel, params: ManualParams) -> Robot:
    """An arm jogged by an operator: target poses are printed, reached poses are typed in.

    Poses are typed as the pendant shows them; a file of poses can be piped to standard input.
    Opening waits for the arm's present pose. An implausible pose is queried with the probable
    mistake, and kept if the answer is ``yes``. Joint angles are computed by the model's kinematics.

    Raises:
        DeviceError: The input ended before a pose was entered.
    """
    return ManualRobot(model, params, OperatorConsole())


class ManualRobot(Device):
    """An arm moved by an operator; see :class:`flangeye.devices.Robot`.

    No method waits for the operator: after a move request the arm is ``moving`` until its new pose
    was typed.
    """

    # Between two looks at the input [s].
    _period: ClassVar[float] = 0.05

    by_hand = True
    """See :class:`flangeye.devices.MovedByHand`."""

    def __init__(self, model: RobotModel, params: ManualParams, desk: OperatorConsole) -> None:
        """Wait until the operator has entered the arm's pose.

        Raises:
            DeviceError: The input has ended.
        """
        self.name = f"{model.model} moved by hand"
        self.period = self._period
        self.flange_T_tool: Transform | None = None
        self._desk, self._arm = desk, Arm(model)
        convention = CONVENTIONS[params.convention]
        self._convention = convention.in_units(params.length or convention.length, convention.angle)
        self._reach = model.length
        self._tolerance = Tolerance(params.distance, params.angle)
        self._asked: Floats | None = None
        self._near = np.zeros(self._arm.n)
        self._faulted: tuple[Floats, Floats] | None = None
        self._pose, self._joints = np.eye(4), self._near
        self._waiting, self._stopped = True, False
        labels = " ".join(convention.labels)
        desk.say(f"Type or paste the pose of the flange as the pendant shows it, no tool: {labels}")
        while self._waiting:
            self._listen(patience=self._period)

    def state(self) -> RobotState:
        """Return the arm's state with the pose entered last."""
        self._listen(patience=0.0)
        return RobotState(
            base_T_flange=Transform(BASE, FLANGE, self._pose),
            joints=self._joints,
            joint_speeds=np.zeros(self._arm.n),
            time_ns=time.monotonic_ns(),
            mode=self._mode(),
            message=(
                "it was stopped on its way, and its pose was not entered since"
                if self._stopped
                else ""
            ),
        )

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Ask the operator to move the flange to the pose of joint angles (n,) [rad]."""
        self._ask(self._arm.flange(joints), joints)

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Ask the operator to move the flange to a pose."""
        self._ask(base_T_flange.matrix, self._joints)

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Raise DeviceError: an operator cannot follow a velocity."""
        raise DeviceError(f"{self.name}: it is moved by hand to poses; it takes no velocities")

    def wait_cycle(self) -> None:
        """Wait for a short time."""
        time.sleep(self._period)

    def stop(self) -> None:
        """Ask the operator to stop moving the arm."""
        if self._waiting:
            self._waiting, self._stopped = False, True
            self._desk.say("Stop: leave the arm where it is.")

    def close(self) -> None:
        """Do nothing: an operator moves the arm."""

    def _mode(self) -> ArmMode:
        if self._stopped:
            return "not ready"
        return "moving" if self._waiting else "ready"

    def _ask(self, base_T_flange: Floats, joints: Floats) -> None:
        self._asked, self._near, self._faulted = base_T_flange, joints, None
        self._waiting, self._stopped = True, False
        self._desk.say(f"Go to   {self._convention.text(base_T_flange)}")
        self._desk.say("then type or paste the pose that it has reached")

    def _listen(self, patience: float) -> None:
        """Process typed lines while a pose is being requested.

        Raises:
            DeviceError: The input has ended.
        """
        try:
            line = self._desk.line(patience) if self._waiting else None
        except EOFError:
            raise DeviceError(
                f"{self.name}: the input has ended, and a pose is missing: type or pipe one line "
                "for each"
            ) from None
        if line is not None:
            self._take(line)

    def _take(self, line: str) -> None:
        if self._faulted is not None and line.lower() in ("y", "yes"):
            self._arrive(*self._faulted)
            return
        try:
            numbers = self._convention.read_numbers(line)
            pose = self._convention.matrix(numbers)
        except ValueError as error:
            self._desk.say(f"{error}; type the pose again, with decimal points")
            return
        joints = self._joints_at(pose, self._near)
        why = fault(numbers, self._convention, self._reach, self._asked, self._tolerance)
        if joints is None:
            self._desk.say(f"{why or 'no joint angles reach that pose'}; once more")
        elif why:
            self._faulted = pose, joints
            self._desk.say(f"{why} (type the pose again, or yes if the arm stands there)")
        else:
            self._arrive(pose, joints)

    def _arrive(self, pose: Floats, joints: Floats) -> None:
        self._pose, self._joints = pose, joints
        self._waiting, self._faulted = False, None
        self._desk.say(f"Stands at {self._convention.text(pose)}")

    def _joints_at(self, pose: Floats, near: Floats) -> Floats | None:
        """Return the joint angles (n,) of a pose closest to ``near``; None if out of reach."""
        found = self._arm.inverse(pose)
        if not len(found):
            return None
        turns = found + 2 * np.pi * np.round((near - found) / (2 * np.pi))
        inside = (turns >= self._arm.lower) & (turns <= self._arm.upper)
        found = np.where(inside, turns, found)
        return np.asarray(found[np.abs(found - near).max(axis=1).argmin()])


class Tolerance(NamedTuple):
    """Largest deviation of a pose from the requested one.

    Attributes:
        distance: Distance [m].
        angle: Angle [rad].
    """

    distance: float
    angle: float


def fault(
    numbers: Floats,
    convention: PoseConvention,
    reach: float,
    asked: Floats | None,
    tolerance: Tolerance,
) -> str | None:
    """Return why a typed pose is implausible, with the probable mistake; None if it is plausible.

    Args:
        numbers: Typed numbers in the convention.
        convention: Configured convention of poses.
        reach: Reach of the arm, from the origin of its base [m].
        asked: (4, 4) requested pose; None if any pose is acceptable.
        tolerance: Largest deviation from the requested pose.
    """
    pose = convention.matrix(numbers)
    if asked is not None:
        off = _apart(asked, pose)
        if off.distance <= tolerance.distance and off.angle <= tolerance.angle:
            return None
        complaint = (
            f"that is {off.distance * 1e3:.1f} mm and {np.degrees(off.angle):.1f} deg from the "
            "pose asked for"
        )
        return _with_hint(complaint, _meant(numbers, convention, asked, tolerance))
    distance = float(np.linalg.norm(pose[:3, 3]))
    # A pose this much farther than the arm is long is not the arm's
    if distance > 1.1 * reach:
        complaint = f"that is {distance:.4g} m from the base, and the arm is {reach:.2f} m long"
        return _with_hint(complaint, _unit(convention))
    if distance < reach / 200:
        complaint = f"that is {distance * 1e3:.1f} mm from the middle of the base"
        return _with_hint(complaint, _unit(convention))
    return None


def _with_hint(complaint: str, hint: str | None) -> str:
    return f"{complaint}: {hint}?" if hint else complaint


def _unit(convention: PoseConvention) -> str:
    return f"is the position in {_other_length(convention)}, not in {convention.length}"


def _other_length(convention: PoseConvention) -> LengthUnit:
    return "m" if convention.length == "mm" else "mm"


def _meant(
    numbers: Floats, convention: PoseConvention, asked: Floats, tolerance: Tolerance
) -> str | None:
    """Return the interpretation of the numbers that agrees with the requested pose, if any."""
    for hint, reading in _readings(numbers, convention):
        try:
            off = _apart(asked, reading[0].matrix(reading[1]))
        except ValueError:
            continue
        if off.distance <= tolerance.distance and off.angle <= tolerance.angle:
            return hint
    return _tool(convention.matrix(numbers), asked, tolerance)


def _readings(
    numbers: Floats, convention: PoseConvention
) -> Iterator[tuple[str, tuple[PoseConvention, Floats]]]:
    """Yield other interpretations of the numbers, the simplest mistake first."""
    length = _other_length(convention)
    angle: AngleUnit = "rad" if convention.angle == "deg" else "deg"
    in_length = convention.in_units(length, convention.angle)
    yield _unit(convention), (in_length, numbers)
    if not convention.is_quaternion:
        wrong_angle = f"are the angles in {angle}, not in {convention.angle}"
        in_angle = convention.in_units(convention.length, angle)
        yield wrong_angle, (in_angle, numbers)
        both = f"{_unit(convention)}, and {wrong_angle}"
        yield both, (convention.in_units(length, angle), numbers)
    for other in CONVENTIONS.values():  # one that has more or fewer numbers refuses them
        hint = f"are these numbers in the order and meaning of {other.name}"
        yield hint, (other.in_units(convention.length, other.angle), numbers)
    backwards = np.concatenate([numbers[:3], numbers[:2:-1]])
    yield "are the angles in the opposite order", (convention, backwards)


def _tool(pose: Floats, asked: Floats, tolerance: Tolerance) -> str | None:
    """Return a hint if the typed pose is probably the tool's instead of the flange's."""
    off = _apart(asked, pose)
    in_flange = asked[:3, :3].T @ (pose[:3, 3] - asked[:3, 3])
    # How far from the flange's axis a tool's tip is looked for [m]
    along_axis = np.hypot(in_flange[0], in_flange[1]) < 0.02 and in_flange[2] > 0
    if off.angle <= tolerance.angle and along_axis:
        return f"is this the pose of a tool, {in_flange[2] * 1e3:.0f} mm beyond the flange"
    return None


def _apart(asked: Floats, pose: Floats) -> Tolerance:
    """Return distance and angle between two poses (4, 4)."""
    angle = float(np.linalg.norm(rotation_log(asked[:3, :3].T @ pose[:3, :3])))
    return Tolerance(float(np.linalg.norm(asked[:3, 3] - pose[:3, 3])), angle)

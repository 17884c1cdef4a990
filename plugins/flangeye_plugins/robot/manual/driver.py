"""``robot.manual``: no connection at all; a person moves the arm and reads its pose out."""

from __future__ import annotations

import os
import select
import sys
import time
from typing import TextIO

import numpy as np
from pydantic import Field, field_validator

from flangeye.devices import Device, DeviceError, Mode, Robot, RobotState
from flangeye.maths.kinematics import Arm
from flangeye.maths.pose_formats import CONVENTIONS, LengthUnit
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import Params, part
from flangeye.types import BASE, FLANGE, Floats, Transform
from flangeye.units import Angle, Length, param
from flangeye_plugins.robot.manual.plausibility import Tolerance, fault


class OperatorConsole:
    """Says things, and hears lines without ever waiting for one.

    No thread reads: one that waits for input when the interpreter ends takes it down with it.
    """

    def __init__(self, heard: TextIO | None = None, said: TextIO | None = None) -> None:
        """Hear standard input and speak on standard error, where nothing else is said to."""
        self._heard = (sys.stdin if heard is None else heard).fileno()
        self._said = sys.stderr if said is None else said
        self._buffer = b""
        self._ended = False

    def say(self, text: str) -> None:
        """Say a line."""
        self._said.write(text + "\n")
        self._said.flush()

    def line(self, patience: float = 0.0) -> str | None:
        """Return a line that has been typed, blank ones aside; None while there is none.

        Args:
            patience: How long to wait for one [s].

        Raises:
            EOFError: There will be none any more.
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


PERIOD = 0.05
"""Between two looks at the input [s]."""


STOPPED = "it was stopped on its way, and nobody has said where it stands"


class ManualParams(Params):
    """Parameters of ``robot.manual``."""

    convention: str = Field(
        description=f"How the pendant shows a pose: {', '.join(CONVENTIONS)}.",
    )
    length: LengthUnit | None = Field(
        None, description="Unit of the pendant's positions, where it is not the usual one."
    )
    distance: Length = param(
        "20 mm",
        gt=0,
        description="Distance from the requested pose beyond which the entry is queried.",
    )
    angle: Angle = param(
        "5 deg",
        gt=0,
        description="Rotation from the requested pose beyond which the entry is queried.",
    )

    @field_validator("convention")
    @classmethod
    def _known(cls, name: str) -> str:
        if name not in CONVENTIONS:
            raise ValueError(f"no convention '{name}'; known: {', '.join(CONVENTIONS)}")
        return name


@part("robot.manual", interactive=True)
def robot_manual(model: RobotModel, params: ManualParams) -> Robot:
    """An arm jogged by hand: poses are printed, and entered as the pendant shows them.

    Opening it waits for the person to say where the arm stands. Text comes from standard input, so
    a file of poses can be piped in; a pose that makes no sense is asked about, with the probable
    mistake, and kept when the answer is ``yes``. The model's kinematics find its joint angles.

    Raises:
        DeviceError: The input ends before a pose was said.
    """
    return ManualRobot(model, params, OperatorConsole())


class ManualRobot(Device):
    """An arm that a person moves; see :class:`flangeye.devices.Robot`.

    No method waits for the person: an arm that was sent somewhere is ``moving`` until they have
    said where it is.
    """

    by_hand = True
    """See :class:`flangeye.devices.MovedByHand`."""

    def __init__(self, model: RobotModel, params: ManualParams, desk: OperatorConsole) -> None:
        """Wait until somebody says where the arm stands.

        Raises:
            DeviceError: Nobody will.
        """
        self.name = f"{model.model} moved by hand"
        self.period = PERIOD
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
            self._listen(patience=PERIOD)

    def state(self) -> RobotState:
        """Return where the arm stands, as the person last said."""
        self._listen()
        return RobotState(
            base_T_flange=Transform(BASE, FLANGE, self._pose),
            joints=self._joints,
            joint_speeds=np.zeros(self._arm.n),
            time_ns=time.monotonic_ns(),
            mode=self._mode(),
            message=STOPPED if self._stopped else "",
        )

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Ask the person to move the flange to where joint angles put it."""
        del speed, acceleration
        self._ask(self._arm.flange(joints), joints)

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Ask the person to move the flange to a pose."""
        del speed, acceleration
        self._ask(base_T_flange.matrix, self._joints)

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Refuse: nobody follows a velocity by hand."""
        raise DeviceError(f"{self.name}: it goes to poses, not at velocities")

    def wait_cycle(self) -> None:
        """Wait a little."""
        time.sleep(PERIOD)

    def stop(self) -> None:
        """Tell the person to leave the arm where it is."""
        if self._waiting:
            self._waiting, self._stopped = False, True
            self._desk.say("Stop: leave the arm where it is.")

    def close(self) -> None:
        """Do nothing; the arm is the person's."""

    def _mode(self) -> Mode:
        if self._stopped:
            return "not ready"
        return "moving" if self._waiting else "ready"

    def _ask(self, base_T_flange: Floats, joints: Floats) -> None:
        self._asked, self._near, self._faulted = base_T_flange, joints, None
        self._waiting, self._stopped = True, False
        self._desk.say(f"Go to   {self._convention.text(base_T_flange)}")
        self._desk.say("then type or paste where it stands")

    def _listen(self, patience: float = 0.0) -> None:
        """Take what has been typed, if anything was asked.

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
            self._desk.say(f"{error}; once more, with decimal points")
            return
        joints = self._joints_at(pose, self._near)
        why = fault(numbers, self._convention, self._reach, self._asked, self._tolerance)
        if joints is None:
            self._desk.say(f"{why or 'no joint angles reach that pose'}; once more")
        elif why:
            self._faulted = pose, joints
            self._desk.say(f"{why} (once more, or yes if it stands there)")
        else:
            self._arrive(pose, joints)

    def _arrive(self, pose: Floats, joints: Floats) -> None:
        self._pose, self._joints = pose, joints
        self._waiting, self._faulted = False, None
        self._desk.say(f"Stands at {self._convention.text(pose)}")

    def _joints_at(self, pose: Floats, near: Floats) -> Floats | None:
        """Return the joint angles (n,) of a pose that are nearest to ``near``, if there are any."""
        found = self._arm.inverse(pose)
        if not len(found):
            return None
        turns = found + 2 * np.pi * np.round((near - found) / (2 * np.pi))
        inside = (turns >= self._arm.lower) & (turns <= self._arm.upper)
        found = np.where(inside, turns, found)
        return np.asarray(found[np.abs(found - near).max(axis=1).argmin()])

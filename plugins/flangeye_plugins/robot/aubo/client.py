"""Wrapper of AUBO's client library that turns every failure into a DeviceError."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import numpy as np

from flangeye.devices import SILENT, DeviceError
from flangeye.types import Floats

Returned = TypeVar("Returned")


STANDSTILL = 2e-3
"""A joint that is slower than this stands [rad/s]."""


class AuboClient:
    """A logged-in connection to a controller.

    After one timeout the connection counts as lost: no further calls are made, because each wait
    would block the process that supervises the arm. The arm needs no stop command then, as every
    piece of its motion ends by itself.

    Attributes:
        state: The library's ``RobotState``.
        motion: The library's ``MotionControl``.
        config: The library's ``RobotConfig``.
    """

    # Longest wait for one answer [s]; the library then raises, it never hangs.
    answer: ClassVar[float] = 0.5

    def __init__(self, sdk: Any, name: str, host: str, user: str, password: str) -> None:
        """Connect and log in.

        Args:
            sdk: The module ``pyaubo_sdk``.
            name: Name of the robot, for messages.
            host: Address of the controller.
            user: Account on the controller.
            password: Password of that account.

        Raises:
            DeviceError: The controller does not answer, or the login fails.
        """
        self._name, self._lost = name, False
        self._failure = sdk.AuboException
        self._rpc = sdk.RpcClient()
        self._rpc.setLogHandler(_say_nothing)
        self._rpc.setRequestTimeout(round(1e3 * self.answer))
        port = 30004
        if self.ask("connect", lambda: self._rpc.connect(host, port)) != 0:
            raise DeviceError(
                f"{name}: nothing answers at {host}:{port}: is the controller on, is {host} its "
                "address, is this computer in its network?"
            )
        self.ask("login", lambda: self._rpc.login(user, password))
        names = self.ask("robot names", self._rpc.getRobotNames)
        if not names:
            raise DeviceError(f"{name}: the controller has no robot, or does not let {user} log in")
        robot = self._rpc.getRobotInterface(names[0])
        self.state: Any = robot.getRobotState()
        self.motion: Any = robot.getMotionControl()
        self.config: Any = robot.getRobotConfig()

    def ask(self, what: str, question: Callable[[], Returned]) -> Returned:
        """Call a query of the library and return its answer.

        Raises:
            DeviceError: The connection is lost, or the controller refuses.
        """
        if self._lost:
            raise self._error(what, "the connection is lost")
        began = time.monotonic()
        try:
            return question()
        except self._failure as error:
            self._lost = time.monotonic() - began >= self.answer
            raise self._error(what, " ".join(str(error).split())) from None

    def _error(self, what: str, said: str) -> DeviceError:
        return DeviceError(
            f"{self._name}: {what}: {said}: look at the controller and the network, then open it "
            "again"
        )

    def command(self, what: str, order: Callable[[], int]) -> None:
        """Call a command of the library.

        Raises:
            DeviceError: The controller did not accept the command.
        """
        code = self.ask(what, order)
        if code != 0:
            # AuboErrorCodes, those that a move can meet
            why = {
                1: "the controller's present state does not allow it",
                2: "its queue is full",
                3: "it is busy",
                4: "it took too long",
                5: "an argument is invalid",
                8: "this account has no permission for it",
            }.get(abs(code), f"return value {code}")
            raise DeviceError(f"{self._name}: {what}: not done: {why}")

    def close(self) -> None:
        """Close the connection, also a broken one."""
        try:
            self._rpc.logout()
            self._rpc.disconnect()
        except self._failure:
            return


def _say_nothing(*_: object) -> None:
    """Discard the library's log lines, which would go to standard output."""


class VelocityMove:
    """One move, made of velocity commands that are renewed whenever the arm's state is read.

    The move starts at rest, goes straight to the goal with a trapezoidal speed profile, stops near
    it, and ends with the controller's own move over the remaining distance. If the state is not
    read for SILENT, the move is over, as the last velocity command has expired.
    """

    def __init__(
        self,
        speed: float,
        acceleration: float,
        go: Callable[[Floats], None],
        stop: Callable[[], None],
        arrive: Callable[[], None],
    ) -> None:
        """Start a move of an arm that was commanded to stop.

        Args:
            speed: Largest speed of the leading joint, or of the tool [rad/s, m/s].
            acceleration: Largest acceleration, likewise [rad/s^2, m/s^2].
            go: Commands a velocity (n,) that expires by itself.
            stop: Brakes.
            arrive: Commands the controller's own move to the goal.
        """
        self._speed, self._acceleration = speed, acceleration
        self._go, self._stop, self._arrive = go, stop, arrive
        self._velocity, self._renewed, self._ended = 0.0, time.monotonic(), False

    @property
    def over(self) -> bool:
        """Whether every command has been sent."""
        return self._ended or time.monotonic() - self._renewed > SILENT

    def renew(self, rest: Floats, left: float, fastest: float) -> None:
        """Command the next piece of a move that is not finished.

        Args:
            rest: (n,) remaining displacement, in the space of the velocities.
            left: Remaining distance, in the unit of ``speed`` times seconds.
            fastest: Present speed of the fastest joint [rad/s].
        """
        now = time.monotonic()
        passed, self._renewed = now - self._renewed, now
        if self._velocity == 0.0 and fastest > STANDSTILL:
            return  # it comes to rest first
        # From here on the controller moves to the goal itself [rad, m]: an arm at 0.5 rad/s^2 needs
        # 0.13 s for it, so that this end, too, is a piece.
        if left < 2e-3:
            self._finish()
        else:
            # v^2 = 2 (a / 2) s: half of the deceleration allowed is planned with. A velocity is
            # followed a little late, and what it lags behind is made up for with the rest.
            self._velocity = min(
                self._speed,
                self._velocity + self._acceleration * passed,
                float(np.sqrt(self._acceleration * left)),
            )
            self._go(self._velocity / left * rest)

    def _finish(self) -> None:
        """Brake to rest, then command the final move to the goal."""
        if self._velocity > 0.0:
            self._velocity = 0.0
            self._stop()
        else:
            self._arrive()
            self._ended = True

"""The maker's client library, with every failure turned into one sort of error."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from flangeye.devices import DeviceError

PORT = 30004

CODES = {
    1: "the controller is not in a state for it",
    2: "its queue is full",
    3: "it is busy",
    4: "it took too long",
    5: "a number is not acceptable",
    8: "this account may not do it",
}
"""Return values of commands (AuboErrorCodes), those that a move can meet."""

T = TypeVar("T")


class AuboClient:
    """A logged-in connection.

    Attributes:
        state: The library's ``RobotState``.
        motion: Its ``MotionControl``.
        config: Its ``RobotConfig``.
    """

    def __init__(self, sdk: Any, name: str, host: str, user: str, password: str) -> None:
        """Connect and log in.

        Args:
            sdk: The module ``pyaubo_sdk``.
            name: Name of the robot, for messages.
            host: Address of the controller.
            user: Account on it.
            password: Password of that account.

        Raises:
            DeviceError: Nobody answers, or the login fails.
        """
        self._name = name
        self._failure = sdk.AuboException
        self._rpc = sdk.RpcClient()
        self._rpc.setLogHandler(_say_nothing)
        # Longest wait for one answer [ms]; the library then raises, it never hangs
        self._rpc.setRequestTimeout(500)
        if self.ask("connect", lambda: self._rpc.connect(host, PORT)) != 0:
            raise DeviceError(
                f"{name}: nothing answers at {host}:{PORT}: is the controller on, is {host} its "
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

    def ask(self, what: str, question: Callable[[], T]) -> T:
        """Return what the library answers.

        Raises:
            DeviceError: It raises: the connection is lost, or the controller refuses.
        """
        try:
            return question()
        except self._failure as error:
            said = " ".join(str(error).split())
            raise DeviceError(
                f"{self._name}: {what}: {said}: look at the controller and the network, then open "
                "it again"
            ) from None

    def command(self, what: str, order: Callable[[], int]) -> None:
        """Give a command.

        Raises:
            DeviceError: It was not taken.
        """
        code = self.ask(what, order)
        if code != 0:
            why = CODES.get(abs(code), f"return value {code}")
            raise DeviceError(f"{self._name}: {what}: not done: {why}")

    def close(self) -> None:
        """Let go of the connection, whatever became of it."""
        try:
            self._rpc.logout()
            self._rpc.disconnect()
        except self._failure:
            return


def _say_nothing(*_: object) -> None:
    """Take the library's log lines, which would go to standard output."""

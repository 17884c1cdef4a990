"""What robot.aubo makes of its library's answers, with a stand-in for the library and the clock.

The bounds stand here as numbers: a test that took them from the code would follow any change of it.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError
from flangeye_plugins.robot.aubo import client
from flangeye_plugins.robot.aubo.client import AuboClient, VelocityMove


class LibraryError(Exception):
    """What the stand-in's library raises."""


class Clock:
    """A clock that goes when it is told to [s]."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Library:
    """A stand-in for the library: it says what it is told, and keeps what it was asked."""

    AuboException = LibraryError

    def __init__(self) -> None:
        self.code, self.names, self.calls = 0, ["first", "second"], list[Any]()
        self.ends: Any = None
        self.log: Any = print
        self.RpcClient = lambda: SimpleNamespace(
            setLogHandler=lambda take: setattr(self, "log", take),
            setRequestTimeout=lambda ms: self.calls.append(("timeout", ms)),
            connect=self._connected,
            login=lambda user, password: self.calls.append(("login", user, password)),
            getRobotNames=lambda: self.names,
            getRobotInterface=self._interface,
            logout=self._ended,
            disconnect=lambda: self.calls.append("disconnect"),
        )

    def _connected(self, host: str, port: int) -> int:
        self.calls.append(("connect", host, port))
        self.log("level", "text")
        return self.code

    def _interface(self, name: str) -> Any:
        self.calls.append(("robot", name))
        return SimpleNamespace(
            getRobotState=lambda: "state", getMotionControl=lambda: "motion",
            getRobotConfig=lambda: "config",
        )  # fmt: skip

    def _ended(self) -> None:
        if self.ends:
            raise self.ends
        self.calls.append("logout")


@pytest.fixture
def library() -> Library:
    return Library()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(client, "time", SimpleNamespace(monotonic=made))
    return made


def opened(library: Any) -> AuboClient:
    return AuboClient(library, "aubo-i5", "10.0.0.1", "aubo", "123456")


def test_it_connects_logs_in_and_takes_the_first_robot(
    library: Library, capsys: pytest.CaptureFixture[str]
) -> None:
    made = opened(library)
    assert capsys.readouterr().out == ""  # the library's own log goes nowhere
    assert library.calls == [
        ("timeout", 500), ("connect", "10.0.0.1", 30004), ("login", "aubo", "123456"),
        ("robot", "first"),
    ]  # fmt: skip
    assert (made.state, made.motion, made.config) == ("state", "motion", "config")
    made.close()
    assert library.calls[4:] == ["logout", "disconnect"]


@pytest.mark.parametrize("code", [-1, 1, 2])
def test_a_connection_that_is_not_made_is_refused_whatever_its_code(
    library: Library, code: int
) -> None:
    library.code = code
    with pytest.raises(DeviceError, match="nothing answers at 10.0.0.1:30004"):
        opened(library)


def test_a_controller_without_a_robot_is_refused(library: Library) -> None:
    library.names = []
    with pytest.raises(DeviceError, match="has no robot, or does not let aubo log in"):
        opened(library)


def test_a_connection_that_is_lost_is_let_go_of(library: Library) -> None:
    made = opened(library)
    library.ends = LibraryError("gone")
    made.close()


@pytest.mark.parametrize(
    ("code", "why"),
    [
        (1, "the controller's present state does not allow it"), (2, "its queue is full"), (3, "it is busy"),
        (4, "it took too long"), (5, "an argument is invalid"),
        (8, "this account has no permission for it"), (-1, "the controller's present state does not allow it"),
        (6, "return value 6"), (7, "return value 7"), (9, "return value 9"),
    ],
)  # fmt: skip
def test_a_command_that_is_not_taken_says_why(library: Library, code: int, why: str) -> None:
    made = opened(library)
    made.command("move", lambda: 0)
    with pytest.raises(DeviceError) as error:
        made.command("move", lambda: code)
    assert str(error.value) == f"aubo-i5: move: not done: {why}"


@pytest.mark.parametrize(("took", "lost"), [(0.499, False), (0.5, True), (0.75, True)])
def test_a_connection_without_an_answer_for_half_a_second_is_lost(
    library: Library, clock: Clock, took: float, lost: bool
) -> None:
    made = opened(library)

    def question() -> int:
        clock.now += took
        raise LibraryError("RPC\nrequest  timeout.")

    with pytest.raises(DeviceError) as error:
        made.ask("joints", question)
    assert str(error.value) == (
        "aubo-i5: joints: RPC request timeout.: look at the controller and the network, then open "
        "it again"
    )
    asked = list[str]()

    def stop() -> int:
        asked.append("stop")
        return 0

    if lost:
        with pytest.raises(DeviceError, match="aubo-i5: stop: the connection is lost: look at"):
            made.command("stop", stop)
    else:
        made.command("stop", stop)
    assert len(asked) == 1 - lost


class Ridden:
    """A ride at 0.4 rad/s and 2 rad/s^2, with what it commands."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.commands = clock, list[Any]()
        self.ride = VelocityMove(
            0.4, 2.0, lambda v: self.commands.append(v.tolist()),
            lambda: self.commands.append("stop"), lambda: self.commands.append("arrive"),
        )  # fmt: skip

    def look(self, left: float, fastest: float = 0.0, after: float = 0.1) -> Any:
        """Look at the arm after a while; return what is commanded."""
        self.clock.now += after
        self.ride.renew(np.array([left, -0.5 * left]), left, fastest)
        return self.commands.pop() if self.commands else None


def test_a_ride_begins_when_the_arm_stands_and_speeds_up_to_what_it_may(clock: Clock) -> None:
    ridden = Ridden(clock)
    assert ridden.look(1.0, fastest=2.01e-3) is None
    assert ridden.look(1.0, fastest=2e-3) == pytest.approx([0.2, -0.1])
    assert ridden.look(1.0, fastest=0.2) == pytest.approx([0.4, -0.2])
    assert ridden.look(1.0, fastest=0.4) == pytest.approx([0.4, -0.2])


def test_a_ride_slows_down_with_half_of_its_deceleration_and_comes_to_rest(clock: Clock) -> None:
    ridden = Ridden(clock)
    ridden.look(1.0)
    ridden.look(1.0)
    speed = np.sqrt(2.0 * 0.5 * 2.0 * 0.03)
    assert ridden.look(0.03, 0.3) == pytest.approx([speed, -0.5 * speed])
    speed = np.sqrt(2.0 * 0.5 * 2.0 * 0.002)
    assert ridden.look(0.002, 0.2) == pytest.approx([speed, -0.5 * speed])
    assert ridden.look(0.0019, 0.1) == "stop"
    assert ridden.look(0.0019, 2.01e-3) is None
    assert not ridden.ride.over
    assert ridden.look(0.0019, 2e-3) == "arrive"
    assert ridden.ride.over


def test_an_arm_that_creeps_is_stopped_before_it_is_sent_to_its_goal(clock: Clock) -> None:
    ridden = Ridden(clock)
    assert ridden.look(1.0, after=1e-4) == pytest.approx([2e-4, -1e-4])
    assert ridden.look(0.001, after=1e-4) == "stop"
    assert ridden.look(0.001) == "arrive"


@pytest.mark.parametrize(("silent", "over"), [(0.149, False), (0.151, True)])
def test_a_ride_that_nobody_looked_at_is_over(clock: Clock, silent: float, over: bool) -> None:
    ridden = Ridden(clock)
    ridden.look(1.0)
    clock.now += silent
    assert ridden.ride.over == over

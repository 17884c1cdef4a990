"""Interfaces of robots, scanners and tactile sensors, and files named in a machine's settings.

A driver is a part (``robot.NAME``, ``scanner.NAME``, ``sensor.NAME``): a function that takes the
recipe's model and its own parameters and returns an open device. It imports its SDK when it is
called and raises :class:`DeviceError` in one line where SDK, device or permission is missing.

No method of a driver moves anything by itself, waits for a motion to end, or blocks for longer than
:data:`PATIENCE`: the caller watches the motion (``flangeye.motion``), so that every arm stops for
the same reasons. SI units; a twist is (linear, angular), about the flange's origin, along the
base's axes.

A motion goes on only while :meth:`Robot.state` is called at least every :data:`SILENT`; otherwise
the driver ends it. This holds whichever process is stopped, starved or dead, so no driver gives a
controller a command that outlasts :data:`SILENT`. Times are those of ``time.monotonic_ns``, which
every process of a machine shares and which nobody sets.
"""

import importlib
import os
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, Self, runtime_checkable

from platformdirs import user_config_path
from pydantic import BeforeValidator

from flangeye.errors import StageError
from flangeye.types import Array, Floats, Image, PointCloud, Transform, Truth

PATIENCE = 3.0
"""Longest time any method of a driver takes, whatever happened to the device [s]."""

GRACE = 0.1
"""An arm that goes at a velocity brakes when the next command is this late [s]."""

SILENT = 0.15
"""Longest time without a read of a moving arm's state, a cycle of its guard, or a heartbeat of the
program [s]. An arm at 0.5 rad/s takes another 0.12 s to brake, so it is at rest within 0.3 s. A
computer that halts a process for so long is too busy to move an arm."""

ArmMode = Literal["ready", "moving", "protective stop", "emergency stop", "not ready"]


class DeviceError(StageError):
    """A device cannot be opened or was lost; the message says which, why, and what to do."""


class FrameDropped(DeviceError):
    """A scanner lost this one exposure but still works: expose again, or leave the pose out."""


@dataclass(frozen=True, eq=False)
class RobotState:
    """One consistent sample of an arm.

    Attributes:
        base_T_flange: Pose of the flange, any tool offset of the controller taken off.
        joints: (n,) joint angles [rad].
        joint_speeds: (n,) joint speeds [rad/s].
        time_ns: Time of the controller's sample on ``time.monotonic_ns`` [ns].
        mode: State of the controller; all but ready and moving are safety faults.
        force: (6,) force and torque on the flange in the base's axes [N, N m], if it is measured.
        message: Text of the controller about a mode that is not ready.
    """

    base_T_flange: Transform
    joints: Array
    joint_speeds: Array
    time_ns: int
    mode: ArmMode
    force: Array | None = None
    message: str = ""


class Device(Protocol):
    """A device that is open, used as a context; a driver's class may inherit from it."""

    def close(self) -> None:
        """Disconnect; safe to call twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@runtime_checkable
class Robot(Device, Protocol):
    """An arm: opened by its driver, used as a context, disconnected at the end.

    Every method but close raises DeviceError when the arm is lost, and a command also when the
    controller is in a mode in which it cannot move.

    Attributes:
        name: Model and address, as messages show it: ``ur5e at 192.168.1.10``.
        period: Duration of the controller's cycle [s].
        flange_T_tool: Tool offset set in the controller; None if it cannot be read.
    """

    name: str
    period: float
    flange_T_tool: Transform | None

    def state(self) -> RobotState:
        """Return the newest sample; raise DeviceError when it is older than 100 ms.

        The call also shows that the motion is watched: without a call for SILENT the motion ends
        and is not resumed.
        """

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Start a move to joint angles (n,) [rad]; speed of the fastest joint [rad/s].

        The mode is ``moving`` from this call until the move has ended, so an arm that has not
        started is never taken for one that has arrived.
        """

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Start a straight move of the flange [m/s, m/s^2]; the mode is as for joints."""

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Move at a twist (6,) until the next command; brake if none comes within GRACE.

        Acceleration in [m/s^2] and [rad/s^2].
        """

    def wait_cycle(self) -> None:
        """Return at the start of the controller's next cycle."""

    def stop(self) -> None:
        """Begin to brake at once; does nothing if the arm is at rest."""

    def close(self) -> None:
        """Stop and disconnect; safe to call twice, also after the connection was lost."""


@runtime_checkable
class MovedByHand(Protocol):
    """Additional interface of a robot that a person moves by hand.

    A move then has no fixed duration or path, and ends near the requested pose, not at it. When the
    mode is ready again, the state has the pose reached.

    Attributes:
        by_hand: Always true.
    """

    by_hand: bool


@dataclass(frozen=True, eq=False)
class Scan:
    """One exposure of a scanner, with its time.

    Attributes:
        cloud: Points in ``camera`` [m].
        started_ns: When the exposure began, by ``time.monotonic_ns``.
        ended_ns: When it ended.
        image: Image of the scanner's camera, if it has one and an image was requested.
    """

    cloud: PointCloud
    started_ns: int
    ended_ns: int
    image: Image | None = None


@runtime_checkable
class Scanner(Device, Protocol):
    """A 3D scanner. Opened by its driver, used as a context.

    Attributes:
        name: Model and serial number, as messages show it.
        facts: What the device reports about itself (unit, layout, size, firmware, …); logged.
    """

    name: str
    facts: dict[str, str]

    def expose(self) -> Callable[[], Scan]:
        """Take the exposure; return when it has ended and the arm may move on.

        The returned function waits for the data, a few seconds at most, and returns the scan. Both
        may raise. The function is called once, before the next exposure. It takes longer than
        PATIENCE only where a person has to act, as with a watched folder; ``close`` from another
        thread ends that wait.

        Raises:
            FrameDropped: This exposure gave no data, but the scanner still works.
            DeviceError: The scanner is lost, or gave no data in time.
        """


@runtime_checkable
class DetectsLoss(Protocol):
    """Additional interface of a scanner that notices its loss at once, so a moving arm stops."""

    def require_alive(self) -> None:
        """Raise DeviceError when the scanner is lost; called some times a second, never waits."""


@runtime_checkable
class ReceivesScans(Protocol):
    """Additional interface of a scanner that receives scans which others triggered.

    A foreign robot program that moves the arm may trigger the scanner as well.
    """

    def received_scan(self, since_ns: int) -> Callable[[], Scan]:
        """Return the newest scan since a given time, or the next one; see ``Scanner.expose``.

        Raises:
            FrameDropped: No scan was taken in time.
            DeviceError: The scanner is lost.
        """


@runtime_checkable
class KnowsTruth(Protocol):
    """The truth of a simulated scanner, to score it; no stage can ask for it.

    Attributes:
        truth: True pose of the scanner.
    """

    truth: Truth


@runtime_checkable
class KnowsTorch(Protocol):
    """Interface of a simulated finger that knows the torch's true path, for scoring a weld."""

    def true_torch(self) -> tuple[Floats, Floats]:
        """Return times (K,) [s] and true positions of the torch (K, 3) in base [m]."""


@runtime_checkable
class KnowsSeams(Protocol):
    """The truth of a simulated scanner, to score a plan; no planning stage sees it.

    Attributes:
        true_seams: Points of each seam by name, (N, 3) in ``base`` [m].
    """

    true_seams: Mapping[str, Array]


class StateSource(Protocol):
    """Source of the arm's pose with its time: all that a tactile sensor needs from the arm."""

    def state(self) -> RobotState:
        """Return the newest sample."""


@dataclass(frozen=True, eq=False)
class SensorFrame:
    """One image of a tactile sensor.

    Attributes:
        image: The camera's image.
        time_ns: Middle of the exposure, on the robot's clock.
    """

    image: Image
    time_ns: int


@runtime_checkable
class TactileSensor(Device, Protocol):
    """A camera that watches a tag on a compliant finger.

    Attributes:
        name: Shown in messages and reports.
        camera_matrix: (3, 3) camera matrix [px].
        distortion: (k,) OpenCV's distortion coefficients; empty for none.
    """

    name: str
    camera_matrix: Array
    distortion: Array

    def frame(self) -> SensorFrame | None:
        """Return the newest frame not yet returned, or None; never waits.

        Raises:
            DeviceError: The camera is lost.
        """


@dataclass(frozen=True)
class WeldProfile:
    """One measurement of the bead behind the torch.

    Attributes:
        offset: Offset of the bead's centre to the left of the joint, seen along the weld [m].
        sigma: Standard deviation of the offset [m].
        time_ns: Time of the profile on the robot's clock [ns].
    """

    offset: float
    sigma: float
    time_ns: int


@runtime_checkable
class Profiler(Device, Protocol):
    """A profile sensor on the tool that measures the bead at a fixed distance behind the torch.

    Attributes:
        name: Name in messages and reports.
        behind: Distance of the profile behind the torch [m].
    """

    name: str
    behind: float

    def profile(self) -> WeldProfile | None:
        """Return the newest profile not yet returned, or None; never waits.

        A profile without a recognisable bead and joint is skipped.

        Raises:
            DeviceError: The sensor is lost.
        """


@runtime_checkable
class Arc(Device, Protocol):
    """A welding power source. Opened by its driver in the process that guards the arm.

    Gas and arc are off when it opens, and are switched off when it closes, also after an error.

    Attributes:
        name: Shown in messages and reports.
    """

    name: str

    def gas(self, on: bool) -> None:
        """Open or close the gas valve; never waits.

        Raises:
            DeviceError: The power source, or what switches it, is lost.
        """

    def burn(self, on: bool) -> None:
        """Start or end wire and arc; never waits, raises as :meth:`gas` does."""

    def burning(self) -> bool | None:
        """Return whether the arc is established; None if there is no such signal. Never waits."""


@dataclass(frozen=True)
class RobotDriver:
    """The recipe's ``robot.driver``, not yet opened.

    Attributes:
        name: Name of the part.
        open: Connects; raises DeviceError where it cannot.
        read: Connects to read the arm's state only: starts no program on the controller and
            commands nothing. None if the driver cannot do that.
        in_this_process: Whether the driver must run in the process that owns the terminal, because
            it asks the operator questions.
        passive: Whether the driver commands nothing: a foreign program moves the arm, and no
            permission is needed.
        simulated: Whether the arm is simulated: no permission is needed, and experiments forbidden
            on a real arm are allowed.
    """

    name: str
    open: Callable[[], Robot] = field(compare=False, repr=False)
    read: Callable[[], Robot] | None = field(default=None, compare=False, repr=False)
    in_this_process: bool = False
    simulated: bool = False
    passive: bool = False


@dataclass(frozen=True)
class ScannerDriver:
    """The recipe's ``scanner.driver``, not yet opened.

    Attributes:
        name: Name of the part.
        open: Connects; raises DeviceError where it cannot.
    """

    name: str
    open: Callable[[], Scanner] = field(compare=False, repr=False)


@dataclass(frozen=True)
class MotionAllowed:
    """Whether the user allowed motion (``--move``); without it, nothing moves.

    Attributes:
        allowed: Whether the arm may be moved.
        offline: Whether the arm must not even be read (``--offline``).
        plan_only: Whether only the plan is wanted (``--json``); holds for a simulated arm too,
            which otherwise needs no permission.
    """

    allowed: bool = False
    offline: bool = False
    plan_only: bool = False


def load_sdk(module: str, driver: str, install: str) -> Any:
    """Import a maker's SDK and return its module.

    Args:
        module: Name of the module.
        driver: Driver that needs it, for example ``scanner.realsense``.
        install: Command that installs it, for example ``pip install 'flangeye[realsense]'``.

    Raises:
        DeviceError: The module is missing or does not load; gives the reason and the install
            command.
    """
    try:
        return importlib.import_module(module)
    except (ImportError, OSError) as error:
        reason = str(error).strip().partition("\n")[0]
        raise DeviceError(f"{driver}: needs {module} ({reason}); {install}") from None


SettingsKind = Literal["programs", "libraries"]


def _name(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"\w[\w.-]*", value, re.ASCII):
        raise ValueError(
            "must be the name of an entry in this machine's settings, not a path: a recipe may not "
            "choose programs or libraries (flangeye's documentation: what a recipe can open)"
        )
    return value


MachineName = Annotated[str, BeforeValidator(_name)]
"""A parameter that names an entry; a path cannot be written as one."""


def settings_file() -> Path:
    """Return the settings file where the user names programs and libraries; it need not exist."""
    return user_config_path("flangeye") / "machine.toml"


def find_named(kind: SettingsKind, name: str) -> Path | None:
    """Return the file to which this machine's settings map a name; None if they do not.

    Raises:
        DeviceError: The settings cannot be read, or the entry is not the absolute path of a file.
    """
    variable = f"FLANGEYE_{'PROGRAM' if kind == 'programs' else 'LIBRARY'}_{name.upper()}"
    given, where = os.environ.get(variable), variable
    if given is None:
        given, where = _entries(kind).get(name), f"{settings_file()}: {kind}.{name}"
    if given is None:
        return None
    path = Path(str(given))
    if not path.is_absolute() or not path.is_file():
        raise DeviceError(f"{where}: {given} is not a file; give its absolute path")
    return path


def require_named(kind: SettingsKind, name: str, asker: str) -> Path:
    """Return the file to which this machine's settings map a name.

    Raises:
        DeviceError: The settings do not have the name; the message says where to add it, and which
            names they have.
    """
    path = find_named(kind, name)
    if path is None:
        known = ", ".join(sorted(_entries(kind))) or "none"
        raise DeviceError(
            f"{asker}: this machine's settings have no entry '{name}' (entries: {known}); a recipe "
            f"may not "
            f'choose programs or libraries: write {name} = "/its/path" under [{kind}] in '
            f"{settings_file()}"
        )
    return path


def _entries(kind: SettingsKind) -> dict[str, str]:
    try:
        table = tomllib.loads(settings_file().read_text(encoding="utf-8")).get(kind, {})
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise DeviceError(f"{settings_file()}: cannot be read: {error}") from None
    if not isinstance(table, dict):
        raise DeviceError(f"{settings_file()}: [{kind}] must be a table of names and paths")
    return table

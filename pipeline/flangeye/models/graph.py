"""Plugin offers beside stages and parts: graphs of running nodes, and emulators.

The engine knows no middleware. A plugin offers its graphs by name through the hook
``flangeye_graphs``: ``flangeye init --ros2`` and ``flangeye publish`` use the one named ``ros2``.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from flangeye.devices import Device
from flangeye.errors import StageError
from flangeye.models.robots import RobotModel
from flangeye.types import CalibratedPose, Floats
from flangeye.units import parse_quantity


class Topic(NamedTuple):
    """A topic that runs.

    Attributes:
        name: Name with its namespace.
        type: ``sensor_msgs/msg/PointCloud2``.
        publishers: Names of the nodes that publish it.
        subscribers: Number of nodes that listen.
    """

    name: str
    type: str
    publishers: tuple[str, ...]
    subscribers: int


class Running(NamedTuple):
    """A topic or a service that runs and that a recipe may use.

    Attributes:
        name: Name with its namespace.
        line: Line of text about it: its type, its rate, its publisher.
        answers: The option of ``flangeye init`` that may name it; empty where none does.
    """

    name: str
    line: str
    answers: str


@dataclass(frozen=True, eq=False)
class RunningCell:
    """An arm and a camera that run, as a recipe names them.

    Attributes:
        robot: The section of the arm, without limits.
        scanner: The section of the camera, without its model.
        flange: base_T_flange (4, 4) now [m].
        camera: base_T_camera (4, 4) [m], if the graph has it.
        pixels: Present image of a camera without depth, (H, W) or (H, W, 3), empty if none arrived;
            None for a camera of clouds or depths.
        files: Texts of the files that the sections name, by name.
        steps: Steps to add at the recipe's end.
        steps_in_hand: Steps to add instead if the arm carries the camera.
        seen: Lines of text about what runs.
    """

    robot: Mapping[str, Any]
    scanner: Mapping[str, Any]
    flange: Floats
    camera: Floats | None = None
    pixels: Any = None
    files: Mapping[str, str] = field(default_factory=dict)
    steps: Sequence[Any] = ()
    steps_in_hand: Sequence[Any] = ()
    seen: Sequence[str] = ()


class Ask(Protocol):
    """Callback by which a graph asks the person what it cannot detect."""

    def __call__(self, flag: str, question: str, default: str | None, example: str = "") -> str:
        """Return the answer to a question: given by the option ``flag``, a person, or by default.

        Raises:
            RecipeError: There is no likely answer, and no person to ask.
        """


class Graph(Device, Protocol):
    """A network of running nodes that this program has joined; used as a context."""

    def topics(self) -> list[Topic]:
        """Return the topics that run, by name."""

    def running(self) -> list[Running]:
        """Return the running nodes that a recipe can use; publishes nothing, calls no service."""

    def cell(self, ask: Ask, name: str) -> RunningCell:
        """Return the arm and the camera that run.

        Args:
            ask: Callback for what the graph does not show.
            name: Base name of the files.

        Raises:
            FlangeyeError: There is no arm or no camera; the message says what there is.
        """

    def publish(self, pose: CalibratedPose, frames: Mapping[str, str]) -> list[str]:
        """Put a pose on the graph as static transforms, until the graph is closed.

        Args:
            pose: Pose of one camera, or of a whole cell.
            frames: Frame name in flangeye -> frame name in the graph.

        Returns:
            A line for each transform.

        Raises:
            DeviceError: A frame already stands elsewhere, or the transform cannot be published.
        """

    def stay(self) -> None:
        """Block for ever, so that published transforms stay.

        Raises:
            DeviceError: The graph was lost.
        """


@dataclass(frozen=True)
class EmulatorOptions:
    """Options of an emulated controller.

    Attributes:
        robot: Model of the arm.
        host: Address it listens on.
        joints: Angles it starts at [rad]; None for a pose of its own choice.
        floor: Height of a horizontal surface the tool can touch [m]; None for no surface.
        faults: Faults to simulate, by the controller's names for them.
        seed: Draws errors of the joints' zeros, as large as the robot's ``joint_accuracy``; None
            for an arm that stands exactly where it reports.
        with_input: Whether the emulator ends when its standard input is closed.
    """

    robot: RobotModel
    host: str = "127.0.0.1"
    joints: tuple[float, ...] | None = None
    floor: float | None = None
    faults: tuple[str, ...] = ()
    seed: int | None = None
    with_input: bool = False


@dataclass(frozen=True)
class Emulator:
    """A controller on loopback.

    Attributes:
        name: Shown in messages and reports.
        maker: Maker of the arms it controls, as ``data/robots/*.yaml`` spells it.
        serve: Runs it until the process receives a signal to end.
    """

    name: str
    maker: str
    serve: Callable[[EmulatorOptions], None]


def find_emulator(offered: Iterable[Emulator], robot: RobotModel) -> Emulator:
    """Return the controller for a robot.

    Raises:
        StageError: No plugin offers one; names the makers for which there is one.
    """
    makers = {loopback.maker: loopback for loopback in offered}
    if robot.maker not in makers:
        known = ", ".join(sorted(makers)) or "none"
        raise StageError(
            f"no controller on loopback for a {robot.model} of {robot.maker}; there is one for "
            f"arms of: {known}"
        )
    return makers[robot.maker]


def read_joints(text: str) -> tuple[float, ...]:
    """Return joint angles [rad] from text such as ``0 -90 90 -90 -90 0 deg``.

    Raises:
        StageError: It is not a row of numbers with one unit at its end.
    """
    *numbers, unit = text.replace(",", " ").split() or [""]
    try:
        return tuple(parse_quantity(f"{number} {unit}", "angle") for number in numbers)
    except ValueError as error:
        raise StageError(f"--joints '{text}': {error}") from None


def read_height(text: str) -> float:
    """Return a height [m] from text such as ``100 mm``.

    Raises:
        StageError: It is not a length.
    """
    try:
        return parse_quantity(text, "length")
    except ValueError as error:
        raise StageError(f"--floor: {error}") from None

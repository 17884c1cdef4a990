"""Controllers on loopback: what a plugin offers so that a robot's own driver can be tried here.

The engine knows no vendor's protocol. A plugin offers a :class:`Emulator` for a maker's arms
through the hook ``flangeye_emulators``; ``flangeye emulator ROBOT`` finds it and lets it serve.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from flangeye.errors import StageError
from flangeye.models.robots import RobotModel
from flangeye.units import parse_quantity


@dataclass(frozen=True)
class EmulatorOptions:
    """What the person asks of a controller on loopback.

    Attributes:
        robot: Which arm.
        host: Address it listens on.
        joints: Angles it starts at [rad]; None for a pose of its own choice.
        floor: Height of a horizontal surface the tool can touch [m]; None for no surface.
        faults: What shall go wrong, in the words of the controller.
        seed: Draws errors of the joints' zeros, as large as the robot's ``joint_accuracy``; None
            for an arm that stands exactly where it says.
        with_input: Whether it ends when its standard input does.
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
        name: For people.
        maker: Whose arms it controls, as ``data/robots/*.yaml`` spells it.
        serve: Runs it until the process is told to end.
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

"""What runs around a cell on a network of nodes: looked at to draft a recipe, and told a pose.

The engine knows no middleware. A plugin offers its graphs by name through the hook
``flangeye_graphs``: ``flangeye init --ros2`` and ``flangeye publish`` use the one named ``ros2``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from flangeye.devices import Device
from flangeye.types import CalibratedPose, Floats


class Topic(NamedTuple):
    """A topic that runs.

    Attributes:
        name: With its namespace.
        type: ``sensor_msgs/msg/PointCloud2``.
        publishers: Names of the nodes that publish it.
        subscribers: How many nodes listen.
    """

    name: str
    type: str
    publishers: tuple[str, ...]
    subscribers: int


@dataclass(frozen=True, eq=False)
class RunningCell:
    """An arm and a camera that run, as a recipe names them.

    Attributes:
        robot: The section of the arm, without limits.
        scanner: The section of the camera, without its model.
        flange: base_T_flange (4, 4) now [m].
        camera: base_T_camera (4, 4) [m], where the graph has it.
        files: Texts of the files that the sections name, by name.
        steps: Steps to add at the recipe's end.
        seen: What runs, a line each for people.
    """

    robot: Mapping[str, Any]
    scanner: Mapping[str, Any]
    flange: Floats
    camera: Floats | None = None
    files: Mapping[str, str] = field(default_factory=dict)
    steps: Sequence[Any] = ()
    seen: Sequence[str] = ()


class Ask(Protocol):
    """How a graph asks for what it cannot see."""

    def __call__(self, flag: str, question: str, default: str | None, example: str = "") -> str:
        """Return the answer to a question: given by the option ``flag``, a person, or by default.

        Raises:
            RecipeError: Nothing is likely, and nobody can be asked.
        """
        ...


class Graph(Device, Protocol):
    """A network of nodes, joined; used as a context."""

    def topics(self) -> list[Topic]:
        """Return the topics that run, by name."""
        ...

    def cell(self, ask: Ask, name: str) -> RunningCell:
        """Return the arm and the camera that run.

        Args:
            ask: For what cannot be seen.
            name: What to call the files.

        Raises:
            FlangeyeError: There is no arm or no camera; says what there is.
        """
        ...

    def publish(self, pose: CalibratedPose, frames: Mapping[str, str]) -> list[str]:
        """Put a pose on the graph as static transforms, until the graph is closed.

        Args:
            pose: Of one camera, or of a whole cell.
            frames: Our name of a frame -> the graph's.

        Returns:
            A line for each transform.

        Raises:
            DeviceError: A frame already stands elsewhere, or the transform cannot be published.
        """
        ...

    def stay(self) -> None:
        """Never return: what was published stays.

        Raises:
            DeviceError: The graph was lost.
        """
        ...

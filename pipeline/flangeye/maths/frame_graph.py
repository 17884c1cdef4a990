"""A graph of frames, each standing on its parent, down to one root. Arrays only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from flangeye.errors import StageError
from flangeye.types import Floats, Indices


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of the graph: its parent and its place there.

    Attributes:
        parent: Its parent frame.
        place: (4, 4) parent_T_frame where it is known and still; (M, 4, 4) where it is measured at
            M times; None where it is still and to be found.
    """

    parent: str
    place: Floats | None = None

    def at(self, times: Indices) -> Frame:
        """Return the frame at some of the times only."""
        if self.place is None or self.place.ndim == 2:
            return self
        return replace(self, place=self.place[times])


def chain(frames: Mapping[str, Frame], name: str) -> list[str]:
    """Return the frames from the root to one, without the root.

    Raises:
        StageError: A frame is its own parent.
    """
    path: list[str] = []
    while name in frames:
        if name in path:
            raise StageError(f"frame '{name}' is its own parent; every frame leads to one root")
        path.insert(0, name)
        name = frames[name].parent
    return path


def composed(frames: Mapping[str, Frame], name: str) -> Floats:
    """Return root_T_frame, (4, 4) or (M, 4, 4), if every place on the path is known.

    The root itself is the identity.
    """
    pose = np.eye(4)
    for each in chain(frames, name):
        pose = pose @ np.asarray(frames[each].place)
    return pose

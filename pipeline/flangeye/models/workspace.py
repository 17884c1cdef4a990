"""Coverage of the workspace by the poses so far: cells of its box, and rotations."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flangeye import types as t
from flangeye.types import Box, Floats
from flangeye.types.geometry import nearest_rotation, rotation_log

LEAST_TURN = np.radians(5.0)
"""A turn by less does not count as one."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """How often each cell was visited, and how far the flange was turned.

    Attributes:
        places: (3, 3, 3) poses in each cell along base x, y, z. A pose outside the box counts for
            the nearest cell.
        turns: (3, 2) largest turn either way about base x, y, z, from the mean of all [rad].
    """

    places: NDArray[np.intp]
    turns: Floats

    def __str__(self) -> str:
        """Return the coverage as a line of text."""
        both = int((self.turns.min(axis=1) >= LEAST_TURN).sum())
        angles = [f"-{low:.0f} to +{high:.0f}" for low, high in np.degrees(self.turns)]
        named = ", ".join(f"{axis} {angle}" for axis, angle in zip("xyz", angles, strict=True))
        return (
            f"{np.count_nonzero(self.places)} of {self.places.size} cells of the workspace; turned "
            f"both ways about {both} of 3 axes of the base ({named} deg)"
        )

    def lacking(self) -> list[str]:
        """Return in words the motion that would add most: missing rotations or regions."""
        out = []
        far = np.radians(20.0)  # as the solver asks for
        for name, turns in zip("xyz", self.turns, strict=True):
            if turns.min() < LEAST_TURN:
                low, high = np.degrees(turns)
                out.append(
                    f"turn the flange both ways about base {name}, by {np.degrees(far):.0f} deg or "
                    f"more (so far -{low:.0f} +{high:.0f} deg)"
                )
        for axis, name in enumerate("xyz"):
            visits = self.places.sum(axis=tuple({0, 1, 2} - {axis}))
            sides = [(visits[0], "low"), (visits[-1], "high")]
            out += [f"go to the {side} end of the work along {name}" for n, side in sides if not n]
        return out


def coverage_of(box: Box, poses: Iterable[Floats]) -> Coverage:
    """Return the part of a box that (4, 4) flange poses in the base have covered."""
    found = np.array(list(poses)).reshape(-1, 4, 4)
    cells = 3  # the cells at the corners of the box are where a turn shows most
    places = np.zeros((cells,) * 3, np.intp)
    if not len(found):
        return Coverage(places, np.zeros((3, 2)))
    # 0 to 1 across the box; a flat box has one layer of cells.
    within = (found[:, :3, 3] - box.centre) / np.maximum(box.size, 1e-9) + 0.5
    np.add.at(places, tuple(np.clip((within * cells).astype(np.intp), 0, cells - 1).T), 1)
    # The arithmetic mean of rotation matrices, made orthonormal, is the chordal mean (Hartley et
    # al. 2013).
    mean = nearest_rotation(found[:, :3, :3].mean(axis=0))
    # From the left: in axes of the base, in which the text names them
    turns = rotation_log(found[:, :3, :3] @ mean.T)
    return Coverage(places, np.column_stack([-turns.min(axis=0), turns.max(axis=0)]).clip(0.0))


def workspace_of(source: t.Source, given: t.Box | None, pairs: Sequence[t.Pair]) -> t.Box | None:
    """Return the recipe's box, or the source's, or the box around the flange's centres."""
    if given or source.workspace:
        return given or source.workspace
    if not pairs:
        return None
    return _around(np.array([pair.observation.tcp_in_base for pair in pairs]))


def work_of(calibration: t.HandEye, source: t.Source, given: t.Box | None) -> t.Box | None:
    """Return the box of the work, in the frame that carries the camera.

    For a camera on the base it is the box of :func:`workspace_of`. For a camera on the robot, and
    in a cell, it is the box around the seen targets.
    """
    camera = calibration.camera.transform
    if camera.parent == t.BASE and (given or source.workspace or camera.child == t.CAMERA):
        return workspace_of(source, given, calibration.pairs)
    observed = [p.observation for p in calibration.pairs if p.observation.camera == camera.child]
    seen = np.array([o.feature.centre for o in observed])
    return _around(camera.apply(seen.reshape(-1, 3)))


def _around(points: t.Array) -> t.Box | None:
    if not len(points):
        return None
    low, high = points.min(axis=0), points.max(axis=0)
    return t.Box((low + high) / 2, high - low)

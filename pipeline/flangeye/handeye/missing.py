"""What the sightings of a graph of frames leave unknown, and what would tell it, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flangeye.handeye.observability import WeakMoves, in_base, telling, weak_moves
from flangeye.maths.frame_graph import Frame, chain
from flangeye.types import Floats

NAMED = 0.1
"""A frame of which a weak move has this share, or more, is one that it leaves unknown."""

Move = tuple[str, tuple[float, ...]]
"""What is moved, and its unit twist in its parent: a turn or a shift."""


@dataclass(frozen=True, eq=False)
class Loops:
    """What sightings close.

    Attributes:
        frames: What stands on what.
        pairs: Each camera, and a target that it saw.
        unknown: The K frames to find.
        scale: (6 K,) how well each number of theirs has to be known [rad, m].
    """

    frames: Mapping[str, Frame]
    pairs: Sequence[tuple[str, str]]
    unknown: Sequence[str]
    scale: Floats

    def told_unknown(self, information: Floats, again: Mapping[Move, Floats]) -> str:
        """Return which frames stay unknown, and which motions or sightings would tell.

        Args:
            information: (6 K, 6 K) that the sightings told.
            again: (6 K, 6 K) that they would tell again, by what is moved for it.
        """
        weak = weak_moves(information, self.scale)
        named = self._named(weak)
        share = np.abs(weak.moves[:, 0] / self.scale).reshape(-1, 2, 3).max(axis=(0, 2))
        motions, left = telling(information, self.scale, again)
        cures = self._asked(motions) + ([self._tie(self._named(left))] if left else [])
        return (
            f"the sightings do not tell where {' and '.join(named)} "
            f"{'are' if len(named) > 1 else 'is'}: a common "
            f"{'turn' if share[0] > share[1] else 'shift'} hardly changes them; {'; '.join(cures)}"
        )

    def _named(self, weak: WeakMoves) -> list[str]:
        share = np.abs(weak.moves / self.scale[:, None]).reshape(len(self.unknown), -1).max(axis=1)
        return [name for name, most in zip(self.unknown, share, strict=True) if most > NAMED]

    def _asked(self, motions: Sequence[Move]) -> list[str]:
        """Return what to move: the turns of each thing, and its shifts."""
        axes: dict[tuple[str, bool], list[str]] = {}
        for name, twist in motions:
            turns = any(twist[:3])
            axis = in_base(np.array(twist[:3] if turns else twist[3:]), 2)
            axes.setdefault((name, turns), []).append(axis)
        return [
            f"{'turn' if turns else 'move'} {name} {'about' if turns else 'along'} "
            f"{' and '.join(told)} of {self.frames[name].parent} by "
            f"{'20 deg' if turns else '0.1 m'} or more, and see it again"
            for (name, turns), told in axes.items()
        ]

    def _tie(self, named: Sequence[str]) -> str:
        """Return what would tell what no motion does: a sighting that ties two parts."""
        ends = dict.fromkeys(end for pair in self.pairs for end in pair)
        moved = [end for end in ends if {*chain(self.frames, end)} & {*named}]
        still = [end for end in ends if end not in moved]
        if not moved:
            return (
                f"no sighting that agrees with others has {' or '.join(named)} in it: let a camera "
                "see it, or it a target, and check what it saw"
            )
        if not still or any(
            (camera in moved) != (target in moved) for camera, target in self.pairs
        ):
            return (
                f"no motion shows where {' and '.join(named)} "
                f"stand{'' if len(named) > 1 else 's'}: say it of {named[0]} (place: in the recipe)"
            )
        return (
            f"no sighting ties {' and '.join(moved)} to {' and '.join(still)}: let a camera of the "
            "one see a target of the other"
        )

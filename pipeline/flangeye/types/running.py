"""What a stage may ask of the run it is part of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NewType, Protocol

from flangeye.types.arrays import Array


@dataclass(frozen=True)
class ArchivePath:
    """What ``--archive`` named on the command line, if anything."""

    path: Path | None = None


class StageLog(Protocol):
    """Logs a value under a name, at once, with the step that asked for it.

    For what a stage does while it runs: where the arm is, what a loop measured and commanded.
    """

    def __call__(self, name: str, value: Any) -> None:
        """Log ``value``: a dataclass of ours, an :class:`Image`, or plain JSON data."""
        ...


@dataclass(frozen=True)
class Progress:
    """What a solver knows while it still takes poses.

    Attributes:
        poses: How many it has.
        error: No point of the workspace is off by more, with 95 % probability [m]; None while
            no answer can be trusted.
        required: When it stops [m].
    """

    poses: int
    error: float | None
    required: float


@dataclass(frozen=True, eq=False)
class Resumed:
    """What an earlier run left.

    Attributes:
        done: Captures that it took, by id; a source leaves them out.
        joints: (n,) angles of the arm at its last capture [rad], if they are known.
    """

    done: frozenset[str]
    joints: Array | None = None


Seed = NewType("Seed", int)
"""The recipe's seed: the only source of randomness a stage may use."""

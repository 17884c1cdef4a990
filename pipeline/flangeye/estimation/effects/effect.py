"""One error source of the mixed model: its design block, size and cause."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from flangeye.estimation.graph import Linear, Problem
from flangeye.types import Floats

Block = Callable[[Problem, Linear], Floats]
"""Gives (N, 6, K) of sightings, measured or planned: what one unit of each of K numbers does."""


@dataclass(frozen=True, eq=False)
class Effect:
    """One error source of a cell.

    Attributes:
        name: For the person, as in "joint zeros".
        block: Its design, of sightings at any poses: those measured, or those of the work.
        size: Prior median of the standard deviation of each number, in its unit.
        factor: By how many times that size is uncertain, one sigma (log-normal).
        cause: Effects of one cause (an arm) have a common quality as well; empty for none.
        of_arm: Whether it displaces an arm against what its controller reports.
        lasting: Whether it is at new poses as it was at those of the session.
        kind: Which part of a correction its numbers are (``zeros``, ``lengths``, ``field``...).
        of_camera: Whether the answer as reported takes its rigid part into the camera's place.
    """

    name: str
    block: Block
    size: float
    factor: float = 2.0
    cause: str = ""
    of_arm: bool = False
    kind: str = ""
    lasting: bool = True
    of_camera: bool = False

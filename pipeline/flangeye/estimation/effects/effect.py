"""One error source of the mixed model: its design block, size and cause."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from flangeye.estimation.graph import Linear, Problem
from flangeye.types import Floats

Block = Callable[[Problem, Linear], Floats]
"""Returns (N, 6, K): derivatives of measured or planned sightings by K parameters."""


@dataclass(frozen=True, eq=False)
class Effect:
    """One error source of a cell.

    Attributes:
        name: Name shown to the user, such as "joint zeros".
        block: Function that returns its design at any sightings: measured ones or those of the
            work.
        size: Prior median of the standard deviation of each number, in its unit.
        factor: Uncertainty of the size as a factor, one sigma (log-normal).
        cause: Cause, such as an arm, whose effects share a quality; empty for none.
        of_arm: Whether it displaces an arm from the reported pose.
        lasting: Whether it stays the same after the session.
        kind: Which part of a correction its numbers are (``zeros``, ``lengths``, ``field``...).
        of_camera: Whether the reported answer moves its rigid part into the camera's place.
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

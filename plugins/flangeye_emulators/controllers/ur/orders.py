"""What the threads of the control script are to do; the script's global variables."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.controllers.compliance import ForceMode


@dataclass
class SpeedOrder:
    """A velocity to keep: a twist (6,) in base, or joint speeds (6,)."""

    in_space: bool
    target: Floats
    acceleration: float


@dataclass
class ServoOrder:
    """Joint angles (6,) to follow."""

    target: Floats
    lookahead: float
    gain: float


@dataclass
class Orders:
    """The latest orders.

    Attributes:
        speed: For the speed thread.
        servo: For the servo thread.
        force: For the force thread.
        force_gain: Scales the force mode's speed; the script starts with a half.
        stops_in_space: Which stop a plain stop command makes. The script looks at what the last
            stop in the background was, not at the command: joints until there was one.
        contact_steps: Cycles since the contact that the contact thread found; 0 for none.
    """

    speed: SpeedOrder | None = None
    servo: ServoOrder | None = None
    force: ForceMode | None = None
    force_gain: float = 0.5
    stops_in_space: bool = False
    contact_steps: int = 0
    jog_axes: Floats = field(default_factory=lambda: np.eye(3))

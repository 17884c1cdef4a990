"""Parameters of ``weld.tactile``."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from flangeye.files.paths import RecipeFile, RecipePath
from flangeye.models.finger import FingerPath
from flangeye.plugin.stage import BoundPart, Choose, Params
from flangeye.units import Angle, AngularSpeed, Duration, Length, Speed, param
from flangeye_plugins.weld.joint import JointKind
from flangeye_plugins.weld.path import Path

ControllerChoice = Annotated[str | BoundPart, Choose("controller", words=("tactile", "vision"))]
"""Follow by touch, by the plan alone, or by a plugin's controller."""

INSIDE = 1.5e-3
"""Distance inside the seam's start at which the tip is set down or returns to the seam [m]."""


class PassParams(Params):
    """A pass after the root pass: it follows the estimated seam without touch."""

    across: Length = param("0 mm", ge=-0.03, le=0.03)
    """Offset to the left of the seam."""
    up: Length = param("3 mm", gt=0, le=0.05)
    """Height above the root pass, of the finger too; it must clear the bead."""
    weave_width: Length = param("0 mm", ge=0, le=0.03)
    """Width of this pass's weave across the seam, from side to side."""


class Following(Params):
    """Parameters of the controller; symbols in brackets are the paper's."""

    # Constants that no cell has needed to change. Gains [1/s]: k_p of the deflection servo, of the
    # preload's servo, and of the torch's cross-track control.
    servo_gain: ClassVar[float] = 3.0
    height_gain: ClassVar[float] = 3.0
    cross_track_gain: ClassVar[float] = 1.0
    # Smallest deflection with which a lost wall is sought, doubled where the seam is uncertain; the
    # weld stops after this distance without contact [m].
    probe: ClassVar[float] = 0.5e-3
    longest_gap: ClassVar[float] = 40e-3
    # Rate limits of the deflection's set point: in general, and for its release at the end [m/s].
    ramp: ClassVar[float] = 2e-3
    release: ClassVar[float] = 0.8e-3
    # Largest speed across the seam and in height, and speed of the tool between two passes [m/s].
    lateral_speed: ClassVar[float] = 5e-3
    return_speed: ClassVar[float] = 20e-3
    # Distance inside the planned start at which the tip is set down, and before the planned end at
    # which it is released; ``ends`` may increase both [m].
    inset: ClassVar[float] = 5e-3
    ending: ClassVar[float] = 8e-3
    # Largest distance of the tip from the plan; standard deviation of the seam about the plan's
    # shape; largest height of the torch's end above or below the seam [m].
    astray: ClassVar[float] = 20e-3
    wander: ClassVar[float] = 0.3e-3
    torch_height: ClassVar[float] = 8e-3
    # A measurement is accepted once contact has lasted this long after it [s]. A tip that fell off
    # the start returns to the seam this far above its seated height [m].
    sure: ClassVar[float] = 0.3
    over: ClassVar[float] = 1e-3
    # Standard deviation of the walls' angles [rad].
    joint_sigma: ClassVar[float] = math.radians(1.0)

    speed: Speed = param("5 mm/s", gt=0, le=0.05)
    """Speed of the tip along the seam."""
    side: Literal["left", "right"] = "left"
    """Which wall of the groove to press, seen along the seam."""
    deflection: Length = param("2 mm", gt=0, le=0.01)
    """Deflection of the tip against the wall (delta_d)."""
    preload: Length = param("1.5 mm", gt=0, le=0.01)
    """Displacement of the tip into the groove."""
    turn_rate: AngularSpeed = param("20 deg/s", gt=0, le=2.0)
    """Largest angular velocity of the tool."""
    reach: Length = param("8 mm", gt=0)
    """Largest distance from the plan at which the wall is sought at the start."""
    friction: float = Field(0.3, ge=0, le=1)
    """Largest coefficient of friction to expect between tip and work."""
    max_error: Length = param("1 mm", gt=0)
    """The weld is refused or stopped where the torch's stated bound exceeds this."""
    sigmas: float = Field(3.0, gt=0, le=6)
    """Coverage of the torch's error bound along the whole seam, in standard deviations of a normal
    distribution: it fails in one weld of 370 for 3, in one of 16,000 for 4. The control error is
    added to the bound."""
    arm_sigma: Length = param("0.03 mm", ge=0)
    """Standard deviation of the arm's position error across the seam, once when the tip passes a
    place and once when the torch does."""
    distortion: Length = param("0.05 mm", ge=0)
    """Standard deviation of the seam's thermal displacement after the tip has passed a place and
    before the torch does."""
    gain_drift: float = Field(0.05, ge=0, le=1)
    """Standard deviation of the drift of the finger's gain in a minute."""
    joint: JointKind = "groove"
    """groove, butt and corner hold the tip between two walls; in a fillet or lap joint it lies on a
    flat plate against a wall on its side. Where the plan knows a half_angle both walls lean by it
    from the opening."""
    root_gap: Length = param("0 mm", ge=0)
    """Gap between the plates of a butt joint with square edges, on which the tip rests."""
    work_angle: Angle = param("0 deg", ge=-np.pi / 3, le=np.pi / 3)
    """Angle by which the tool's upper end leans away from the pressed wall."""
    travel_angle: Angle = param("0 deg", ge=-np.pi / 6, le=np.pi / 6)
    """Angle by which the tool's upper end leans forwards along the seam."""
    offset_across: Length = param("0 mm", ge=-0.02, le=0.02)
    """Offset of the torch to the left of the seam."""
    ends: Length | None = param(None, ge=0, le=0.03)
    """Largest distance of the seam's true ends from the planned ones. If given, the tip looks for
    them: it moves back until it falls off the start and, between two walls, on until it falls off
    the end. Beyond an end that it does not find, the torch welds this much further."""
    overlap: Length = param("30 mm", gt=0)
    """Length of the bead before a stop that a resumed weld covers again; also the length by which a
    closed seam is welded over its start."""
    weave_width: Length = param("0 mm", ge=0, le=0.03)
    """Width of the weave across the seam, from side to side; the tool turns about its tip."""
    weave_frequency: float = Field(1.0, gt=0, le=10)
    """Frequency of the weave [Hz]."""
    passes: tuple[PassParams, ...] = Field((), max_length=20)
    """Passes after the root pass, in order."""
    blind: Duration = param("500 ms", gt=0)
    """Longest time without an image of the tag while the arc burns, four times as long before; then
    the weld is stopped. After a fifth of it the weld slows down, after three tenths the arm waits
    for an image."""

    @property
    def stale(self) -> float:
        """Time without an image of the tag after which the weld slows down [s]."""
        return 0.2 * self.blind

    @property
    def still(self) -> float:
        """Time without an image of the tag after which the arm is commanded to stop [s].

        The arm comes to rest later, by the images' latency and its braking time.
        """
        return 0.3 * self.blind

    @property
    def set_down(self) -> float:
        """Arc length at which the tip is set down, well inside the seam [m]."""
        return self.inset if self.ends is None else max(self.inset, self.ends + INSIDE)

    def overlapping(self, plan: Path) -> float:
        """Return the length by which a closed seam is welded over its start [m]; 0 if open."""
        return self.overlap if plan.closed else 0.0

    @property
    def sign(self) -> float:
        """Side of the pressed wall: 1 left, -1 right."""
        return 1.0 if self.side == "left" else -1.0


class WeldTactileParams(Following):
    """Parameters of ``weld.tactile``."""

    # Approach to the seam, within the recipe's limits: speed of the flange [m/s] and of the joints
    # [rad/s]; height of the tip above the planned start before it descends [m].
    approach_speed: ClassVar[float] = 50e-3
    approach_joint_speed: ClassVar[float] = math.radians(20.0)
    clearance: ClassVar[float] = 15e-3

    finger: FingerPath = param("srm")
    """One of data/fingers, or a .yaml file of your own."""
    sensor: Annotated[BoundPart, Choose("sensor")]
    """Source of the finger's images, for example {opencv: {device: 0}}."""
    profiler: Annotated[BoundPart, Choose("profiler")] | None = None
    """A profile sensor that sees the bead behind the torch, for example {tcp: {host: 192.168.1.20,
    port: 9000, behind: 30 mm}}. The thermal distortion and torch offset that it measures are
    compensated."""
    arc: Annotated[BoundPart, Choose("arc")] | None = None
    """The power source, for example {ur_digital: {host: 192.168.1.10, output: 3}}: it is switched
    as the torch's bound allows, and goes off with any stop of the arm."""
    mode: ControllerChoice = "tactile"
    """tactile: follow the seam by touch. For comparison: vision follows the plan alone and touches
    nothing; any other name is that of a controller plugin."""
    leg: int | None = Field(None, ge=1)
    """Number of the leg between sharp corners of the plan that this step welds."""
    corner_radius: Length | None = param(None, gt=0)
    """Tip and torch go round the plan's sharp corners without a stop, on arcs of this radius.
    Without it the torch stops there: each leg is a step."""
    resume: RecipeFile | None = None
    """The run.mcap of a stopped weld, which is resumed with its measurements."""
    prior: RecipePath | None = None
    """A .yaml file with estimates of tip, play and clock from earlier welds. It is read if present
    and written after a weld; delete it to begin anew."""

    @model_validator(mode="after")
    def _follows_by_touch(self) -> Self:
        """Refuse options that do not go together.

        Arc and profile sensor need the error bound, which only mode tactile has. The profile sensor
        measures the bead of a single pass without weave.
        """
        for name in ("arc", "profiler"):
            if getattr(self, name) is not None and self.mode != "tactile":
                raise ValueError(f"'{name}' goes with mode: tactile only: leave out one of them")
        for name in ("passes", "weave_width"):
            if self.profiler is not None and getattr(self, name):
                told = f"'profiler' is for one pass that does not weave: leave out '{name}'"
                raise ValueError(told)
        return self

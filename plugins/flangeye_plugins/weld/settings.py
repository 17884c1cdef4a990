"""How to follow, with units: part of the parameters of ``weld.tactile``."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from flangeye.files.paths import RecipePath
from flangeye.models.finger import FingerPath
from flangeye.plugin.stage import BoundPart, Choose, Params
from flangeye.units import Angle, AngularSpeed, Duration, Force, Length, Speed, param
from flangeye_plugins.weld.joint import JointKind

Mode = Annotated[str | BoundPart, Choose("controller", words=("tactile", "vision"))]
"""By touch, by the plan alone, or as a controller of a plugin decides."""

INSIDE = 1.5e-3
"""The tip is set down, or goes back to, where the seam has surely begun by this [m]."""


class PassParams(Params):
    """A pass after the root's, along the path that this has found; nothing is touched."""

    across: Length = param("0 mm", ge=-0.03, le=0.03, description="To the left of the seam.")
    up: Length = param(
        "3 mm", gt=0, le=0.05, description="Higher than the root pass, the finger too; it must "
        "clear what was welded.",
    )  # fmt: skip
    along: Length = param("0 mm", ge=0, description="It begins so far after the seam does.")
    weave_width: Length = param("0 mm", ge=0, le=0.03, description="As of the weld itself.")
    weave_frequency: float = Field(1.0, gt=0, le=10)


class Following(Params):
    """The controller's parameters; names in brackets are the paper's."""

    # What no cell needs otherwise. Gains of the preload's control, and by which an error of the
    # torch is taken back [1/s]; the deflection with which lost contact is felt for [m], twice it
    # where little is known of where the seam leads, and how fast a wanted deflection is changed,
    # and ended before the seam ends [m/s].
    height_gain: ClassVar[float] = 3.0
    cross_track_gain: ClassVar[float] = 1.0
    probe: ClassVar[float] = 0.5e-3
    ramp: ClassVar[float] = 2e-3
    release: ClassVar[float] = 0.8e-3
    # Farther from the plan the tip stops the weld; standard deviation of the seam about the plan's
    # shape [m].
    astray: ClassVar[float] = 20e-3
    wander: ClassVar[float] = 0.3e-3

    speed: Speed = param("5 mm/s", gt=0, le=0.05, description="Speed of the tip along the seam.")
    side: Literal["left", "right"] = Field(
        "left", description="Which wall of the groove to press, seen along the seam."
    )
    deflection: Length = param(
        "2 mm", gt=0, le=0.01, description="Deflection of the tip against the wall (delta_d)."
    )
    preload: Length = param(
        "1.5 mm", gt=0, le=0.01, description="Displacement of the tip into the groove."
    )
    servo_gain: float = Field(3.0, gt=0, le=20, description="k_p of the deflection servo [1/s].")
    lateral_speed: Speed = param(
        "5 mm/s", gt=0, le=0.05, description="Largest speed across the seam, and in height."
    )
    turn_rate: AngularSpeed = param(
        "20 deg/s", gt=0, le=2.0, description="Largest angular velocity of the tool."
    )
    inset: Length = param(
        "5 mm", ge=0, description="How far inside the planned start the tip is set down."
    )
    ending: Length = param(
        "8 mm", ge=0, description="How far before the planned end the tip stops pressing."
    )
    reach: Length = param(
        "8 mm", gt=0, description="How far from the plan the wall is sought at the start."
    )
    longest_gap: Length = param(
        "40 mm", gt=0, description="Without contact for longer, the weld is stopped."
    )
    force: Force = param("10 N", gt=0, description="Largest force of the tip, by its stiffness.")
    stale: Duration = param(
        "100 ms", gt=0, description="Without a new image of the tag for longer the weld slows down."
    )
    still: Duration = param(
        "150 ms", gt=0, description="Without one for longer the arm stands until one comes: at "
        "rest, since the last image was taken, after this, the images' latency and its braking.",
    )  # fmt: skip
    friction: float = Field(
        0.3, ge=0, le=1, description="Largest coefficient of the tip on the work to reckon with."
    )
    max_error: Length = param(
        "1 mm", gt=0, description="The weld is refused or stopped where the torch's stated bound "
        "exceeds this.",
    )  # fmt: skip
    sigmas: float = Field(
        3.0, gt=0, le=6, description="The torch's bound: its control error and so many standard "
        "deviations. True errors are beyond 3 in one weld of 370, beyond 4 in one of 16,000.",
    )  # fmt: skip
    arm_sigma: Length = param(
        "0.03 mm", ge=0, description="Standard deviation of what the arm is off by, across the "
        "seam, when the tip passes a place; the torch's passing has the same.",
    )  # fmt: skip
    distortion: Length = param(
        "0.05 mm", ge=0, description="Standard deviation of how far heat moves the seam between "
        "the tip's and the torch's passing one place.",
    )  # fmt: skip
    gain_drift: float = Field(
        0.05, ge=0, le=1, description="Standard deviation of the finger's gain after a minute."
    )
    probing: bool = Field(
        True, description="Sweep the seated tip at the start: finger, clock and arm are measured."
    )
    joint: JointKind = Field(
        "groove",
        description="groove, butt and corner hold the tip between two walls; in a fillet or lap "
        "joint it lies on a flat plate against a wall on its side. Where the plan knows a "
        "half_angle both walls lean by it from the opening.",
    )
    root_gap: Length = param(
        "0 mm", ge=0, description="Between the plates of a butt joint with square edges: the tip "
        "rests on these.",
    )  # fmt: skip
    joint_sigma: Angle = param(
        "1 deg", ge=0, description="Standard deviation of the walls' angles."
    )
    tip_radius: Length | None = param(
        None, gt=0, description="Radius of the tip's ball, where it is not the one of the finger's "
        "file.",
    )  # fmt: skip
    work_angle: Angle = param(
        "0 deg", ge=-np.pi / 3, le=np.pi / 3,
        description="The tool's upper end leans away from the pressed wall by this.",
    )  # fmt: skip
    travel_angle: Angle = param(
        "0 deg", ge=-np.pi / 6, le=np.pi / 6,
        description="The tool's upper end leans forwards along the seam by this.",
    )  # fmt: skip
    offset_across: Length = param(
        "0 mm", ge=-0.02, le=0.02,
        description="How far to the left of the seam the torch is led.",
    )  # fmt: skip
    ends: Length | None = param(
        None, ge=0, le=0.03, description="How far the seam's ends may be off along the plan, which "
        "touch does not tell. Where it is given the tip first feels its way back to where the seam "
        "has surely begun, and the torch welds so far beyond both planned ends.",
    )  # fmt: skip
    offset_along: Length = param(
        "0 mm", description="How far after the planned start the torch begins to weld."
    )
    weave_width: Length = param(
        "0 mm", ge=0, le=0.03,
        description="The torch swings across the seam by this from side to side, the tool turning "
        "about its tip.",
    )  # fmt: skip
    weave_frequency: float = Field(1.0, gt=0, le=10, description="How often it does in a second.")
    passes: tuple[PassParams, ...] = Field(
        (), max_length=20, description="Passes after the root's, in their order."
    )
    return_speed: Speed = param(
        "20 mm/s", gt=0, le=0.1, description="Speed of the tool between two passes."
    )
    torch_height: Length = param(
        "8 mm", gt=0,
        description="The torch's end may be higher or lower than the seam by at most this.",
    )  # fmt: skip
    blind: Duration = param(
        "500 ms",
        gt=0,
        description="Without a tag for longer while the arc burns, or for four times as "
        "long before, the weld is stopped.",
    )

    @property
    def set_down(self) -> float:
        """Where on the plan the tip is set down, by arc length: the seam has surely begun [m]."""
        return self.inset if self.ends is None else max(self.inset, self.ends + INSIDE)

    @property
    def sign(self) -> float:
        """1 where the left wall is pressed, -1 for the right one."""
        return 1.0 if self.side == "left" else -1.0


class WeldTactileParams(Following):
    """Parameters of ``weld.tactile``."""

    finger: FingerPath = param(
        "srm", description="One of data/fingers, or a .yaml file of one's own."
    )
    sensor: Annotated[BoundPart, Choose("sensor")] = Field(
        description="What gives the finger's images, for example {opencv: {device: 0}}."
    )
    look: Annotated[BoundPart, Choose("profiler")] | None = Field(
        None,
        description="A profile sensor that sees the bead behind the torch, for example {tcp: "
        "{host: 192.168.1.20, port: 9000, behind: 30 mm}}: what it sees of heat, and of where the "
        "torch really is, is made up for.",
    )
    arc: Annotated[BoundPart, Choose("arc")] | None = Field(
        None,
        description="The power source, for example {ur_digital: {host: 192.168.1.10, output: 3}}: "
        "it is switched as the torch's bound allows, and goes off with any stop of the arm.",
    )
    mode: Mode = Field(
        "tactile",
        description="tactile: follow the seam by touch. For comparison: vision follows the plan "
        "alone and touches nothing; any other name is that of a controller plugin.",
    )
    log_images: bool = Field(
        True, description="Log what was read of every image, 17 kB each; replaying needs it."
    )
    leg: int | None = Field(
        None, ge=1,
        description="Of a plan with sharp corners, which leg between them this step welds; at a "
        "corner the torch stops.",
    )  # fmt: skip
    corners: Literal["stop", "round"] = Field(
        "stop",
        description="stop: the torch stops at a sharp corner, each leg is a step. round: tip and "
        "torch go round it without a stop.",
    )
    corner_radius: Length = param(
        "5 mm", gt=0, description="Of the arc that a rounded corner of the plan becomes."
    )
    clearance: Length = param(
        "15 mm", gt=0, description="Height of the tip above the planned start, before it descends."
    )
    approach_speed: Speed = param(
        "50 mm/s", gt=0, description="Speed of the flange on its way there."
    )
    approach_joint_speed: AngularSpeed = param(
        "20 deg/s", gt=0, description="Speed of the joints on the way there."
    )
    resume: RecipePath | None = Field(
        None,
        description="The run.mcap of a weld that was stopped: goes on with what was felt.",
    )
    prior: RecipePath | None = Field(
        None,
        description="A .yaml file of what earlier welds have found of tip, play and clock: read "
        "where it exists, written when a weld is done; delete it to begin anew.",
    )
    overlap: Length = param(
        "30 mm", gt=0, description="How far before the stop the torch begins again, to go on."
    )
    start_angle: Angle = param(
        "0 deg", ge=-np.pi, le=np.pi, description="Angle of the tool to the seam at the start."
    )

    @model_validator(mode="after")
    def _arc_is_led_by_touch(self) -> Self:
        """Refuse an arc where no bound says when it may burn."""
        if self.arc is not None and self.mode != "tactile":
            raise ValueError("'arc' goes with mode: tactile only: leave out one of them")
        return self

    @model_validator(mode="after")
    def _look_has_one_pass(self) -> Self:
        """Refuse a look behind the torch where what it sees cannot be made up for."""
        if self.look is None:
            return self
        if self.mode != "tactile":
            raise ValueError("'look' goes with mode: tactile only: leave out one of them")
        for name in ("passes", "weave_width"):
            if getattr(self, name):
                raise ValueError(f"'look' is for one pass that does not weave: leave out '{name}'")
        return self

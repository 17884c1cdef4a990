"""What is true in a simulated weld: its tool's file, and by how much the rest is off."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BeforeValidator, Field

from flangeye.files.paths import WHOLE, bundled_file
from flangeye.models.finger import FingerGeometry
from flangeye.plugin.stage import Params
from flangeye.units import Angle, Duration, Length, Stiffness, param


class ToolFile(FingerGeometry):
    """A world's finger and torch as they really are, in a file that no controller reads."""

    lateral: Stiffness = param(gt=0, description="Across the finger, at its tip.")
    axial: Stiffness = param(gt=0, description="Along the finger.")


ToolPath = Annotated[Path, BeforeValidator(bundled_file("true tool", "worlds")), WHOLE]
"""A parameter that names a world's tool: a bundled one, or a file beside the recipe."""


class ArmTruth(Params):
    """Errors of the simulated arm: how it follows, and how far its true pose is off."""

    lag: Duration = param("0 ms", ge=0, description="Time constant with which it follows.")
    dead_time: Duration = param("0 ms", ge=0, description="Before a command has any effect.")
    wave: Length = param("0 mm", ge=0, description="Amplitude of its error along its way.")
    wave_length: Length = param("80 mm", gt=0, description="Period of that error.")
    backlash: Length = param("0 mm", ge=0, description="Lost motion across the seam.")
    repeatability: Length = param("0 mm", ge=0, description="Standard deviation, cycle by cycle.")
    scale: float = Field(0.0, description="Relative error of distances: zeros of joints, lengths.")
    sag: Length = param("0 mm", ge=0, description="How far it is lower after 100 mm of way.")


class ToolTruth(Params):
    """Where tip and torch really are, beside where the world's file puts them."""

    tip: tuple[Length, Length, Length] = param(
        ("0 mm", "0 mm", "0 mm"), description="Tip: ahead, to the left, up."
    )
    torch: tuple[Length, Length] = param(("0 mm", "0 mm"), description="Torch: ahead, to the left.")
    yaw: Angle = param("0 deg", description="Turn of finger and torch about the tool's axis.")
    work: Angle = param(
        "0 deg", description="Its upper end leans to the right by this about its tip."
    )
    travel: Angle = param(
        "0 deg", description="Its upper end leans forwards by this about its tip."
    )


class FingerTruth(Params):
    """How the finger deforms, and what its tag shows of it."""

    lateral: float = Field(
        1.0, gt=0, description="Stiffness across, as a share of the world file's."
    )
    axial: float = Field(1.0, gt=0, description="Stiffness along, as a share of the world file's.")
    gain: float = Field(0.0, description="The tag shows displacements larger by this share.")
    drift: float = Field(0.0, description="Change of the gain in 60 s, as it warms.")
    rest: tuple[Length, Length, Length] = param(
        ("0 mm", "0 mm", "0 mm"), description="What the tag shows of an undeformed finger."
    )
    play: Length = param("0 mm", ge=0, description="The tip moves by this before the tag does.")
    hysteresis: float = Field(0.0, ge=0, lt=1, description="Share of a displacement that lags.")
    creep: float = Field(0.0, description="Share by which a displacement grows in time.")
    creep_time: Duration = param("10 s", gt=0)
    friction: float = Field(0.1, ge=0, le=1, description="Coulomb coefficient, along and across.")
    noise: Length = param(
        "10 um", ge=0, description="Standard deviation of a measurement across; 6 times that up."
    )


class ClockTruth(Params):
    """When images are taken, when they arrive, and what their timestamps say."""

    rate: float = Field(30.0, gt=0, le=200, description="Images per second.")
    latency: Duration = param("30 ms", ge=0, description="From the exposure to the image.")
    jitter: Duration = param("5 ms", ge=0, description="Standard deviation of the latency.")
    stamp: Duration = param("0 ms", description="Timestamps are late by this.")
    drift: float = Field(0.0, description="Rate at which timestamps run ahead, s/s.")
    dropped: float = Field(0.02, ge=0, lt=1, description="Share of images that never arrive.")
    hidden: tuple[Duration, Duration] | None = param(
        None, description="The tag is out of sight from the first time to the second."
    )


class Tack(Params):
    """A tack weld: the groove is filled there."""

    start: Length = param(ge=0)
    length: Length = param("8 mm", gt=0)
    height: Length = param("1 mm", ge=0)


class GapParams(Params):
    """A piece of a wall that is missing."""

    start: Length = param(ge=0, description="Where it begins, along the seam.")
    length: Length = param("20 mm", gt=0)
    side: int = Field(1, ge=-1, le=1, description="1 the left wall, -1 the right one.")


class WorkpieceTruth(Params):
    """What the workpiece is like, beside its CAD."""

    wave: Length = param("0 mm", ge=0, description="Amplitude with which its edges wander.")
    wave_length: Length = param("10 mm", gt=0)
    bow: Length = param("0 mm", description="How far its middle is aside of the CAD's curve.")
    half_angle: Angle = param("0 deg", description="Added to the CAD's half angle of its walls.")
    lean: Angle = param("0 deg", description="How far its walls lean to the left of the CAD's.")
    half_angle_wave: Angle = param("0 deg", ge=0, description="Amplitude of its variation.")
    root_gap: Length = param("0 mm", ge=0, description="Between the plates.")
    tacks: tuple[Tack, ...] = ()
    spatter: Length = param("0 mm", ge=0, description="Standard deviation of its roughness.")
    gaps: tuple[GapParams, ...] = Field((), description="Pieces of a wall that are missing.")


class HeatTruth(Params):
    """How the seam moves while it is welded."""

    shift: Length = param("0 mm", description="Across the seam, from the start of the arc to its "
                          "end.")  # fmt: skip
    local: Length = param("0 mm", description="Around the torch.")
    radius: Length = param("15 mm", gt=0, description="How far that reaches.")


class LookTruth(Params):
    """A profile sensor behind the torch: what it sees, and when."""

    behind: Length = param("30 mm", gt=0, le=0.2, description="How far behind the torch it looks.")
    noise: Length = param("0.05 mm", gt=0, description="Standard deviation of one look; stated.")
    clock: ClockTruth = Field(
        ClockTruth.model_validate({"rate": 10.0, "latency": "50 ms", "dropped": 0.1}),
        description="When it looks, when its measurements arrive, and which it misses.",
    )


class WorldParams(Params):
    """All that is true of a simulated weld."""

    arm: ArmTruth = ArmTruth()
    tool: ToolTruth = ToolTruth()
    finger: FingerTruth = FingerTruth()
    clock: ClockTruth = ClockTruth()
    workpiece: WorkpieceTruth = WorkpieceTruth()
    heat: HeatTruth = HeatTruth()

"""Truth of a simulated weld, from its tool's and its world's files.

A recipe names one of ``data/worlds``, or a file of its own. Lengths [m], angles [rad], times [s];
in the files each has its unit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar, dataclass_transform

from pydantic import BeforeValidator, ConfigDict, with_config

from flangeye.files.paths import WHOLE, bundled_file
from flangeye.models.finger import FingerGeometry
from flangeye.models.model import readable
from flangeye.units import Angle, Duration, Length, Stiffness, param
from flangeye_emulators.weld_world.groove import Gap

T = TypeVar("T")


class ToolFile(FingerGeometry):
    """A world's finger and torch as they really are, in a file that no controller reads."""

    lateral: Stiffness = param(gt=0, description="Across the finger, at its tip.")
    axial: Stiffness = param(gt=0, description="Along the finger.")


ToolPath = Annotated[
    Path, BeforeValidator(bundled_file("true tool", "tools")), readable(ToolFile), WHOLE
]
"""A parameter that names a world's tool: a bundled one, or a file beside the recipe."""


@dataclass_transform(frozen_default=True)
def checked(cls: type[T]) -> type[T]:
    """Return a frozen dataclass from a file; refuse keys it does not have."""
    return with_config(ConfigDict(extra="forbid"))(dataclass(frozen=True)(cls))


@checked
class ArmTruth:
    """Errors of the simulated arm: how it follows, and how far its true pose is off.

    Attributes:
        lag: Time constant with which it follows.
        dead_time: Before a command has any effect.
        wave: Amplitude of its error along its way.
        wave_length: Period of that error.
        backlash: Lost motion across the seam.
        repeatability: Standard deviation, cycle by cycle.
        scale: Relative error of distances: zeros of joints, lengths.
        sag: How far it is lower after 100 mm of way.
    """

    lag: Duration = 0.0
    dead_time: Duration = 0.0
    wave: Length = 0.0
    wave_length: Length = 80e-3
    backlash: Length = 0.0
    repeatability: Length = 0.0
    scale: float = 0.0
    sag: Length = 0.0


@checked
class ToolTruth:
    """True places of tip and torch, relative to the finger's file.

    Attributes:
        tip: Ahead, to the left, up.
        torch: Ahead, to the left.
        yaw: Turn of finger and torch about the tool's axis.
        work: Its upper end leans to the right by this about its tip.
    """

    tip: tuple[Length, Length, Length] = (0.0, 0.0, 0.0)
    torch: tuple[Length, Length] = (0.0, 0.0)
    yaw: Angle = 0.0
    work: Angle = 0.0


@checked
class FingerTruth:
    """True deformation of the finger, and the tag's response.

    Attributes:
        lateral: Stiffness across, as a share of the world file's.
        axial: Stiffness along, as a share of the world file's.
        gain: The tag shows displacements larger by this share.
        drift: Change of the gain in 60 s, as it warms.
        rest: Pose of the tag on an undeformed finger.
        play: The tip moves by this before the tag does.
        hysteresis: Share of a displacement that lags.
        creep: Share by which a displacement grows in time, 10 s.
        friction: Coulomb coefficient, along and across.
        noise: Standard deviation of a measurement across; 6 times that up.
    """

    lateral: float = 1.0
    axial: float = 1.0
    gain: float = 0.0
    drift: float = 0.0
    rest: tuple[Length, Length, Length] = (0.0, 0.0, 0.0)
    play: Length = 0.0
    hysteresis: float = 0.0
    creep: float = 0.0
    friction: float = 0.1
    noise: Length = 10e-6


@checked
class ClockTruth:
    """When images are exposed and arrive, and what their timestamps state.

    Attributes:
        rate: Images per second.
        latency: From the exposure to the image.
        jitter: Standard deviation of the latency.
        stamp: Timestamps are late by this.
        dropped: Share of images that never arrive.
        hidden: Something covers the tag from the first time to the second.
    """

    rate: float = 30.0
    latency: Duration = 30e-3
    jitter: Duration = 5e-3
    stamp: Duration = 0.0
    dropped: float = 0.02
    hidden: tuple[Duration, Duration] | None = None


@checked
class Tack:
    """A tack weld of 8 mm: the groove is filled there.

    Attributes:
        start: Where it begins, along the seam.
        height: By how much it is filled.
    """

    start: Length
    height: Length = 1e-3


@checked
class WorkpieceTruth:
    """True shape of the workpiece, relative to its CAD.

    Attributes:
        wave: Amplitude with which its edges wander.
        wave_length: Period of that.
        bow: How far its middle is aside of the CAD's curve.
        half_angle: Added to the CAD's half angle of its walls.
        lean: How far its walls lean to the left of the CAD's.
        half_angle_wave: Amplitude of the half angle's variation.
        root_gap: Between the plates.
        tacks: Tack welds.
        spatter: Standard deviation of its roughness.
        gaps: Pieces of a wall that are missing.
    """

    wave: Length = 0.0
    wave_length: Length = 10e-3
    bow: Length = 0.0
    half_angle: Angle = 0.0
    lean: Angle = 0.0
    half_angle_wave: Angle = 0.0
    root_gap: Length = 0.0
    tacks: tuple[Tack, ...] = ()
    spatter: Length = 0.0
    gaps: tuple[Gap, ...] = ()


@checked
class HeatTruth:
    """How the seam moves while it is welded.

    Attributes:
        shift: Across the seam, from the start of the arc to its end.
        local: Around the torch, within some 15 mm.
    """

    shift: Length = 0.0
    local: Length = 0.0


@checked
class LookTruth:
    """A profile sensor behind the torch: its field of view and timing.

    Attributes:
        behind: How far behind the torch it looks.
        noise: Standard deviation of one look; stated.
        clock: When it looks, when its measurements arrive, and which it misses.
    """

    behind: Length = 30e-3
    noise: Length = 0.05e-3
    clock: ClockTruth = ClockTruth(rate=10.0, latency=50e-3, dropped=0.1)


@checked
class WeldTruth:
    """The whole truth of a simulated weld: the content of a world's file."""

    arm: ArmTruth = ArmTruth()
    tool: ToolTruth = ToolTruth()
    finger: FingerTruth = FingerTruth()
    clock: ClockTruth = ClockTruth()
    workpiece: WorkpieceTruth = WorkpieceTruth()
    heat: HeatTruth = HeatTruth()


WorldPath = Annotated[
    Path, BeforeValidator(bundled_file("world", "worlds")), readable(WeldTruth), WHOLE
]
"""A parameter that names a world: a bundled one, or a file beside the recipe."""

"""What is true in a simulated weld: its tool's file, and by how much the rest is off.

Lengths [m], angles [rad], times [s]. A recipe names one of :data:`WORLDS`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator

from flangeye.files.paths import WHOLE, bundled_file
from flangeye.models.finger import FingerGeometry
from flangeye.units import Stiffness, param
from flangeye_emulators.weld_world.groove import Gap


class ToolFile(FingerGeometry):
    """A world's finger and torch as they really are, in a file that no controller reads."""

    lateral: Stiffness = param(gt=0, description="Across the finger, at its tip.")
    axial: Stiffness = param(gt=0, description="Along the finger.")


ToolPath = Annotated[Path, BeforeValidator(bundled_file("true tool", "worlds")), WHOLE]
"""A parameter that names a world's tool: a bundled one, or a file beside the recipe."""


@dataclass(frozen=True)
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

    lag: float = 0.0
    dead_time: float = 0.0
    wave: float = 0.0
    wave_length: float = 80e-3
    backlash: float = 0.0
    repeatability: float = 0.0
    scale: float = 0.0
    sag: float = 0.0


@dataclass(frozen=True)
class ToolTruth:
    """Where tip and torch really are, beside where the world's file puts them.

    Attributes:
        tip: Ahead, to the left, up.
        torch: Ahead, to the left.
        yaw: Turn of finger and torch about the tool's axis.
        work: Its upper end leans to the right by this about its tip.
    """

    tip: tuple[float, float, float] = (0.0, 0.0, 0.0)
    torch: tuple[float, float] = (0.0, 0.0)
    yaw: float = 0.0
    work: float = 0.0


@dataclass(frozen=True)
class FingerTruth:
    """How the finger deforms, and what its tag shows of it.

    Attributes:
        lateral: Stiffness across, as a share of the world file's.
        axial: Stiffness along, as a share of the world file's.
        gain: The tag shows displacements larger by this share.
        drift: Change of the gain in 60 s, as it warms.
        rest: What the tag shows of an undeformed finger.
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
    rest: tuple[float, float, float] = (0.0, 0.0, 0.0)
    play: float = 0.0
    hysteresis: float = 0.0
    creep: float = 0.0
    friction: float = 0.1
    noise: float = 10e-6


@dataclass(frozen=True)
class ClockTruth:
    """When images are taken, when they arrive, and what their timestamps say.

    Attributes:
        rate: Images per second.
        latency: From the exposure to the image.
        jitter: Standard deviation of the latency.
        stamp: Timestamps are late by this.
        dropped: Share of images that never arrive.
        hidden: Something covers the tag from the first time to the second.
    """

    rate: float = 30.0
    latency: float = 30e-3
    jitter: float = 5e-3
    stamp: float = 0.0
    dropped: float = 0.02
    hidden: tuple[float, float] | None = None


@dataclass(frozen=True)
class Tack:
    """A tack weld of 8 mm: the groove is filled there.

    Attributes:
        start: Where it begins, along the seam.
        height: By how much it is filled.
    """

    start: float
    height: float = 1e-3


@dataclass(frozen=True)
class WorkpieceTruth:
    """What the workpiece is like, beside its CAD.

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

    wave: float = 0.0
    wave_length: float = 10e-3
    bow: float = 0.0
    half_angle: float = 0.0
    lean: float = 0.0
    half_angle_wave: float = 0.0
    root_gap: float = 0.0
    tacks: tuple[Tack, ...] = ()
    spatter: float = 0.0
    gaps: tuple[Gap, ...] = ()


@dataclass(frozen=True)
class HeatTruth:
    """How the seam moves while it is welded.

    Attributes:
        shift: Across the seam, from the start of the arc to its end.
        local: Around the torch, within some 15 mm.
    """

    shift: float = 0.0
    local: float = 0.0


@dataclass(frozen=True)
class LookTruth:
    """A profile sensor behind the torch: what it sees, and when.

    Attributes:
        behind: How far behind the torch it looks.
        noise: Standard deviation of one look; stated.
        clock: When it looks, when its measurements arrive, and which it misses.
    """

    behind: float = 30e-3
    noise: float = 0.05e-3
    clock: ClockTruth = ClockTruth(rate=10.0, latency=50e-3, dropped=0.1)


@dataclass(frozen=True)
class WeldTruth:
    """All that is true of a simulated weld."""

    arm: ArmTruth = ArmTruth()
    tool: ToolTruth = ToolTruth()
    finger: FingerTruth = FingerTruth()
    clock: ClockTruth = ClockTruth()
    workpiece: WorkpieceTruth = WorkpieceTruth()
    heat: HeatTruth = HeatTruth()


RENDERED = ClockTruth(rate=15.0)
"""Half of the real camera's 30 images a second: the simulated camera renders each of them."""

CALIBRATED = WeldTruth(
    ArmTruth(lag=60e-3, dead_time=20e-3, wave=0.03e-3, scale=0.0005),
    ToolTruth(tip=(0.1e-3, 0.1e-3, 0.1e-3), torch=(0.2e-3, 0.06e-3), yaw=math.radians(0.05)),
    FingerTruth(gain=0.08, hysteresis=0.02, friction=0.15),
    RENDERED,
    WorkpieceTruth(wave=0.15e-3, wave_length=40e-3, half_angle=math.radians(2.0)),
    HeatTruth(local=0.03e-3),
)

WORLDS: Mapping[str, WeldTruth] = {
    "as_filed": WeldTruth(clock=RENDERED),
    "calibrated": CALIBRATED,
    "wall_missing": replace(
        CALIBRATED, workpiece=replace(CALIBRATED.workpiece, gaps=(Gap(90e-3, 110e-3, 1),))
    ),
    "warming": WeldTruth(
        tool=ToolTruth(torch=(0.0, 0.05e-3)),
        finger=FingerTruth(gain=0.1, drift=0.01),
        clock=RENDERED,
    ),
    "torch_aside": WeldTruth(tool=ToolTruth(torch=(0.0, 0.6e-3)), clock=RENDERED),
    "tip_astray": WeldTruth(tool=ToolTruth(tip=(1.5e-3, 0.8e-3, -1e-3)), clock=RENDERED),
}
"""Described conditions, by the names that recipes give.

* ``as_filed``: as the files say; images are late by 30 ms, and 2 % of them are lost.
* ``calibrated``: off by what a calibration leaves: an arm that lags, and waves by 0.03 mm; tip and
  torch 0.06 to 0.2 mm off; a finger that shows 8 % too much; edges that wander by 0.15 mm; heat.
* ``wall_missing``: the same, and the left wall is missing from 90 mm to 110 mm of the seam.
* ``warming``: the torch 0.05 mm to the left, and a finger that shows 10 % too much and 1 % more in
  a minute.
* ``torch_aside``: the torch 0.6 mm to the left of where the tool's file has it.
* ``tip_astray``: the tip 1.5 mm ahead, 0.8 mm to the left and 1 mm lower, as before a calibration.
"""

WorldName = Literal[
    "as_filed", "calibrated", "wall_missing", "warming", "torch_aside", "tip_astray"
]

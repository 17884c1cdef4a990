"""True values of a simulated weld, read from a tool's and a world's file.

A recipe names one of ``data/worlds``, or its own file. Values are in [m], [rad] and [s]; in the
files each has its unit.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar, dataclass_transform

from pydantic import BeforeValidator, ConfigDict, with_config

from flangeye.files.paths import WHOLE, bundled_file
from flangeye.models.finger import FingerGeometry
from flangeye.models.model import readable
from flangeye.units import Angle, Duration, Length, Stiffness, param
from flangeye_emulators.weld_world.groove import Gap

Record = TypeVar("Record")


class ToolFile(FingerGeometry):
    """True finger and torch of a world, from a file that no controller reads."""

    lateral: Stiffness = param(gt=0)
    """Stiffness across the finger, at its tip."""
    axial: Stiffness = param(gt=0)
    """Stiffness along the finger."""


ToolPath = Annotated[
    Path, BeforeValidator(bundled_file("true tool", "tools")), readable(ToolFile), WHOLE
]
"""A parameter that names a world's tool: a bundled one, or a file beside the recipe."""


@dataclass_transform(frozen_default=True)
def checked(cls: type[Record]) -> type[Record]:
    """Make a class a frozen dataclass that is validated and refuses unknown keys."""
    return with_config(ConfigDict(extra="forbid"))(dataclass(frozen=True)(cls))


@checked
class ArmTruth:
    """Errors of the simulated arm: its response, and its true minus reported pose.

    Attributes:
        lag: Time constant of its first-order response.
        dead_time: Delay before a command takes effect.
        wave: Amplitude of a periodic position error along the path.
        wave_length: Period of that error.
        backlash: Lost motion across the seam.
        repeatability: Standard deviation of the position, independent in each cycle.
        scale: Relative error of distances, from joint zeros and link lengths.
        sag: Sag after 100 mm of travel.
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
    """True positions of tip and torch, relative to the finger's file.

    Attributes:
        tip: Offset of the tip: ahead, to the left, up.
        torch: Offset of the torch: ahead, to the left.
        yaw: Rotation of finger and torch about the tool's axis.
        work: Lean of the tool's upper end to the right, about the tip.
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
        gain: Relative gain error of the displacement that the tag shows.
        drift: Change of the gain in 60 s, by warming.
        rest: Pose of the tag on an undeformed finger.
        play: Motion of the tip before the tag follows.
        hysteresis: Lagging share of a displacement.
        creep: Relative growth of a displacement by creep, with a time constant of 10 s.
        friction: Coulomb coefficient, along and across the seam.
        noise: Standard deviation of a measurement across; upwards it is 6 times larger.
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
    """Timing of images: exposure, arrival and timestamps.

    Attributes:
        rate: Images per second.
        latency: Time from exposure to arrival.
        jitter: Standard deviation of the latency.
        stamp: Delay of the timestamps.
        dropped: Share of images that never arrive.
        hidden: Start and end of the time in which the tag is covered.
    """

    rate: float = 30.0
    latency: Duration = 30e-3
    jitter: Duration = 5e-3
    stamp: Duration = 0.0
    dropped: float = 0.02
    hidden: tuple[Duration, Duration] | None = None


@checked
class Tack:
    """A tack weld of 8 mm length, which fills the groove.

    Attributes:
        start: Arc length of its start.
        height: Height of the fill.
    """

    start: Length
    height: Length = 1e-3


@checked
class WorkpieceTruth:
    """True shape of the workpiece, relative to its CAD.

    Attributes:
        wave: Amplitude of a periodic deviation of its edges.
        wave_length: Period of that deviation.
        bow: Lateral offset of its middle from the CAD's curve.
        half_angle: Addition to the CAD's half angle of the walls.
        lean: Lean of its walls to the left, relative to the CAD.
        half_angle_wave: Amplitude of the half angle's variation.
        root_gap: Gap between the plates.
        tacks: Tack welds.
        spatter: Standard deviation of the roughness by spatter.
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
    """Thermal distortion of the seam while it is welded.

    Attributes:
        shift: Shift across the seam, growing from the start of the weld to its end.
        local: Local shift around the torch, within about 15 mm.
    """

    shift: Length = 0.0
    local: Length = 0.0


@checked
class ProfilerTruth:
    """True position, noise and timing of a profile sensor behind the torch.

    Attributes:
        behind: Distance of the profile behind the torch.
        noise: Standard deviation of one profile; reported correctly with it.
        clock: Timing of profiles: exposure, arrival, and losses.
    """

    behind: Length = 30e-3
    noise: Length = 0.05e-3
    clock: ClockTruth = ClockTruth(rate=10.0, latency=50e-3, dropped=0.1)


@checked
class WeldTruth:
    """All true values of a simulated weld: the content of a world's file."""

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

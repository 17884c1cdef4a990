"""A simulated profile sensor behind the torch, which measures the simulated bead."""

import bisect

import numpy as np

from flangeye.devices import Device, Profiler, StateSource, TactileSensor, WeldProfile
from flangeye.errors import StageError
from flangeye.plugin.stage import Params, part
from flangeye.types import Seed
from flangeye.units import Length, param
from flangeye_emulators.finger.sensor import SimulatedFinger
from flangeye_emulators.weld_world.truth import ProfilerTruth
from flangeye_emulators.weld_world.world import ImageQueue, WeldWorld


class SimulatedProfilerParams(Params):
    """Parameters of ``profiler.simulated``."""

    behind: Length = param("30 mm", gt=0, le=0.2)
    """Distance behind the torch at which it measures."""


class SimulatedProfiler(Device):
    """A simulated profile sensor for the bead behind the torch.

    Attributes:
        name: Name in messages and reports.
        behind: Distance of the profile behind the torch [m].
    """

    def __init__(
        self, finger: SimulatedFinger, robot: StateSource, seed: Seed, truth: ProfilerTruth
    ) -> None:
        """Mount the sensor behind the torch of a simulated finger."""
        self.name, self.behind = f"look behind the torch of {finger.name}", truth.behind
        self._world, self._robot = finger.world, robot
        self._look = BeadProfiler(truth, np.random.default_rng([seed, 13]))

    def profile(self) -> WeldProfile | None:
        """Return the next profile that has arrived by the arm's present time; None without one."""
        now = self._robot.state().time_ns * 1e-9
        self._look.watch(now, self._world)
        return self._look.profile(now)

    def close(self) -> None:
        """Do nothing: there is no device."""


@part("profiler.simulated")
def profiler_simulated(
    robot: StateSource, sensor: TactileSensor, seed: Seed, params: SimulatedProfilerParams
) -> Profiler:
    """A simulated profile sensor that measures the bead behind the torch."""
    if not isinstance(sensor, SimulatedFinger):
        raise StageError(
            f"profiler.simulated sees the weld of sensor.simulated_finger, not of {sensor.name}"
        )
    return SimulatedProfiler(sensor, robot, seed, ProfilerTruth(params.behind))


class BeadProfiler:
    """Measures the true bead, independently of the controller's estimate."""

    def __init__(self, truth: ProfilerTruth, rng: np.random.Generator) -> None:
        self._truth, self._rng = truth, rng
        self._shutter: ImageQueue[float] = ImageQueue(truth.clock, rng)
        self._along: list[float] = []
        self._off: list[float] = []
        self._began: float | None = None

    def watch(self, time: float, world: WeldWorld) -> None:
        """Update the bead: at ``time`` [s] it is laid at the torch's true position."""
        s = world.torch_s
        if 0.0 < s < world.groove.root.length:
            again = bisect.bisect_left(self._along, s)  # where it was before, it is molten again
            del self._along[again:], self._off[again:]
            self._along.append(s)
            self._off.append(world.off)
        self._began = time if self._began is None else self._began
        age = time - self._began
        seen = self._bead(s - self._truth.behind)
        if self._shutter.due(age) and seen is not None:
            noise = self._truth.noise * float(self._rng.standard_normal())
            self._shutter.expose(time, seen + noise)

    def profile(self, time: float) -> WeldProfile | None:
        """Return the next profile that has arrived by ``time`` [s]; None without one."""
        seen = self._shutter.arrived(time)
        if seen is None:
            return None
        return WeldProfile(seen.item, self._truth.noise, round(seen.stamp * 1e9))

    def _bead(self, s: float) -> float | None:
        """Return the bead's offset to the left of the joint at an arc length; None without bead."""
        after = bisect.bisect_right(self._along, s)
        return None if after == 0 else self._off[after - 1]

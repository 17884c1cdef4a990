"""A simulated profile sensor behind the torch: it sees the bead of the simulated finger's world."""

from __future__ import annotations

import bisect

import numpy as np

from flangeye.devices import Device, Profiler, StateSource, TactileSensor, WeldProfile
from flangeye.errors import StageError
from flangeye.plugin.stage import Params, part
from flangeye.types import Seed
from flangeye.units import Length, param
from flangeye_emulators.finger.sensor import SimulatedFinger
from flangeye_emulators.weld_world.truth import LookTruth
from flangeye_emulators.weld_world.world import Shutter, WeldWorld


class SimulatedProfilerParams(Params):
    """Parameters of ``profiler.simulated``."""

    behind: Length = param("30 mm", gt=0, le=0.2, description="How far behind the torch it looks.")


class SimulatedProfiler(Device):
    """Measures the simulated bead, at the torch's true place.

    Attributes:
        name: Shown in messages and reports.
        behind: How far behind the torch it looks [m].
    """

    def __init__(
        self, finger: SimulatedFinger, robot: StateSource, seed: Seed, truth: LookTruth
    ) -> None:
        """Mount it behind the finger's torch."""
        self.name, self.behind = f"look behind the torch of {finger.name}", truth.behind
        self._world, self._robot = finger.world, robot
        self._look = LookBehind(truth, np.random.default_rng([seed, 13]))

    def profile(self) -> WeldProfile | None:
        """Return the next scan that was ready at the arm's newest sample; None without one."""
        now = self._robot.state().time_ns * 1e-9
        self._look.watch(now, self._world)
        return self._look.profile(now)

    def close(self) -> None:
        """Do nothing; there is no device."""


@part("profiler.simulated")
def profiler_simulated(
    robot: StateSource, sensor: TactileSensor, seed: Seed, params: SimulatedProfilerParams
) -> Profiler:
    """A profile of the bead of a simulated weld, behind the torch."""
    if not isinstance(sensor, SimulatedFinger):
        raise StageError(
            f"profiler.simulated sees the weld of sensor.simulated_finger, not of {sensor.name}"
        )
    return SimulatedProfiler(sensor, robot, seed, LookTruth(params.behind))


class LookBehind:
    """Measures the bead as laid, independently of the controller's estimate."""

    def __init__(self, truth: LookTruth, rng: np.random.Generator) -> None:
        self._truth, self._rng = truth, rng
        self._shutter: Shutter[float] = Shutter(truth.clock, rng)
        self._along: list[float] = []
        self._off: list[float] = []
        self._began: float | None = None

    def watch(self, time: float, world: WeldWorld) -> None:
        """Update the world's state [s]; a bead is laid at the torch's place across the seam."""
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
        """Return the next profile that has arrived at a time [s], if any."""
        seen = self._shutter.arrived(time)
        if seen is None:
            return None
        return WeldProfile(seen.item, self._truth.noise, round(seen.stamp * 1e9))

    def _bead(self, s: float) -> float | None:
        """Return how far the bead is to the left of the joint at an arc length, if there is one."""
        after = bisect.bisect_right(self._along, s)
        return None if after == 0 else self._off[after - 1]

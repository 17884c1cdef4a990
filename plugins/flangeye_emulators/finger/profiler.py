"""A simulated profile sensor behind the torch: it sees the bead of the simulated finger's world."""

from __future__ import annotations

import numpy as np

from flangeye.devices import Device, Profiler, StateSource, TactileSensor, WeldProfile
from flangeye.errors import StageError
from flangeye.plugin.stage import part
from flangeye.types import Seed
from flangeye_emulators.finger.sensor import SimulatedFinger
from flangeye_emulators.weld_world.look import LookBehind
from flangeye_emulators.weld_world.settings import LookTruth


class SimulatedProfiler(Device):
    """Looks at the world that the finger stands in, wherever the torch truly is in it.

    Attributes:
        name: For people.
        behind: How far behind the torch it looks [m].
    """

    def __init__(
        self, finger: SimulatedFinger, robot: StateSource, seed: Seed, params: LookTruth
    ) -> None:
        """Mount it behind the finger's torch."""
        self.name, self.behind = f"look behind the torch of {finger.name}", params.behind
        self._world, self._robot = finger.world, robot
        self._look = LookBehind(params, np.random.default_rng([seed, 13]))

    def profile(self) -> WeldProfile | None:
        """Return the next look that has arrived by the arm's newest sample, if any."""
        now = self._robot.state().time_ns * 1e-9
        self._look.watch(now, self._world)
        return self._look.profile(now)

    def close(self) -> None:
        """Nothing to let go of."""


@part("profiler.simulated")
def profiler_simulated(
    robot: StateSource, sensor: TactileSensor, seed: Seed, params: LookTruth
) -> Profiler:
    """A look at the bead of a simulated weld, behind the torch."""
    if not isinstance(sensor, SimulatedFinger):
        raise StageError(
            f"profiler.simulated sees the weld of sensor.simulated_finger, not of {sensor.name}"
        )
    return SimulatedProfiler(sensor, robot, seed, params)

"""Protocols of the parts that use models: one for each kind of part.

``@part`` holds every part against the Protocol of its kind; the table is
:data:`flangeye.plugin.stage.PARTS`. A part may ask for ``params``, ``siblings`` and
``kinematics`` besides.
"""

from collections.abc import Sequence
from typing import Protocol

from flangeye.devices import Arc, Profiler, Robot, Scanner, StateSource, TactileSensor
from flangeye.maths.kinematics import Arm
from flangeye.models.finger import Finger
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.models.targets import Flange
from flangeye.types import Floats, Observation, PoseError, Seed, Transform, Views


class Cost(Protocol):
    """``cost``: one number [m] from the error of a pose."""

    def __call__(self, error: PoseError) -> float:
        """Return the cost; zero for no error."""


class ErrorMeasure(Protocol):
    """``error``: the error of a candidate pose, or None if it cannot be measured."""

    def __call__(
        self,
        base_T_camera: Transform,
        kept: Sequence[Observation],
        views: Views,
        flange: Flange | None,
    ) -> PoseError | None:
        """Return the error of ``base_T_camera``, from poses and views the solver has not seen."""


class ViewGuess(Protocol):
    """``view``: a first guess of the scanner's pose."""

    def __call__(self, arm: Arm, scanner: ScannerModel) -> Floats:
        """Return (4, 4) base_T_camera [m]."""


class RobotPart(Protocol):
    """``robot``: opens a connection to an arm."""

    def __call__(self, model: RobotModel) -> Robot:
        """Return the open arm."""


class ScannerPart(Protocol):
    """``scanner``: opens a scanner."""

    def __call__(self, model: ScannerModel | None) -> Scanner:
        """Return the open scanner."""


class SensorPart(Protocol):
    """``sensor``: opens the camera of a finger."""

    def __call__(self, finger: Finger, robot: StateSource, seed: Seed) -> TactileSensor:
        """Return the open camera."""


class ArcPart(Protocol):
    """``arc``: opens a welding power source; its parameters extend :class:`ArcTimes`."""

    def __call__(self) -> Arc:
        """Return the open power source, gas and arc off."""


class ProfilerPart(Protocol):
    """``profiler``: opens a profile sensor behind the torch."""

    def __call__(self, robot: StateSource, sensor: TactileSensor, seed: Seed) -> Profiler:
        """Return the open profile sensor; ``sensor`` is the finger's open sensor.

        A real profile sensor ignores the finger's sensor; a simulated one shares its world.
        """

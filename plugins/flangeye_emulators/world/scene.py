"""An arm among the things of its cell, looked at by one scanner, wherever the arm is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel, middle_of_view
from flangeye.models.targets import plate_of
from flangeye.types import Floats
from flangeye_emulators.world.cell import SimulatedCell
from flangeye_emulators.world.raycast import Image, Scene
from flangeye_emulators.world.scanner import before_camera
from flangeye_emulators.world.structured_light import StructuredLight
from flangeye_emulators.world.time_of_flight import TimeOfFlight


class Stance(NamedTuple):
    """Where an arm really is: (n,) joint angles [rad], and (4, 4) its flange's pose."""

    joints: Floats
    base_T_flange: Floats


class CellScene:
    """The cell, the scanner, and what it sees of an arm."""

    def __init__(
        self,
        robot: RobotModel,
        eye: StructuredLight | TimeOfFlight,
        base_T_camera: Floats,
        workspace: Floats,
    ) -> None:
        """Set the cell up around the middle of the scanner's view.

        Args:
            robot: The arm; it carries the plate its model names.
            eye: The scanner.
            base_T_camera: (4, 4) where that stands.
            workspace: (3,) size of the box beside which wall and stand are [m].
        """
        plate = plate_of(robot)
        scanner: ScannerModel = eye.scanner
        self._cell = SimulatedCell(robot, plate, middle_of_view(scanner, base_T_camera), workspace)
        self._around = self._cell.around()
        self._arm = Arm(robot)
        self._eye, self._base_T_camera = eye, base_T_camera

    def disagreement(self, stance: Stance) -> float:
        """Return how far the flange is from where the model puts it [m]; infinite for another."""
        if len(stance.joints) != self._arm.n:
            return float("inf")
        modelled = self._arm.flange(stance.joints)
        return float(np.linalg.norm((modelled - stance.base_T_flange)[:3, 3]))

    def scan(self, stances: Sequence[Stance], seed: Sequence[int]) -> Image:
        """Return one scan (H, W, 3) in ``camera`` [m] of an arm that was seen at some stances.

        A moving arm leaves the mean of what its stances leave, and nothing where one of them does.
        """
        looks = [self._look(stance, seed) for stance in _distinct(stances)]
        return looks[0] if len(looks) == 1 else np.mean(looks, axis=0, dtype=np.float32)

    def prepare(self, stance: Stance) -> None:
        """Load and compute now, with the arm as it stands, what the first scan would wait for."""
        self._scene(stance)

    def _look(self, stance: Stance, seed: Sequence[int]) -> Image:
        return self._eye.scan(self._scene(stance), np.random.default_rng(seed))

    def _scene(self, stance: Stance) -> Scene:
        bodies = self._cell.arm(self._arm.frames(stance.joints), stance.base_T_flange)
        return before_camera([*self._around, *bodies], self._base_T_camera)


def _distinct(stances: Sequence[Stance]) -> list[Stance]:
    kept = [stances[0]]
    for stance in stances[1:]:
        # Of an arm that stands, no entry of its flange's pose changes by more [m, 1]
        if np.abs(stance.base_T_flange - kept[-1].base_T_flange).max() > 1e-6:
            kept.append(stance)
    return kept

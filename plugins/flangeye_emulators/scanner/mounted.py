"""``scanner.mounted``: a simulated scanner on the flange of an arm simulated in this process.

It looks from where that arm's flange really is, joints' errors included; the recipe's driver of the
robot only tells where its controller has it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import numpy as np
from pydantic import Field

from flangeye.devices import DeviceError, Scan, Scanner
from flangeye.maths.geometry import rigid, rotation_from_rpy
from flangeye.models.scanners import ScannerModel
from flangeye.models.workpiece import load_workpiece
from flangeye.plugin.stage import part
from flangeye.types import CAMERA, Array, Floats, PointCloud
from flangeye_emulators.world import room
from flangeye_emulators.world.bench import BenchParams, bench_with
from flangeye_emulators.world.scanner import ScannerQuality, before_camera, scanner_of
from flangeye_plugins.scanner.opened import OpenScanner


class MountedParams(ScannerQuality, BenchParams):
    """Parameters of ``scanner.mounted``."""

    # The scanner's true position in ``flange`` [m]
    mount: ClassVar[tuple[float, float, float]] = (0.06, 0.0, 0.04)
    seed: int = Field(0, ge=0, description="Draws noise, distortion and what lies about.")

    @property
    def flange_T_camera(self) -> Floats:
        """(4, 4), translation in [m]; the scanner is turned by a quarter about the flange's z."""
        return rigid(rotation_from_rpy(0.0, 0.0, np.pi / 2), np.asarray(self.mount))


@part("scanner.mounted")
def scanner_mounted(model: ScannerModel | None, params: MountedParams) -> Scanner:
    """Scan a workpiece on a bench from the flange of the simulated arm.

    Raises:
        DeviceError: There is no model of a scanner, or no simulated arm to carry it.
    """
    if model is None:
        raise DeviceError("scanner.mounted: the recipe must say which scanner to be: scanner.model")
    if room.newest() is None:
        raise DeviceError(
            "scanner.mounted: no simulated arm carries it; give the recipe robot.driver: simulated"
        )
    return MountedScanner(model, params)


class MountedScanner(OpenScanner):
    """A simulated scanner on a flange; time stands still while it exposes.

    Attributes:
        true_seams: By name, (N, 3) in ``base`` [m]. A stage that plans must not look.
    """

    def __init__(self, model: ScannerModel, params: MountedParams) -> None:
        """Place the workpiece; the scanner's distortion is the same for every exposure."""
        distortion, clutter, self._noise = np.random.default_rng(params.seed).spawn(3)
        self._eye = scanner_of(model, params.resolution, params.noise, distortion)
        rows, columns = self._eye.pixels.shape
        facts = {"unit": "m", "layout": f"organised, {columns} x {rows}", "simulated": "yes"}
        super().__init__(f"simulated {model.model} on the flange, seed {params.seed}", facts)
        workpiece = load_workpiece(params.workpiece)
        self._bodies = bench_with(workpiece, params.base_T_part, params.covered, clutter)
        self.true_seams: dict[str, Array] = dict(params.true_seams(workpiece))
        self._flange_T_camera = params.flange_T_camera

    def expose(self) -> Callable[[], Scan]:
        """Look from where the arm stands.

        Raises:
            DeviceError: The arm is gone.
        """
        arm = room.newest()
        if arm is None:
            raise DeviceError(f"{self.name}: the arm that carries it is gone")
        scene = before_camera(self._bodies, arm.true_flange() @ self._flange_T_camera)
        cloud = PointCloud(CAMERA, self._eye.scan(scene, self._noise))
        now = arm.state().time_ns
        return lambda: Scan(cloud, now, now)

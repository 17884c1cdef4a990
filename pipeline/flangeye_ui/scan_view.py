"""One scan of a log in 3D, the flange that was found in it, and what became of it."""

from __future__ import annotations

import numpy as np
from nicegui import ui

from flangeye import types as t
from flangeye.log.read import RunLog
from flangeye.report.units import millimetres
from flangeye_ui.scene import FLANGE, RIM, SCANNED, Scene3D, outline_of


class ScanView:
    """A scene, and a line that says what became of the scan in it.

    Attributes:
        log: What the scans are of; None until it was read.
    """

    def __init__(self, log: RunLog | None = None) -> None:
        self.log = log
        self._told = ui.label().props('role="status"')
        self._scene = Scene3D(340, SCANNED)

    def say(self, text: str) -> None:
        """Say something in place of a scan's verdict."""
        self._told.text = text

    def show(self, capture: str) -> None:
        """Show a scan: the flange in it, its rim as fitted, and what became of it."""
        if self.log is None:
            return
        self.say(f"capture {capture}: {fate_of(self.log, capture)}")
        self._scene.wipe()
        for entry in self.log.of_kind("segment"):
            if entry.capture == capture and isinstance(entry.value, t.FlangeCloud):
                self._cloud(entry.value)
        for entry in self.log.of_kind("fit"):
            if entry.capture == capture:
                self._scene.cloud(outline_of(entry.value), RIM, 0.001)

    def _cloud(self, flange: t.FlangeCloud) -> None:
        self._scene.cloud(flange.cloud.points().astype(np.float64), FLANGE)
        at = np.asarray(flange.centre)
        (x, y, z), (to_x, to_y, to_z) = (at - 0.15 * at / np.linalg.norm(at)).tolist(), at.tolist()
        self._scene.move_camera(x, y, z, to_x, to_y, to_z, 0.0, -1.0, 0.0, 0.0)


def fate_of(log: RunLog, capture: str) -> str:
    """Return what became of a capture, in words."""
    for rejection in log.rejections:
        if rejection.id == capture:
            return f"set aside by {rejection.stage}: {rejection.reason}"
    calibration = log.calibration()
    for pair in calibration.pairs if calibration else ():
        if pair.observation.id == capture:
            residual = f"residual {millimetres(float(np.linalg.norm(pair.residual)))} mm"
            return f"{'used' if pair.used else 'not used'}, {pair.reason or residual}"
    if log.poses.get(capture, {}).get("role") == "verification":
        return "kept for verification"
    return "not solved"

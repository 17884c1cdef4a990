"""``export`` stages: what every file for another program must be."""

from __future__ import annotations

import numpy as np

from flangeye import types as t
from flangeye.maths.geometry import rigid, rotation_from_rpy
from flangeye.testing.base import Conformance
from flangeye.testing.judge import require

REMARKS = ("flangeye: a pose of the kit", "REFUSED, DO NOT USE: the kit says so")


class ExportConformance(Conformance):
    """An ``export`` stage: a calibrated pose in, a file out."""

    kind = "export"

    def file(self, carrier: str = t.BASE, yaw: float = 0.3) -> t.ExportedFile:
        """Return what the stage writes for a pose in ``carrier``."""
        matrix = rigid(rotation_from_rpy(0.1, -0.2, yaw), np.array([0.5, -0.25, 1.0]))
        pose = t.CalibratedPose(t.Transform(carrier, t.CAMERA, matrix), REMARKS)
        file: t.ExportedFile = self.call({t.CalibratedPose: pose})
        return file

    def test_it_writes_a_file(self) -> None:
        """With a plain name and text, wherever the camera is."""
        for carrier in (t.BASE, t.FLANGE):
            file = self.file(carrier)
            require(isinstance(file, t.ExportedFile), "gave something else than an ExportedFile")
            require(bool(file.text.strip()), "the file is empty")
            plain = file.name not in ("", ".", "..") and not set("/\\") & set(file.name)
            require(plain, f"'{file.name}' is not a plain file name")

    def test_the_pose_is_in_it(self) -> None:
        """Another pose, another text; the same pose, the same text."""
        require(self.file() == self.file(), "two calls with equal input differ")
        require(self.file().text != self.file(yaw=0.4).text, "two poses give one text")

    def test_its_remarks_are_in_it(self) -> None:
        """Above all that a calibration was refused."""
        text = self.file().text
        missing = [line for line in REMARKS if line not in text]
        require(not missing, f"the file does not say '{missing[0] if missing else ''}'")

"""A cell without any interface: a person moves the arm and presses the scanner's own button."""

import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from flangeye.files.clouds import write_cloud
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.types import CAMERA, PointCloud
from flangeye.types.pose_formats import CONVENTIONS
from flangeye.workflow.log.read import read_run
from flangeye_emulators.scanner import CellScene, TrueStance
from flangeye_emulators.world.scanner import CameraPose, scanner_of

pytestmark = [pytest.mark.realtime, pytest.mark.slow]

RECIPE = """
title: By hand
robot:
  model: ur5e
  driver: {manual: {convention: kuka}}
  limits: {box: {centre: [450 mm, 0 mm, 500 mm], size: [1200 mm, 1600 mm, 1000 mm]}}
scanner:
  model: phoxi-m
  driver: {watched_folder: {path: exports, unit: mm, settle: 100 ms}}
steps:
  - acquire.live:
      view: {guess: {position: [620 mm, 0 mm, 980 mm]}}
      poses: {next_best: {count: 5}}
      verification: 0
      moved: 1 mm
  - segment.flange
  - fit.rim
  - solve.robust
  - verify.holdout: {max_rms: 1 mm}
"""

KUKA = CONVENTIONS["kuka"]
ROBOT, SCANNER = load_model("robots", "ur5e"), load_model("scanners", "phoxi-m")
START = np.radians([180.0, -90.0, 90.0, -90.0, -90.0, 0.0])


class Person:
    """Moves a true arm nearly to where they are asked to, and lets the scanner export a file."""

    def __init__(self, folder):
        self.folder = folder / "exports"
        self.folder.mkdir()
        camera = CameraPose().matrix
        eye = scanner_of(SCANNER, 0.2, 1.0, np.random.default_rng(0))
        self.studio = CellScene(ROBOT, eye, camera, np.array([0.3, 0.3, 0.2]))
        self.arm, self.joints, self.count = Arm(ROBOT), START, 0

    def move(self, asked):
        """Return what the pendant shows after moving to about the pose that was asked for."""
        near = self.arm.inverse(KUKA.matrix(KUKA.read_numbers(asked)))
        turns = near + 2 * np.pi * np.round((self.joints - near) / (2 * np.pi))
        self.joints = turns[np.abs(turns - self.joints).max(axis=1).argmin()] + 0.002
        return KUKA.text(self.arm.flange(self.joints))

    def press_the_button(self):
        self.count += 1
        stance = TrueStance(self.joints, self.arm.flange(self.joints))
        xyz = self.studio.scan([stance], (0, self.count)) * 1000.0
        write_cloud(self.folder / f"scan_{self.count}.pcd", PointCloud(CAMERA, xyz))


def test_a_person_and_a_folder_are_a_cell(tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_text(RECIPE)
    person = Person(tmp_path)
    process = subprocess.Popen(
        [sys.executable, "-m", "flangeye.cli", "run", "cell.yaml", "--move", "--out", "run"],
        cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, bufsize=1,
    )  # fmt: skip
    said = []

    def act():
        process.stdin.write(KUKA.text(person.arm.flange(START)) + "\n")
        for line in process.stderr:
            said.append(line.rstrip())
            if line.startswith("Go to"):
                process.stdin.write(person.move(line.removeprefix("Go to").strip()) + "\n")
            elif line.startswith("Scan now"):
                person.press_the_button()

    actor = threading.Thread(target=act)
    actor.start()
    code = process.wait(timeout=200)
    actor.join()
    out = process.stdout.read()
    process.stdout.close(), process.stderr.close(), process.stdin.close()
    assert code == 0, "\n".join(said)
    assert "5 of 5 captures used" in out
    assert len(read_run(tmp_path / "run" / "run.mcap").poses) == 5

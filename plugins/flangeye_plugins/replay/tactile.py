"""A weld decided again, from the images and poses in its log."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from flangeye.errors import StageError
from flangeye.log.read import Note, read_notes
from flangeye.models.finger import Finger
from flangeye.motion.seam_following import ToolPose
from flangeye.plugin.stage import part
from flangeye.run.replay import ReplayedStep
from flangeye_plugins.sensor.recorded import piece_of
from flangeye_plugins.weld.execution import touch_of
from flangeye_plugins.weld.finger_camera import Reader
from flangeye_plugins.weld.resuming import controller_from, take_looks
from flangeye_plugins.weld.touch.tip_displacement import TipDisplacement
from flangeye_plugins.weld.weld_log import LoggedLooks

SAME = 1e-9
"""Commands that differ by less are the same [m/s, rad/s]; other processors round otherwise."""


@part("replay.tactile")
def replay_tactile(log: FilePath, step: str) -> ReplayedStep:
    """Detect the tag in the logged images and decide every cycle of a weld again."""
    again: WeldReplay | None = None
    for note in read_notes(log):
        if note.step != step:
            continue
        if note.name == "start":
            again = WeldReplay(note.value)
        elif again is not None:
            again.take(note)
    if again is None:
        raise StageError(f"{log}: step {step} did not get so far as to decide anything")
    return again.account()


class WeldReplay:
    """Goes through the log of a weld in its order."""

    def __init__(self, start: Mapping[str, Any]) -> None:
        """Set up controller and finger as they were."""
        self._finger = Finger.model_validate(start["finger"])
        self._controller = controller_from(start)
        self._reader = Reader(self._finger)
        self._pixels: Any = None
        self._feelings: dict[int, TipDisplacement | None] = {}
        self._looks = LoggedLooks()
        self._newest = -1
        self._cycles = 0
        self._worst_feeling = self._worst_command = 0.0

    def take(self, note: Note) -> None:
        """Take in the next line of the log."""
        if note.name == "image":
            self._pixels = note.value
        elif note.name == "sight":
            self._see(note.value)
        elif note.name == "feeling":
            self._compare_feeling(note.value)
        elif note.name == "look":
            self._looks.take(note.value)
        elif note.name == "cycles":
            self._decide(note.value)

    def account(self) -> ReplayedStep:
        """Return how what was decided again compares."""
        return ReplayedStep(
            what=f"{self._cycles} cycles from {len(self._feelings)} images",
            same=max(self._worst_command, self._worst_feeling) <= SAME,
            figures={
                "largest difference of a displacement [m]": self._worst_feeling,
                "largest difference of a command [m/s, rad/s]": self._worst_command,
            },
        )

    def _see(self, sight: Mapping[str, Any]) -> None:
        if self._pixels is None:
            raise StageError("the log of this weld holds no images: it ran with log_images: false")
        piece = piece_of(np.asarray(self._pixels, dtype=np.uint8), sight["corner"], self._finger)
        self._newest = sight["number"]
        read = self._reader.reread(piece, sight["time_ns"])
        if (read.feeling is not None) != sight["tag"]:
            self._worst_feeling = np.inf
        if self._newest >= 0:  # those before the start have no number, but the detector saw them
            self._feelings[self._newest] = read.feeling

    def _compare_feeling(self, logged: Mapping[str, Any]) -> None:
        felt = self._feelings.get(self._newest)
        if felt is not None:
            off = np.abs(felt.displacement - np.array(logged["displacement"])).max()
            self._worst_feeling = max(self._worst_feeling, float(off))

    def _decide(self, cycles: Mapping[str, list[Any]]) -> None:
        for i, time in enumerate(cycles["time"]):
            pose = ToolPose(time, np.array(cycles["position"][i]), cycles["angle"][i])
            felt = [self._feelings.get(number) for number in cycles["touches"][i]]
            take_looks(self._controller, self._looks.of(self._cycles))
            command = self._controller.step(pose, [touch_of(f) for f in felt if f is not None])
            decided = np.array([*command.velocity, command.turn])
            logged = np.array([*cycles["velocity"][i], cycles["turn"][i]])
            self._worst_command = max(self._worst_command, float(np.abs(decided - logged).max()))
            self._cycles += 1

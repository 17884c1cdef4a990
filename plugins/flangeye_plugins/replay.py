"""Replay of a weld's decisions, from the images and poses in its log."""

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from flangeye.errors import StageError
from flangeye.models.finger import Finger
from flangeye.motion.seam_following import Command
from flangeye.plugin.stage import part
from flangeye.workflow.log.read import JournalEntry, read_notes
from flangeye.workflow.run.replay import ReplayedStep
from flangeye_plugins.sensor import piece_of
from flangeye_plugins.weld.finger_camera import FingerReader
from flangeye_plugins.weld.resuming import LoggedWeld


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
        raise StageError(f"{log}: step {step} logged no decision to repeat")
    return again.account()


class WeldReplay(LoggedWeld):
    """Repeats a weld from its log in order, reading its images anew."""

    def __init__(self, start: Mapping[str, Any]) -> None:
        """Set up controller and finger as they were."""
        super().__init__(start)
        self.felt = defaultdict(lambda: None)
        self._finger = Finger.model_validate(start["finger"])
        self._reader = FingerReader(self._finger)
        self._pixels: Any = None
        self._worst_feeling = self._worst_command = 0.0

    def take(self, note: JournalEntry) -> None:
        """Process the next log entry."""
        if note.name == "image":
            self._pixels = note.value
        super().take(note)

    def account(self) -> ReplayedStep:
        """Return the comparison of the repeated decisions with the logged ones."""
        # Commands that differ by less are the same [m/s, rad/s]; other processors round otherwise
        return ReplayedStep(
            what=f"{self.cycles} cycles from {len(self.felt)} images",
            same=max(self._worst_command, self._worst_feeling) <= 1e-9,
            figures={
                "largest difference of a displacement [m]": self._worst_feeling,
                "largest difference of a command [m/s, rad/s]": self._worst_command,
            },
        )

    def see(self, sight: Mapping[str, Any]) -> None:
        """Measure the tip's displacement again in a logged image."""
        if self._pixels is None:
            raise StageError("the log of this weld holds no images")
        piece = piece_of(np.asarray(self._pixels, dtype=np.uint8), sight["corner"], self._finger)
        super().see(sight)
        feeling = self._reader.reread(piece, sight["time_ns"]).feeling
        if (feeling is not None) != sight["tag"]:
            self._worst_feeling = np.inf
        if self.newest >= 0:  # those before the start have no number, but the detector saw them
            self.felt[self.newest] = None if feeling is None else feeling.touch

    def feel(self, logged: Mapping[str, Any]) -> None:
        """Compare the displacement measured again in the newest image with the logged one."""
        felt = self.felt.get(self.newest)
        if felt is not None:
            off = np.abs(felt.displacement - np.array(logged["displacement"])).max()
            self._worst_feeling = max(self._worst_feeling, float(off))

    def decided(self, command: Command, cycles: Mapping[str, list[Any]], i: int) -> None:
        """Compare the recomputed command with the logged one of cycle ``i``."""
        decided = np.array([*command.velocity, command.turn])
        logged = np.array([*cycles["velocity"][i], cycles["turn"][i]])
        self._worst_command = max(self._worst_command, float(np.abs(decided - logged).max()))

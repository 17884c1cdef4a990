"""Inject faults into welds in real time: python -m tools.kill_weld [--times N] [--only NAME]

`flangeye run` welds through the maker's client on an emulated controller on loopback. At a random
moment while the torch follows the seam, a fault is injected into the program, the controller or the
camera. Printed are the time until the arm is at rest by the controller's position (from the fault,
or for a camera from the last image of the tag), and the run's message.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from flangeye.errors import FlangeyeError
from flangeye.files.processes import python_command
from flangeye.workflow.log.read import read_notes
from tests.emulators.controllers.process import Process
from tools.strokes import guard_of, itself, worker_of

RECIPE = "recipes/paper/fig13_straight.yaml"
FINGER = "steps.5.sensor.simulated_finger"
HOME = "180 -90 90 -90 -90 0 deg"
OPENING, ENDING = 240.0, 30.0
"""Longest time until the torch follows the seam, and until a struck run has ended [s]."""
MOVES = 1e-4
"""Speed of the fastest joint above which an arm moves [rad/s]."""
LOOK = 0.002
"""Between two looks at the arm [s]: the weld needs the cores itself."""
RESTS, ENDS = 0.3, 3.0
"""What is asked for: an arm at rest; a program that has ended, where no arm is left to look at [s]."""
PATIENT = ("--set", "steps.5.blind=5 s")
"""Where the camera is not what is struck: on a busy machine its images are late."""
AFTER = (1.0, 8.0)
"""The stroke falls between these times after the torch has begun to follow [s]."""


@dataclass
class Trial:
    """One weld on a controller."""

    controller: Process
    run: subprocess.Popen[str]
    log: Path

    def notes(self, name: str) -> Iterator[Any]:
        """Yield the values that the weld has logged under a name so far."""
        with suppress(FlangeyeError):
            yield from (n.value for n in read_notes(self.log) if n.name == name)

    def phase(self) -> str:
        """Return the controller's last logged phase."""
        blocks = list(self.notes("cycles"))
        return str(blocks[-1]["phase"][-1]) if blocks else ""

    def follows(self) -> None:
        """Return when the torch follows the seam."""
        until = time.monotonic() + OPENING
        while self.phase() != "following":
            if self.run.poll() is not None or time.monotonic() > until:
                raise SystemExit(f"the weld did not begin: {self.told()}")
            time.sleep(0.5)

    def lead(self) -> float:
        """Return when the torch began to follow, after the first image [s]."""
        first = next(self.notes("sight"))["time_ns"] * 1e-9
        cycles = (
            each
            for block in self.notes("cycles")
            for each in zip(block["time"], block["phase"], strict=True)
        )
        return float(next(moment for moment, phase in cycles if phase == "following") - first)

    def rests(self) -> float:
        """Return the time from now until the arm is at rest, by the controller's clock [s]."""
        began = self.controller.control.truth()
        last = began.time
        until = time.monotonic() + ENDING
        while (now := self.controller.control.truth()).time - last < 0.5:
            last = now.time if now.speed > MOVES else last
            time.sleep(LOOK)
            if time.monotonic() > until:
                return float("inf")
        return last - began.time

    def told(self) -> str:
        """Return the run's last line, once it has ended."""
        try:
            out, err = self.run.communicate(timeout=ENDING)
        except subprocess.TimeoutExpired:
            return "nothing: it has not ended"
        lines = [line for line in (out + "\n" + err).splitlines() if line.strip()]
        stopped = [line for line in lines if "stopped" in line or line.startswith("error")]
        return (stopped or lines or [""])[-1]


Strike = Callable[[Trial], float]
"""Does something to a weld, and returns how long the arm then goes on moving [s]."""


def killed(find: Callable[[int], int]) -> Strike:
    """Return what kills a process of the weld."""

    def strike(trial: Trial) -> float:
        os.kill(find(trial.run.pid), signal.SIGKILL)
        return trial.rests()

    return strike


def hung(find: Callable[[int], int], signals: Callable[[int, int], None] = os.kill) -> Strike:
    """Return what holds a process of the weld, or the program with its group, until the arm rests."""

    def strike(trial: Trial) -> float:
        process = find(trial.run.pid)
        signals(process, signal.SIGSTOP)
        taken = trial.rests()
        signals(process, signal.SIGCONT)
        return taken + trial.rests()  # it must not move once more

    return strike


def faulted(fault: str) -> Strike:
    """Return what gives the controller a fault, as ``flangeye emulator`` names it."""

    def strike(trial: Trial) -> float:
        trial.controller.control.fault(fault)
        return trial.rests()

    return strike


def powerless(trial: Trial) -> float:
    """Kill the controller, which stops the arm; measure the time until the run reports it."""
    trial.controller.send(signal.SIGKILL)
    began = time.monotonic()
    trial.told()
    return time.monotonic() - began


def camera(trial: Trial) -> float:
    """Let the camera fall silent or fail, by its parameters."""
    control, last = trial.controller.control, time.monotonic()
    while trial.run.poll() is None:
        last = time.monotonic() if control.truth().speed > MOVES else last
        time.sleep(LOOK)
    return last - max(s["time_ns"] for s in trial.notes("sight") if s["tag"]) * 1e-9


@dataclass(frozen=True)
class Stroke:
    """A fault for a weld, with the weld's parameters."""

    strike: Strike
    given: Callable[[float], tuple[str, ...]] = lambda after: PATIENT
    by_itself: bool = False
    within: float = RESTS


def _silent(after: float) -> tuple[str, ...]:
    return ("--set", f"{FINGER}.hidden=[{after:.1f} s, 1000 s]")  # at rest after 'still'


def _lost(after: float) -> tuple[str, ...]:
    return (*PATIENT, "--set", f"{FINGER}.fails={after:.1f} s")


STROKES = {
    "program killed": Stroke(killed(itself)),
    "program held": Stroke(hung(itself)),
    "process group held": Stroke(hung(itself, os.killpg)),
    "guard killed": Stroke(killed(guard_of)),
    "guard held": Stroke(hung(guard_of)),
    "worker killed": Stroke(killed(worker_of)),
    "worker held": Stroke(hung(worker_of)),
    "protective stop": Stroke(faulted("protective-stop")),
    "controller frozen": Stroke(faulted("freeze=3 s")),
    "controller killed": Stroke(powerless, within=ENDS),
    "camera silent": Stroke(camera, _silent, by_itself=True),
    "camera lost": Stroke(camera, _lost, by_itself=True),
}


class Bench:
    """A controller on loopback, and welds on it one after the other."""

    def __init__(self, folder: Path, seed: int) -> None:
        self._folder, self._chance, self._count = folder, random.Random(seed), 0
        self._controller = Process("--joints", HOME, model="ur10e")

    def struck(self, stroke: Stroke, lead: float) -> tuple[float, str]:
        """Return the time until the arm was at rest in one weld [s], and the run's message."""
        after = self._chance.uniform(*AFTER)
        with self._weld(stroke.given(lead + after)) as trial:
            if not stroke.by_itself:
                time.sleep(after)
            return stroke.strike(trial), trial.told()

    def lead(self) -> float:
        """Return when a weld begins to follow, after the first image [s]."""
        with self._weld(PATIENT) as trial:
            return trial.lead()

    def close(self) -> None:
        """End the controller."""
        self._controller.end(signal.SIGKILL)

    @contextmanager
    def _weld(self, given: tuple[str, ...]) -> Iterator[Trial]:
        """Begin a weld, and give it once its torch follows the seam; end it with its controller."""
        self._count += 1
        out = self._folder / str(self._count)
        driver = f"robot.driver={{ur_rtde: {{host: {self._controller.host}}}}}"
        words = ("run", RECIPE, "--move", "--out", str(out), "--set", driver, *given)
        run = subprocess.Popen(
            python_command("-m", "flangeye.cli", *words), text=True, start_new_session=True,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        trial = Trial(self._controller, run, out / "run.mcap")
        try:
            trial.follows()
            yield trial
        finally:
            with suppress(ProcessLookupError):
                os.killpg(run.pid, signal.SIGKILL)
            run.wait()
            if self._controller.process.poll() is None:
                self._controller.end(signal.SIGKILL)
            self._controller = Process("--joints", HOME, model="ur10e")


def main(
    times: Annotated[int, typer.Option(help="Welds for each stroke.")] = 20,
    only: Annotated[str, typer.Option(help="Strokes with this in their names.")] = "",
    seed: Annotated[int, typer.Option(help="Draws the moments.")] = 0,
) -> None:
    """Inject faults into welds; print the time until the arm is at rest, and the messages."""
    chosen = {name: stroke for name, stroke in STROKES.items() if only in name}
    with (
        tempfile.TemporaryDirectory() as folder,
        closing(Bench(Path(folder), seed)) as bench,
    ):
        lead = bench.lead()
        print(f"{'stroke':18} welds  at rest after: median, longest  said", flush=True)
        for name, stroke in chosen.items():
            found = [bench.struck(stroke, lead) for _ in range(times)]
            taken = np.array([seconds for seconds, _ in found])
            print(f"{name:18} {times:5}  {np.median(taken):13.3f} {taken.max():9.3f} s"
                  f"{'' if taken.max() <= stroke.within else ' *':13}  {found[-1][1]}", flush=True)  # fmt: skip


if __name__ == "__main__":
    typer.run(main)

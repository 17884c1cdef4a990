"""Inject every fault while an arm moves: python -m tools.faults [TIMES] [--seed N] [--kind NAME …]

A calibration, or a program that servos the arm like a weld, runs against an emulated controller on
loopback through the maker's client. The fault is one of the controller, or of the run's own
processes (``tools.strokes``): killed, suspended for three seconds, or interrupted at its terminal.
It occurs at a random moment while the arm moves.

Checked are: by the controller's clock the arm is at rest within 0.5 s and does not move again;
finished captures are in the log; the program ends within 3 s, not counting the time that it or its
supervisor waited for a processor core; it says how to resume, and resuming works (after the first
trial). Under a harmless fault (:data:`HARMLESS`) it must run on, and under any other it must not.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, NamedTuple

from flangeye.files.processes import python_command
from tests.live.cell import Cell
from tests.plugins.ros2.cell import Ros2Cell
from tools.strokes import (
    HELD,
    OF_A_BRIDGE,
    OF_A_CLIENT,
    SHIFTS,
    STROKES,
    Terminal,
    environment,
)

AUBO_FAULTS = Cell.faults[:7]
ANYWHERE = (*STROKES, *SHIFTS)
KINDS = {
    "calibration": (*Cell.faults, *ANYWHERE, *OF_A_CLIENT),
    "leading": (*Cell.faults, *ANYWHERE, *OF_A_CLIENT),
    "aubo": (*AUBO_FAULTS, *ANYWHERE),
    "ros2": (*Ros2Cell.faults, *STROKES, *OF_A_BRIDGE),
}
"""What may befall each kind of program; ``aubo`` is a calibration with that arm, ``ros2`` one under
ROS 2, whose own processes must be installed: ``make test`` does."""

HARMLESS = ("latency=20 ms", *SHIFTS)
EITHER = "camera's bridge held"
"""Faults under which a program runs to its end, and the one that ends it only if a scan is due."""

RESTS, ENDS, PATIENCE = 0.5, 3.0, 30.0
"""After a fault: longest time until the arm rests, by its clock, and until the program ends; a
program that has not ended after the last goes on [s]."""

STARTING, WHOLE = 240.0, 600.0
"""Longest time until a program moves the arm, and until it is through [s]; the machine is busy."""

MOVES, STANDS = 0.02, 1e-4
"""An arm that moves, and one that rests [m/s]."""


def main() -> None:
    """Inject each fault the given number of times, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("times", nargs="?", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--fault", nargs="+", default=[])
    asked = parser.parse_args()
    known = {fault for kind in asked.kind for fault in KINDS[kind]}
    if unknown := set(asked.fault) - known:
        parser.error(f"--fault {', '.join(unknown)}: not one of {', '.join(sorted(known))}")
    print(
        "kind         fault                   times  went on  rest [s]  exit [s]  no core [s]  "
        "resumed  wrong",
        flush=True,
    )
    wrong = 0
    for kind in asked.kind:
        for fault in asked.fault or KINDS[kind]:
            trial = Trial(kind, fault, random.Random(f"{kind} {fault} {asked.seed}"))
            for _ in range(asked.times):
                trial.once()
            print(trial.row(), *trial.wrong, sep="\n  ", flush=True)
            wrong += len(trial.wrong)
    print(f"load {os.getloadavg()[1]:.1f} on {os.cpu_count()} cores")
    sys.exit(bool(wrong))


class End(NamedTuple):
    """After a fault, when the arm moved last and when the program ended, and how long the process
    of it that had to wait most had no core [s]."""

    rests: float
    exits: float | None
    queued: float


class Trial:
    """One fault in one kind of program, and what came of it."""

    def __init__(self, kind: str, fault: str, chance: random.Random) -> None:
        self.wrong: list[str] = []
        self._kind, self._fault, self._chance = kind, fault, chance
        self._times = self._went_on = self._resumed = 0
        self._ends = [End(0.0, 0.0, 0.0)]

    def once(self) -> None:
        """Start a controller and a program, inject the fault, and check the outcome."""
        self._times += 1
        with (
            tempfile.TemporaryDirectory() as folder,
            self._cell(Path(folder)) as cell,
            closing(Terminal()) as self._terminal,
        ):
            program = self._start(cell)
            try:
                self.wrong += self._faults(cell, program)
            except AssertionError as error:
                self.wrong.append(str(error))
            finally:
                program.kill()
                program.communicate()

    def _cell(self, folder: Path) -> Any:
        if self._kind == "ros2":
            return Ros2Cell(folder)
        return Cell(folder, model="aubo-i5" if self._kind == "aubo" else "ur5e")

    def row(self) -> str:
        """Return the line of the table, with the longest times."""
        rests = max(end.rests for end in self._ends)
        exits, queued = max((end.exits or 0.0, end.queued) for end in self._ends)
        return (
            f"{self._kind:12} {self._fault:23} {self._times:5} {self._went_on:8} {rests:9.2f} "
            f"{exits:9.2f} {queued:12.2f} {self._resumed:8} {len(self.wrong):6}"
        )

    def _start(self, cell: Any) -> subprocess.Popen[str]:
        if self._calibrates:
            return self._run(cell, cell.recipe(), "--out", "run")
        return subprocess.Popen(
            python_command("-c", "import sys; sys.path.insert(0, sys.argv.pop(1)); "
                           "from tests.motion.leader import main; main(sys.argv[1])",
                           str(Path(__file__).parents[1]), cell.controller.host),
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(cell.folder),
            **self._terminal.given,
        )  # fmt: skip

    def _run(self, cell: Any, *words: Any) -> subprocess.Popen[str]:
        given = self._terminal.given
        if self._kind == "ros2":
            return cell.start("run", *words, "--move", **given)
        return cell.start(*words, "--move", env=environment(cell.folder), **given)

    @property
    def _calibrates(self) -> bool:
        return self._kind != "leading"

    def _cause(self, cell: Any, program: subprocess.Popen[str]) -> None:
        """Inject the fault."""
        if strike := {**STROKES, **OF_A_CLIENT, **OF_A_BRIDGE}.get(self._fault):
            strike(program.pid, self._terminal)
        elif shift := SHIFTS.get(self._fault):
            (cell.folder / "shift").write_text(shift, "ascii")
        else:
            cell.control.fault(self._fault)

    def _faults(self, cell: Any, program: subprocess.Popen[str]) -> Iterator[str]:
        """Inject the fault while the arm moves, and yield the failed checks."""
        for _ in range(self._chance.randrange(4) if self._calibrates else 0):
            cell.wait_until(lambda: _speed(cell) > MOVES or _over(program), STARTING)
            cell.wait_until(lambda: _speed(cell) < STANDS or _over(program), STARTING)
        cell.wait_until(lambda: _speed(cell) > MOVES or _over(program), STARTING)
        if _over(program):
            yield f"it ended before: {program.communicate()[1].splitlines()[-1]}"
            return
        time.sleep(self._chance.uniform(0, 0.3))
        before, began = set(cell.finished()), cell.control.truth().time
        self._cause(cell, program)
        end = _watched(cell, program, began)
        if end.exits is None or not program.returncode:
            self._went_on += 1
            yield from self._through(program, end.rests)
        elif self._fault in HARMLESS:
            yield f"it ends: {program.communicate()[1].splitlines()[-1:]}"
        else:
            self._ends.append(end)
            held = HELD if "held" in self._fault else 0.0
            if end.rests > RESTS or end.exits - held - end.queued > ENDS:
                yield (f"the arm rests after {end.rests:.2f} s, the program ends after "
                       f"{end.exits:.2f} s, {end.queued:.2f} s of them without a core")  # fmt: skip
        yield from (f"{lost} is lost" for lost in before - set(cell.finished()))
        recorded = self._calibrates and (cell.folder / "run" / "run.mcap").exists()
        if recorded and program.returncode and self._fault not in (*cell.faults, *SHIFTS):
            yield from self._goes_on(cell, program)

    def _goes_on(self, cell: Any, program: subprocess.Popen[str]) -> Iterator[str]:
        """Yield the failures of a run's hint to resume, and of resuming."""
        told = program.communicate()[1]
        if "--resume" not in told and self._fault != "program killed":
            yield f"it does not say how to go on: {told.splitlines()[-1:]}"
        if self._resumed:
            return
        before, going = len(cell.finished()), self._run(cell, "--resume", "run", "--out", "again")
        try:
            cell.wait_until(lambda: len(cell.finished("again")) > before or _over(going), STARTING)
        finally:
            going.kill()
            _, told = going.communicate()
        self._resumed += len(cell.finished("again")) > before
        if not self._resumed:
            yield f"it does not go on by --resume: {told.splitlines()[-1:]}"

    def _through(self, program: subprocess.Popen[str], moved: float) -> Iterator[str]:
        """Yield the failures of a program that continued under a fault."""
        if self._fault not in (*HARMLESS, EITHER):
            yield "the program goes on under it"
        elif not self._calibrates and moved < ENDS:
            yield "the arm stands"
        elif self._calibrates:
            _, told = program.communicate(timeout=WHOLE)
            if program.returncode not in (0, 1):
                yield f"it went on and then ended: {told.splitlines()[-1:]}"


def _speed(cell: Any) -> float:
    return cell.control.truth().speed


def _over(program: subprocess.Popen[str]) -> bool:
    return program.poll() is not None


def _watched(cell: Any, program: subprocess.Popen[str], began: float) -> End:
    """Observe arm and program until both have ended, or continue in spite of the fault."""
    moved = now = 0.0
    ended, waited, before = None, 0.0, _queued(program.pid)
    while now < PATIENCE and (ended is None or now < ended + RESTS):
        truth = cell.control.truth()
        now = truth.time - began
        moved = now if truth.speed > STANDS else moved
        if ended is None and _over(program):
            ended = now
        for process, seconds in _queued(program.pid).items():
            waited = max(waited, seconds - before.get(process, 0.0))
        time.sleep(0.02)
    return End(moved, ended, waited)


def _queued(pid: int) -> dict[int, float]:
    """Return how long a program, and each that it started, has waited for a core so far [s]."""
    waited: dict[int, float] = {}
    with suppress(OSError):
        told = Path(f"/proc/{pid}/task/{pid}/children").read_text("ascii")
        for process in (pid, *map(int, told.split())):
            words = Path(f"/proc/{process}/task/{process}/schedstat").read_text("ascii").split()
            waited[process] = 1e-9 * int(words[1])
    return waited


if __name__ == "__main__":
    main()

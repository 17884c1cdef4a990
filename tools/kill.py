"""Kill runs at random moments: python -m tools.kill [COUNT] [--seed N] [--kind NAME …].

Each run is killed (-9), alone or with its process group, at a random moment after its log exists
(for a monitor: after its history's lock exists). Checked are: finished captures are in the log and
readable; the run can be resumed (``--resume``, ``--from``, or the batch's or monitor's own
command); and no process, port, temporary file or shared memory of the killed run is left.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from flangeye.errors import FlangeyeError
from flangeye.files.processes import python_command
from flangeye.workflow.batch.cluster import PREFIX
from flangeye.workflow.doctor.monitor.history import History
from flangeye.workflow.doctor.monitor.stored import stored_calibration
from flangeye.workflow.log.read import read_run
from tests.workflow.doctor.monitor.cell import part_of_sample

MARK = "FLANGEYE_KILLED"
"""In the environment of a run and of all that it starts."""

LINGER = 5.0
"""Longest time until what a killed run started has ended by itself, its waits for a core aside [s]:
what is still starting, as a batch's workers are, ends when it looks for who started it."""

ENOUGH = 5
"""Observations from which a calibration can be solved again."""

SMALL = (
    "--set", "acquire.simulated.resolution=0.5",
    "--set", "acquire.simulated.poses={grid: {counts: [2, 2, 2]}}",
)  # fmt: skip
FEWER = ("--set", "acquire.live.poses={next_best: {count: 6}}")


class Kind(NamedTuple):
    """A kind of run: its command, the command that resumes it, and the file it writes first.

    ``OUT`` in a command is the run's folder (given by ``--out``), ``PARENT`` the folder above it. A
    command that begins with ``-c`` is a Python program that starts a run in its folder.
    """

    command: tuple[str, ...]
    goes_on: Callable[[Path], tuple[str, ...] | None]
    writes: str = "run.mcap"


def _solved_again(recipe: str) -> Callable[[Path], tuple[str, ...] | None]:
    def command(out: Path) -> tuple[str, ...] | None:
        if len(read_run(out).observations()) < ENOUGH:
            return None
        return ("run", recipe, "--from", str(out), "--at", "solve.robust", "--out", f"{out}-again")

    return command


def _resumed(out: Path) -> tuple[str, ...] | None:
    log = read_run(out)
    if not log.gathered or log.result is not None:
        return None
    return ("run", "--resume", str(out), "--move", "--out", f"{out}-again")


def _recorded(recipe: str, *options: str) -> Kind:
    return Kind(("run", recipe, *options), _solved_again(recipe))


def _checked_again(out: Path) -> tuple[str, ...] | None:
    """Return the command of the same check, unless the (readable) history has it already."""
    stored = stored_calibration(out.parent / "calibration")
    checks = History.read(out / "h.jsonl", stored.key).checks
    return None if checks else MONITOR


def _calibrated(folder: Path) -> None:
    """Calibrate from six of the sample's scans, and lay the others aside for a check."""
    part_of_sample(folder / "scans", range(6))
    part_of_sample(folder / "later", range(6, 8))
    words = ("run", "ur5_phoxi-m_sample", "--archive", f"{folder}/scans")
    command = python_command("-m", "flangeye.cli", *words, "--out", f"{folder}/calibration")
    subprocess.run(command, check=True, capture_output=True)


MONITOR = (
    "monitor", "PARENT/calibration", "--archive", "PARENT/later", "--history", "OUT/h.jsonl",
)  # fmt: skip
BATCH = ("batch", "ur5_phoxi-m_simulated", "--repeat", "3", "--workers", "2", "--no-report", *SMALL)
SERVER = """
import sys, time
from pathlib import Path
from flangeye.plugin.registry import load_registry
from flangeye_ui.process import RunProcess
folder = Path("OUT")
folder.mkdir(exist_ok=True)
run = RunProcess(folder, sys.argv[1:], False, load_registry())
while run.code is None:
    time.sleep(0.05)
sys.exit(run.code)
"""
"""What the page's server does with a run: starts it and follows its log."""


def _of_page(out: Path) -> tuple[str, ...] | None:
    """Return the command that resumes a run started by the page's server."""
    return _solved_again("ur5_phoxi-m_sample")(next(out.glob("runs/*")))


KINDS = {
    "archive": _recorded("ur5_phoxi-m_sample"),
    "simulated": _recorded("ur5_phoxi-m_simulated", *SMALL),
    "live": Kind(("run", "ur5e_phoxi-m_loopback", "--move", *FEWER), _resumed),
    "weld": _recorded("ur10e_phoxi-m_weld_simulated", *SMALL),
    "batch": Kind(BATCH, lambda out: (*BATCH, "--out", str(out))),
    "ui": Kind(("-c", SERVER, "run", "ur5_phoxi-m_sample"), _of_page),
    "monitor": Kind(MONITOR, _checked_again, ".h.jsonl.lock"),
}


def main() -> None:
    """Kill runs, check them, and print a line for each kind."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("count", nargs="?", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=list(KINDS))
    asked = parser.parse_args()
    each, wrong = asked.count // len(asked.kind), 0
    print("kind       kills  within  logs  captures  gone on  faults", flush=True)
    for name in asked.kind:
        with tempfile.TemporaryDirectory() as folder:
            if name == "monitor":
                _calibrated(Path(folder))
            trial = Trial(KINDS[name], Path(folder), random.Random(f"{name} {asked.seed}"))
            trial.kill(each)
        print(trial.row(name, each), *trial.faults, sep="\n  ", flush=True)
        wrong += len(trial.faults)
    sys.exit(bool(wrong))


class Trial:
    """The kills of one kind of run, with their outcomes."""

    def __init__(self, kind: Kind, folder: Path, chance: random.Random) -> None:
        self.faults: list[str] = []
        self._kind, self._folder, self._chance = kind, folder, chance
        self._logs = self._captures = self._gone_on = 0
        self._duration = 0.0

    def kill(self, count: int) -> None:
        """Measure the duration of one complete run, then kill ``count`` runs."""
        began = time.monotonic()
        whole = self._start(self._kind.command, self._folder / "whole", stderr=subprocess.PIPE)
        _, told = whole.communicate()
        if whole.returncode not in (0, 1):
            raise SystemExit(f"{' '.join(self._kind.command)}: {told.decode().strip()}")
        self._duration = time.monotonic() - began
        for number in range(count):
            share = self._chance.random()
            self.faults += [f"at {share:.2f}: {fault}" for fault in self._killed(number, share)]

    def row(self, name: str, count: int) -> str:
        """Return the line of the table."""
        return (
            f"{name:10} {count:5} {self._duration:5.0f} s {self._logs:5} {self._captures:9} "
            f"{self._gone_on:8} {len(self.faults):7}"
        )

    def _killed(self, number: int, share: float) -> Iterator[str]:
        out = self._folder / str(number)
        began = time.monotonic()
        run = self._start(self._kind.command, out)
        while run.poll() is None and not any(out.rglob(self._kind.writes)):
            time.sleep(0.005)
        left = max(self._duration - (time.monotonic() - began), 0.0)
        with suppress(subprocess.TimeoutExpired):
            run.wait(share * left)
        before = {log: set(_finished(log)) for log in out.rglob("run.mcap")}
        shared = _shared(str(out))
        kill = os.killpg if self._chance.random() < 0.5 else os.kill
        with suppress(ProcessLookupError):
            kill(run.pid, signal.SIGKILL)
        run.wait()
        yield from self._left(out, shared)
        for log, finished in before.items():
            yield from self._lost(log, finished)
        yield from self._stuck(out)

    def _left(self, out: Path, shared: set[str]) -> Iterator[str]:
        """Yield the remains of a killed run outside its folder."""
        until = time.monotonic() + LINGER
        while (left := _marked(str(out))) and time.monotonic() < until + _queued(left):
            time.sleep(0.1)
        for pid, command in left.items():
            yield f"a process is left: {command}"
            os.kill(pid, signal.SIGKILL)
        forgotten = {*_temporary(out).iterdir(), *map(Path, shared)} - {*_scratch(out)}
        yield from (f"{path} is left" for path in sorted(forgotten) if path.exists())

    def _lost(self, path: Path, finished: set[str]) -> Iterator[str]:
        """Yield what of a log cannot be read though it was finished before."""
        if not (finished or path.exists()):
            return  # the page's server was killed: its run was told to stop, and had no capture yet
        self._logs += 1
        try:
            log = read_run(path)
        except FlangeyeError as error:
            yield str(error)
            return
        told = {str(entry.capture) for entry in log.entries} | {r.id for r in log.rejections}
        self._captures += len(log.finished)
        yield from log.damage
        yield from (f"{path}: {capture} is lost" for capture in finished - set(log.finished))
        yield from (f"{path}: {capture} is empty" for capture in set(log.finished) - told)

    def _stuck(self, out: Path) -> Iterator[str]:
        """Resume a run, and yield the reason if that fails."""
        try:
            command = self._kind.goes_on(out) if any(out.rglob(self._kind.writes)) else None
        except FlangeyeError as error:
            if self._kind.writes != "run.mcap":
                yield str(error)
            return  # the log was killed before its first message, which is no loss
        if command is None:
            return
        self._gone_on += 1
        again = self._start(command, out, stderr=subprocess.PIPE)
        _, told = again.communicate()
        if again.returncode not in (0, 1):
            ended = f"{' '.join(command)} ended with {again.returncode}"
            yield f"{ended}: {told.decode().strip()}"
        yield from (f"{path} is left" for path in _scratch(out))

    def _start(
        self, command: tuple[str, ...], out: Path, stderr: int = subprocess.DEVNULL
    ) -> subprocess.Popen[bytes]:
        """Start a command, with the folder's name in its environment and its children's."""
        _temporary(out).mkdir(exist_ok=True)
        environment = {**os.environ, MARK: str(out), "TMPDIR": str(_temporary(out))}
        words = [w.replace("OUT", str(out)).replace("PARENT", str(out.parent)) for w in command]
        if "--out" not in words and command[0] not in ("monitor", "-c"):
            words += ["--out", str(out)]
        program = () if command[0] == "-c" else ("-m", "flangeye.cli")
        return subprocess.Popen(
            python_command(*program, *words),
            env=environment, start_new_session=True, stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL, stderr=stderr,
        )  # fmt: skip


def _temporary(out: Path) -> Path:
    return out.with_name(f"{out.name}-tmp")


def _scratch(out: Path) -> list[Path]:
    """Return where dask's processes have their folders; the next batch removes a killed one's."""
    return list(_temporary(out).glob(f"{PREFIX}*"))


def _finished(log: Path) -> list[str]:
    try:
        return read_run(log).finished
    except FlangeyeError:
        return []


def _processes(out: str) -> Iterator[Path]:
    """Yield the system's data on each surviving process that a run started."""
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if f"{MARK}={out}".encode() in (process / "environ").read_bytes().split(b"\0"):
                yield process


def _marked(out: str) -> dict[int, str]:
    """Return the processes that a run started and that still live, with their commands."""
    found = {}
    for process in _processes(out):
        with suppress(OSError):
            words = (process / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            found[int(process.name)] = words
    return found


def _queued(processes: Iterable[int]) -> float:
    """Return how long the process that had to wait most for a core has done so [s]."""
    waited = [0.0]
    for process in processes:
        with suppress(OSError):
            words = Path(f"/proc/{process}/schedstat").read_text("ascii").split()
            waited.append(1e-9 * int(words[1]))
    return max(waited)


def _shared(out: str) -> set[str]:
    """Return the shared memory that the processes of a run have."""
    found = set()
    for process in _processes(out):
        with suppress(OSError):
            maps = (process / "maps").read_text("utf-8", "replace")
            found |= {word for word in maps.split() if word.startswith("/dev/shm/")}
    return found


if __name__ == "__main__":
    main()

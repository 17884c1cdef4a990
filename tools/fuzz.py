"""Fuzz every reader: python -m tools.fuzz [CASES] [--target NAME] [--seed N] [--coverage SECONDS].

Each target runs in its own process, in a folder with canaries: a Python module with a library's
name, and a program. A find is any exception but FlangeyeError, a signal, more than 20 s of CPU
time, ten minutes of wall-clock time or 2 GB for one input, or an executed canary. Finds are stored
in tests/fuzz/seeds/TARGET/, where the fast tests read them again. With --coverage, atheris guides
the search for this time per target (pip install 'flangeye[fuzz]').
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import os
import random
import resource
import signal
import sys
import tempfile
import traceback
from pathlib import Path

if "--coverage" in sys.argv:
    import atheris

    # For good, and before anything of ours is imported, in each child too.
    atheris.instrument_imports(include=["flangeye", "flangeye_plugins"]).__enter__()

from flangeye.files.processes import keep_current_folder_out
from tests.fuzz.damage import damaged
from tests.fuzz.targets import SEEDS, TARGETS, Target, survives

HANG, WAITS = 20.0, 600.0
"""Longest for one input: CPU time, which a busy machine does not lengthen, and by the clock [s]."""

LIMITS = (
    (signal.ITIMER_PROF, signal.SIGPROF, HANG), (signal.ITIMER_REAL, signal.SIGALRM, WAITS),
    (signal.ITIMER_VIRTUAL, signal.SIGVTALRM, 2 * HANG),
)  # fmt: skip
MEMORY_KB = 2_000_000


def main() -> None:
    """Run the targets and print a table."""
    asked = _arguments()
    keep_current_folder_out()
    names = [asked.target] if asked.target else list(TARGETS)
    each = -(-asked.cases // len(names))
    print(f"{'target':14} {'inputs':>8} {'read':>8} {'refused':>8} {'finds':>6} {'CPU [s]':>8}")
    total = 0
    for name in names:
        began = _cpu()
        read, refused, finds = _in_child(name, each, asked)
        total += finds
        print(
            f"{name:14} {read + refused + finds:8} {read:8} {refused:8} {finds:6} "
            f"{_cpu() - began:8.1f}",
            flush=True,
        )
    sys.exit(bool(total))


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("cases", nargs="?", type=int, default=100_000)
    parser.add_argument("--target", choices=TARGETS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--coverage", type=int, metavar="SECONDS", default=0)
    return parser.parse_args()


def _in_child(name: str, cases: int, asked: argparse.Namespace) -> tuple[int, int, int]:
    """Return how many inputs were read, refused, and found to break something."""
    spawn = multiprocessing.get_context("spawn")
    counts = spawn.Array("q", 3)
    done = 0
    while done < cases:  # a process that dies has one find, and the next goes on behind it
        with tempfile.TemporaryDirectory() as folder:
            amount = asked.coverage or range(done, cases)
            work = _covered if asked.coverage else _fuzzed
            child = spawn.Process(
                target=work, args=(name, Path(folder), amount, asked.seed, counts)
            )
            child.start()
            child.join()
        if child.exitcode == 0:
            break
        counts[2] += 1
        last = SEEDS / name / "last"
        if last.exists():
            last.rename(last.with_name(hashlib.sha256(last.read_bytes()).hexdigest()[:12]))
        print(
            f"{name}: the process ended with {child.exitcode} at input {sum(counts[:])}", flush=True
        )
        done = sum(counts[:])
    return counts[0], counts[1], counts[2]


def _fuzzed(name: str, folder: Path, cases: range, seed: int, counts) -> None:
    target = TARGETS[name]
    _lay_canaries(folder)
    sound = target.seeds(folder)
    for number in cases:
        chance = random.Random(f"{seed} {name} {number}")
        _once(name, target, folder, damaged(chance.choice(sound), target.suffix, chance), counts)


def _once(name: str, target: Target, folder: Path, raw: bytes, counts) -> None:
    path = folder / f"input{target.suffix}"
    path.write_bytes(raw)
    (SEEDS / name).mkdir(parents=True, exist_ok=True)
    last = SEEDS / name / "last"  # kept if the process dies of it
    last.write_bytes(raw)
    for timer, number, seconds in LIMITS:
        # Where a library never returns no handler runs: the last timer ends the process itself
        signal.signal(number, signal.SIG_DFL if timer == signal.ITIMER_VIRTUAL else _hung)
        signal.setitimer(timer, seconds)
    try:
        counts[0 if survives(target, path) else 1] += 1
    except BaseException:
        counts[2] += 1
        last.rename(last.with_name(hashlib.sha256(raw).hexdigest()[:12]))
        traceback.print_exc()
    finally:
        for timer, *_ in LIMITS:
            signal.setitimer(timer, 0.0)
    last.unlink(missing_ok=True)
    if (folder / "PWNED").exists() or resource.getrusage(
        resource.RUSAGE_SELF
    ).ru_maxrss > MEMORY_KB:
        last.write_bytes(raw)
        os._exit(3)


def _hung(*_: object) -> None:
    raise TimeoutError(f"more than {HANG:g} s of CPU time, or {WAITS:g} s by the clock")


def _lay_canaries(folder: Path) -> None:
    sys.stderr = os.fdopen(os.dup(2), "w")  # for finds; image libraries write to what was there
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    for module in ("yaml", "struct", "zstandard"):
        (folder / f"{module}.py").write_text(f"open({str(folder / 'PWNED')!r}, 'w')\n")
    program = folder / "evil.sh"
    program.write_text(f"#!/bin/sh\ntouch {folder / 'PWNED'}\n")
    program.chmod(0o755)
    os.chdir(folder)


def _covered(name: str, folder: Path, seconds: int, seed: int, counts) -> None:
    """Run atheris, which searches for inputs that reach new code."""
    target, corpus = TARGETS[name], folder / "corpus"
    _lay_canaries(folder)
    corpus.mkdir()
    for number, raw in enumerate(target.seeds(folder)):
        (corpus / str(number)).write_bytes(raw)
    limits = [f"-max_total_time={seconds}", f"-timeout={HANG:.0f}", f"-seed={seed + 1}"]
    words = ["fuzz", str(corpus), *limits, "-verbosity=0"]
    atheris.Setup(words, lambda raw: _once(name, target, folder, raw, counts))
    atheris.Fuzz()


if __name__ == "__main__":
    main()

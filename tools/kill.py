"""Kill runs at random moments: python -m tools.kill [COUNT] [--seed N] [--recipe NAME …].

Each run is killed (-9) with its process group at a random moment of its duration. Afterwards: the
log can be read and has every capture that was finished, ``run --from`` goes on from it, and no
process of the run is left.
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
from contextlib import suppress
from pathlib import Path

from flangeye.files.children import python_command
from flangeye.log.read import read_run

RECIPES = ("ur5_phoxi-m_sample", "ur5_phoxi-m_simulated")


def main() -> None:
    """Kill, look, and print a line for each recipe."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("count", nargs="?", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--recipe", nargs="+", default=RECIPES)
    asked = parser.parse_args()
    chance, wrong = random.Random(asked.seed), 0
    for recipe in asked.recipe:
        with tempfile.TemporaryDirectory() as folder:
            duration = _timed(recipe, Path(folder) / "whole")
            faults = [f for i in range(asked.count // len(asked.recipe))
                      for f in _killed(recipe, Path(folder) / str(i), chance.uniform(0, duration))]  # fmt: skip
        print(f"{recipe}: {asked.count // len(asked.recipe)} kills within {duration:.1f} s, "
              f"{len(faults)} faults", *faults, sep="\n  ", flush=True)  # fmt: skip
        wrong += len(faults)
    sys.exit(bool(wrong))


def _command(recipe: str, out: Path, *more: str) -> list[str]:
    return python_command("-m", "flangeye.cli", "run", recipe, "--out", str(out), *more)


def _timed(recipe: str, out: Path) -> float:
    began = time.monotonic()
    subprocess.run(_command(recipe, out), capture_output=True, check=True)
    return time.monotonic() - began


def _killed(recipe: str, out: Path, after: float) -> list[str]:
    """Return what was wrong after a kill."""
    run = subprocess.Popen(_command(recipe, out), stdout=subprocess.DEVNULL,
                           stderr=subprocess.DEVNULL, start_new_session=True)  # fmt: skip
    time.sleep(after)
    with suppress(ProcessLookupError):
        os.killpg(run.pid, signal.SIGKILL)
    run.wait()
    faults = [] if _gone(run.pid) else [f"{after:.2f} s: a process is left"]
    if not (out / "run.mcap").exists():
        return faults
    log = read_run(out / "run.mcap")
    if log.damage or any(capture not in log.poses for capture in log.finished if log.poses):
        faults.append(f"{after:.2f} s: damaged: {log.damage}")
    if len(log.observations()) >= 5:
        again = _command(
            recipe,
            out.with_name(f"{out.name}-again"),
            "--from",
            str(log.path),
            "--at",
            "solve.robust",
        )
        if (told := subprocess.run(again, capture_output=True, text=True)).returncode == 2:
            faults.append(f"{after:.2f} s: {told.stderr.strip()}")
    return faults


def _gone(group: int) -> bool:
    with suppress(ProcessLookupError):
        os.killpg(group, 0)
        return False
    return True


if __name__ == "__main__":
    main()

"""What a batch costs beyond its work: ``python -m tests.batch.measure [sessions]``.

Overhead: a batch on one worker against the same sessions in a loop, everything included (start of
the worker, plan, tables, page). Speed: the same batch on two workers. Memory: of the workers and
of the command, early and late in the batch.
"""

import os
import resource
import sys
import tempfile
import threading
import time
from pathlib import Path

import psutil

ROOT = Path(__file__).parents[2]
SITE = Path(__file__).parent / "site"
for folder in (str(ROOT), str(SITE)):
    if folder not in sys.path:
        sys.path.insert(0, folder)

from rich.console import Console  # noqa: E402

from flangeye.batch import Request, run_batch  # noqa: E402
from flangeye.recipe import load_recipe  # noqa: E402
from flangeye.registry import load_registry  # noqa: E402
from flangeye.runfolder import RunFolder  # noqa: E402
from flangeye.session import Start, record_run  # noqa: E402

RECIPE = """\
title: Toy
steps:
  - acquire.toy: {count: 6, noise: 0.1 mm}
  - segment.toy
  - fit.toy
  - solve.work: {wait: 300 ms}
  - verify.toy: {max_rms: 2 mm}
"""


def processor_seconds():
    """Return what this process and those below it that have ended have used."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def timed(work, *arguments):
    """Return the seconds on the wall and of the processor, and what the work gave."""
    wall, processor = time.perf_counter(), processor_seconds()
    given = work(*arguments)
    return time.perf_counter() - wall, processor_seconds() - processor, given


def loop(recipe, folder, sessions):
    """Run the sessions one after the other, as ``flangeye run`` does each."""
    registry = load_registry()
    for seed in range(sessions):
        checked = load_recipe(recipe, registry, [f"seed={seed}"])
        place = RunFolder.create("toy", folder / str(seed))
        record_run(checked, registry, place, Start(), report=False)


def batch(recipe, folder, sessions, workers):
    """Run a batch; return the seconds of its sessions, added up."""
    request = Request(str(recipe), repeat=sessions, workers=workers, out=folder, report=False)
    done = run_batch(request, load_registry(), Console(stderr=True, quiet=True))
    assert done.accepted and len(done.outcomes) == sessions
    return sum(outcome.seconds for outcome in done.outcomes.values())


class Memory(threading.Thread):
    """Samples the resident memory [MB] of this process and of the largest below it."""

    def __init__(self):
        super().__init__(daemon=True)
        self.samples = []
        self.stop = threading.Event()

    def run(self):
        own = psutil.Process(os.getpid())
        while not self.stop.wait(0.5):
            below = []
            for child in own.children(recursive=True):
                try:
                    below.append(child.memory_info().rss)
                except psutil.NoSuchProcess:
                    continue
            self.samples.append((own.memory_info().rss / 1e6, max(below, default=0) / 1e6))


def main():
    """Print the figures."""
    sessions = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recipe = folder / "toy.yaml"
        recipe.write_text(RECIPE)
        loop(recipe, folder / "first", 2)
        alone, alone_used, _ = timed(loop, recipe, folder / "loop", sessions)
        one, one_used, worked = timed(batch, recipe, folder / "one", sessions, 1)
        two, _, _ = timed(batch, recipe, folder / "two", sessions, 2)
        again, _, _ = timed(batch, recipe, folder / "two", sessions, 2)
        recipe.write_text(RECIPE.replace("300 ms", "0 ms"))
        memory = Memory()
        memory.start()
        quick, _, _ = timed(batch, recipe, folder / "many", 500, 2)
        memory.stop.set()
    early, late = memory.samples[len(memory.samples) // 4], memory.samples[-4]
    each = 1e3 / sessions
    print(f"{sessions} sessions in a loop: {alone:.1f} s, {each * alone:.0f} ms each")
    print(f"batch, 1 worker: {one:.1f} s; overhead a session, start and tables included:")
    print(f"  {each * (one - alone):.1f} ms against the loop")
    print(f"  {each * (one - worked):.1f} ms against the time its sessions took")
    print(f"  {each * (one_used - alone_used):.1f} ms of the processor against the loop")
    print(f"batch, 2 workers: {two:.1f} s, {one / two:.2f} times as fast as one")
    print(f"all finished earlier: {again:.1f} s")
    print(f"500 quick sessions: {quick:.1f} s; memory of the command {early[0]:.0f} -> "
          f"{late[0]:.0f} MB, of the largest worker {early[1]:.0f} -> {late[1]:.0f} MB")  # fmt: skip


if __name__ == "__main__":
    main()

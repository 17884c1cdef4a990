"""What a batch costs beyond its work: ``python -m tools.measure_batch [SESSIONS] [MANY]``.

Overhead: the wall time of a batch on one running worker, less the time its sessions took, a
session; and what command and worker use of the processor, less what the same sessions use in a
loop: on a machine that does other things besides, only this means something. The start of the
cluster, and of the plugins in its first session, are told apart.
Speed: the same batch on two workers. Memory: of the command and of its largest worker, early and
late in MANY sessions that do next to nothing (0 leaves this out). Each line comes when it is known.
"""

import os
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import psutil

ROOT = Path(__file__).parents[2]
SITE = Path(__file__).parent / "site"
for folder in (str(ROOT), str(SITE)):
    if folder not in sys.path:
        sys.path.insert(0, folder)

from rich.console import Console  # noqa: E402

from flangeye.batch import Request, run_batch  # noqa: E402
from flangeye.batch.cluster import local_client  # noqa: E402
from flangeye.plugin.registry import load_registry  # noqa: E402
from flangeye.recipe.load import load_recipe  # noqa: E402
from flangeye.run.folder import RunFolder  # noqa: E402
from flangeye.run.session import Start, record_run  # noqa: E402

RECIPE = """\
title: Toy
steps:
  - acquire.toy: {count: 6, noise: 0.1 mm}
  - segment.toy
  - fit.toy
  - solve.work: {wait: WAIT ms}
  - verify.toy: {max_rms: 2 mm}
"""
WORK = 300
"""What each session waits [ms]: long enough for two workers to be worth their start."""


def say(line):
    """Print a line now, also into a pipe."""
    print(line, flush=True)


class Bench:
    """Batches of a toy recipe in a folder of their own."""

    def __init__(self, folder):
        self.folder, self.registry = folder, load_registry()

    def batch(self, name, sessions, address, wait=WORK):
        """Run a batch; return its seconds on the wall and those of its sessions, added up."""
        recipe = self.folder / f"toy-{wait}.yaml"
        recipe.write_text(RECIPE.replace("WAIT", str(wait)))
        out = self.folder / name
        request = Request(str(recipe), repeat=sessions, scheduler=address, out=out, report=False)
        begun = time.perf_counter()
        done = run_batch(request, self.registry, Console(stderr=True, quiet=True))
        wall = time.perf_counter() - begun
        assert done.accepted and len(done.outcomes) == sessions
        return wall, sum(outcome.seconds for outcome in done.outcomes.values())

    def loop(self, sessions):
        """Run sessions one after the other, as ``flangeye run`` does each."""
        recipe = self.folder / "loop.yaml"
        recipe.write_text(RECIPE.replace("WAIT", "0"))
        for seed in range(sessions):
            checked = load_recipe(recipe, self.registry, [f"seed={seed}"])
            place = RunFolder.create("toy", self.folder / "loop" / str(seed))
            record_run(checked, self.registry, place, Start(), report=False)

    @contextmanager
    def workers(self, count):
        """Start workers, and run a session on each; yield their scheduler's address."""
        begun = time.perf_counter()
        with local_client(count) as client:
            address = client.scheduler.address
            started = time.perf_counter() - begun
            wall, _ = self.batch(f"first-{count}-{time.monotonic_ns()}", 2 * count, address, 0)
            say(f"start of {count} worker(s): {started:.1f} s; first sessions, which load the "
                f"plugins: {wall:.1f} s")  # fmt: skip
            yield address


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


def used():
    """Return the processor seconds of this process and of those below it that live."""
    own = psutil.Process(os.getpid())
    times = [process.cpu_times() for process in (own, *own.children(recursive=True))]
    return sum(t.user + t.system for t in times)


def measure_overhead(bench, sessions):
    """Say the overhead of one worker, and how much faster two are."""
    before = used()
    bench.loop(sessions)
    alone, each = used() - before, 1e3 / sessions
    say(f"{sessions} sessions in a loop: {each * alone:.1f} ms of the processor each")
    with bench.workers(1) as address:
        before = used()
        bench.batch("quick", sessions, address, wait=0)
        beyond = used() - before - alone
        one, worked = bench.batch("one", sessions, address)
    say(f"{sessions} sessions, 1 worker: {one:.2f} s, of which the sessions took {worked:.2f} s")
    say(f"  overhead a session: {each * (one - worked):.1f} ms on the wall, "
        f"{each * beyond:.1f} ms of the processor beyond the loop")  # fmt: skip
    with bench.workers(2) as address:
        two, _ = bench.batch("two", sessions, address)
        again, _ = bench.batch("two", sessions, address)
    say(f"{sessions} sessions, 2 workers: {two:.2f} s, {one / two:.2f} times as fast as one")
    say(f"started again, all finished: {again:.2f} s")


def measure_memory(bench, sessions):
    """Say the memory early and late in a batch of quick sessions."""
    memory = Memory()
    with bench.workers(2) as address:
        memory.start()
        wall, _ = bench.batch("many", sessions, address, wait=0)
        memory.stop.set()
    early, late = memory.samples[len(memory.samples) // 4], memory.samples[-2]
    say(f"{sessions} quick sessions: {wall:.1f} s; memory of the command {early[0]:.0f} -> "
        f"{late[0]:.0f} MB, of the largest worker {early[1]:.0f} -> {late[1]:.0f} MB")  # fmt: skip


def main():
    """Print the figures."""
    sessions, many = (int(v) for v in (sys.argv[1:] + ["60", "500"][len(sys.argv) - 1 :]))
    with tempfile.TemporaryDirectory() as name:
        bench = Bench(Path(name))
        measure_overhead(bench, sessions)
        if many:
            measure_memory(bench, many)


if __name__ == "__main__":
    main()

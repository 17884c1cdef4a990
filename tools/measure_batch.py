"""What a batch costs beyond its work: ``python -m tools.measure_batch [SESSIONS] [MANY]``.

Overhead per session: the wall time of a batch on one running worker minus its sessions' time; and
the processor time of command and worker minus that of the same sessions in a loop, which alone is
meaningful on a busy machine. The start of the cluster, and of the plugins in the first session, are
reported separately. Speed: the same batch on two workers. Many: cost of MANY empty sessions with
rows, and the memory of client and scheduler, early and largest. 0 leaves either out. Each line is
printed when it is known.
"""

import os
import sys
import tempfile
import threading
import time
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import psutil

ROOT = Path(__file__).parents[1]
SITE = ROOT / "tests" / "workflow" / "batch" / "site"
for folder in (str(ROOT), str(SITE)):
    if folder not in sys.path:
        sys.path.insert(0, folder)
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(SITE)])  # of the workers

from rich.console import Console  # noqa: E402

from flangeye.plugin.registry import load_registry  # noqa: E402
from flangeye.workflow.batch import Request, cluster, run_batch, work  # noqa: E402
from flangeye.workflow.batch.cluster import local_client  # noqa: E402
from flangeye.workflow.batch.outcome import SessionOutcome  # noqa: E402
from flangeye.workflow.recipe.load import load_recipe  # noqa: E402
from flangeye.workflow.run.folder import RunFolder  # noqa: E402
from flangeye.workflow.run.session import Start, record_run  # noqa: E402

RECIPE = """\
title: Toy
steps:
  - acquire.toy: {count: 6, noise: 0.1 mm}
  - segment.toy
  - fit.toy
  - solve.work: {wait: WAIT ms}
  - verify.toy: {max_rms: 2 mm}
"""
OUTCOME = SessionOutcome(
    "verified", None, 75, 76, 1e-4, 9e-5, 2e-4, 1.2e-4, 2.1e-4, 1e-4, 5e-5, 1e-3, 41.7
)
WORK = 300
"""What each session waits [ms]: long enough for two workers to be worth their start."""


def say(line):
    """Print a line now, also into a pipe."""
    print(line, flush=True)


class Bench:
    """Batches of a toy recipe in a folder of their own."""

    def __init__(self, folder):
        self.folder, self.registry = folder, load_registry()

    def batch(self, name, sessions, client, wait=WORK):
        """Run a batch; return its seconds on the wall and those of its sessions, added up."""
        recipe = self.folder / f"toy-{wait}.yaml"
        recipe.write_text(RECIPE.replace("WAIT", str(wait)))
        out = self.folder / name
        request = Request(str(recipe), repeat=sessions, out=str(out), report=False)
        begun = time.perf_counter()
        with patch("flangeye.workflow.batch._client", lambda *_: nullcontext(client)):
            done = run_batch(request, self.registry, Console(stderr=True, quiet=True))
        wall = time.perf_counter() - begun
        assert done.accepted and done.tally.total == sessions
        return wall, done.tally.seconds

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
        """Start workers, and run a session on each; yield their client."""
        begun = time.perf_counter()
        with local_client(count) as client:
            started = time.perf_counter() - begun
            wall, _ = self.batch(f"first-{count}-{time.monotonic_ns()}", 2 * count, client, 0)
            say(f"start of {count} worker(s): {started:.1f} s; first sessions, which load the "
                f"plugins: {wall:.1f} s")  # fmt: skip
            yield client


class Memory(threading.Thread):
    """Samples the resident memory [MB] of this process: client and scheduler."""

    def __init__(self):
        super().__init__(daemon=True)
        self.samples = []
        self.stop = threading.Event()

    def run(self):
        own = psutil.Process(os.getpid())
        while not self.stop.wait(0.2):
            self.samples.append(own.memory_info().rss / 1e6)


def empty_chunk(job, chunk):
    """Replace a worker's chunk by empty sessions, whose rows are written."""
    begun = time.perf_counter()
    told = work.write_rows(job, chunk, [OUTCOME] * len(chunk.sessions))
    return replace(told, seconds=time.perf_counter() - begun)


def used():
    """Return the processor seconds of this process and of those below it that live."""
    own = psutil.Process(os.getpid())
    times = [process.cpu_times() for process in (own, *own.children(recursive=True))]
    return sum(t.user + t.system for t in times)


def measure_overhead(bench, sessions):
    """Print the overhead of one worker, and the speed-up by two."""
    before = used()
    bench.loop(sessions)
    alone, each = used() - before, 1e3 / sessions
    say(f"{sessions} sessions in a loop: {each * alone:.1f} ms of the processor each")
    with bench.workers(1) as client:
        before = used()
        bench.batch("quick", sessions, client, wait=0)
        beyond = used() - before - alone
        one, worked = bench.batch("one", sessions, client)
    say(f"{sessions} sessions, 1 worker: {one:.2f} s, of which the sessions took {worked:.2f} s")
    say(f"  overhead a session: {each * (one - worked):.1f} ms on the wall, "
        f"{each * beyond:.1f} ms of the processor beyond the loop")  # fmt: skip
    with bench.workers(2) as client:
        two, _ = bench.batch("two", sessions, client)
        again, _ = bench.batch("two", sessions, client)
    say(f"{sessions} sessions, 2 workers: {two:.2f} s, {one / two:.2f} times as fast as one")
    say(f"started again, all finished: {again:.2f} s")


def measure_many(bench, sessions):
    """Print the cost of empty sessions, and the memory of client and scheduler."""
    memory = Memory()
    with bench.workers(1) as client, patch.object(cluster, "run_chunk", empty_chunk):
        bench.batch("few", 200, client, wait=0)
        memory.start()
        cpu, before = time.process_time(), used()
        wall, _ = bench.batch("many", sessions, client, wait=0)
        memory.stop.set()
        own, both = time.process_time() - cpu, used() - before
        early, late = memory.samples[len(memory.samples) // 10], max(memory.samples)
        say(f"{sessions} sessions that do nothing: {1e3 * wall / sessions:.2f} ms each on the wall; "
            f"of the processor {1e3 * own / sessions:.2f} ms for client and scheduler, "
            f"{1e3 * (both - own) / sessions:.2f} ms for the worker")  # fmt: skip
        say(f"  memory of client and scheduler {early:.0f} -> {late:.0f} MB")
        cpu = time.process_time()
        bench.batch("many", sessions, client, wait=0)
        say(f"  started again, all finished: {time.process_time() - cpu:.1f} s of the processor")


def main():
    """Print the figures."""
    sessions, many = (int(v) for v in (sys.argv[1:] + ["60", "10000"][len(sys.argv) - 1 :]))
    with tempfile.TemporaryDirectory() as name:
        bench = Bench(Path(name))
        if sessions:
            measure_overhead(bench, sessions)
        if many:
            measure_many(bench, many)


if __name__ == "__main__":
    main()

"""What a start of a batch costs whose sessions have all finished: python -m tests.benchmarks.restart [N]

Writes what N finished sessions leave, starts the batch again and prints seconds of the processor,
seconds of the clock and the memory that came on top, for planning, looking, and the tables.
"""

import io
import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from flangeye.batch import Request, command
from flangeye.batch.outcome import SessionOutcome, mark_finished
from flangeye.batch.plan import plan
from flangeye.batch.software import software_of
from flangeye.plugin.registry import load_registry

OUTCOME = SessionOutcome(
    "verified", None, 75, 76, 1e-4, 9e-5, 2e-4, 1.2e-4, 2.1e-4, 1e-4, 5e-5, 1e-3, 41.7
)


def main(count: int) -> None:
    registry = load_registry()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "batch"
        request = Request("ur5_phoxi-m_simulated", repeat=count, out=out, report=False)
        for i, session in enumerate(plan(request, registry, software_of(registry))):
            path = out / session.id
            path.mkdir(parents=True)
            mark_finished(path, session.key, replace(OUTCOME, holdout_rms_m=1e-4 + 1e-9 * i))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        cpu, clock = time.process_time(), time.perf_counter()
        done = command.run_batch(request, registry, Console(file=io.StringIO()))
        assert done.known == count
        print(
            f"{count} finished sessions: {time.process_time() - cpu:.1f} s of the processor, "
            f"{time.perf_counter() - clock:.1f} s of the clock, "
            f"{(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024:.0f} MB more; "
            f"summary.html {(out / 'summary.html').stat().st_size / 1e6:.1f} MB, "
            f"sessions.parquet {(out / 'sessions.parquet').stat().st_size / 1e6:.1f} MB"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000)

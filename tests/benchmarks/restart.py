"""What a start of a batch costs whose sessions have all finished: python -m tests.benchmarks.restart [N]

Writes the rows that N finished sessions leave, starts the batch again and prints seconds of the
processor, seconds of the clock and the memory that came on top, for planning, looking, and the
tables. The sessions' own folders are not looked at.
"""

import io
import resource
import sys
import tempfile
import time
from dataclasses import replace
from itertools import islice
from pathlib import Path

from rich.console import Console

from flangeye.files.paths import storage_at
from flangeye.plugin.registry import Registry, load_registry
from flangeye.workflow import batch
from flangeye.workflow.batch import Request
from flangeye.workflow.batch.dataset import FILE_SESSIONS, Dataset, columns_of, row_of
from flangeye.workflow.batch.outcome import SessionOutcome
from flangeye.workflow.batch.plan import plan, software_of

OUTCOME = SessionOutcome(
    "verified", None, 75, 76, 1e-4, 9e-5, 2e-4, 1.2e-4, 2.1e-4, 1e-4, 5e-5, 1e-3, 41.7
)


def size(folder: Path) -> int:
    """Return the bytes of a folder's files."""
    return sum(path.stat().st_size for path in folder.iterdir())


def write_rows(request: Request, registry: Registry) -> None:
    """Write the rows of all sessions, five hundred at a time as workers do."""
    columns = columns_of({})
    dataset = Dataset(storage_at(str(request.out)), columns)
    sessions = enumerate(plan(request, registry, software_of(registry)))
    while some := list(islice(sessions, 500)):
        rows = [
            row_of(s, replace(OUTCOME, holdout_rms_m=1e-4 + 1e-9 * i), columns) for i, s in some
        ]
        dataset.write_part(some[0][0] // FILE_SESSIONS, some[0][1].number, rows)


def main(count: int) -> None:
    registry = load_registry()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "batch"
        request = Request("ur5_phoxi-m_simulated", repeat=count, out=str(out), report=False)
        write_rows(request, registry)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        cpu, clock = time.process_time(), time.perf_counter()
        done = batch.run_batch(request, registry, Console(file=io.StringIO()))
        assert done.known == count
        print(
            f"{count} finished sessions: {time.process_time() - cpu:.1f} s of the processor, "
            f"{time.perf_counter() - clock:.1f} s of the clock, "
            f"{(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024:.0f} MB more; "
            f"summary.html {(out / 'summary.html').stat().st_size / 1e6:.1f} MB, "
            f"sessions.parquet {size(out / 'sessions.parquet') / 1e6:.1f} MB"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000)

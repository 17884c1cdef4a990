"""What each stage costs, beside a named baseline in the same run: python -m tests.benchmarks

Prints seconds, points per second, what a call allocates at its peak, and the ratio to the
baseline. Seconds differ between machines; the ratios hold.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from rich.console import Console
from rich.table import Table

from tests.benchmarks.cases import CASES
from tests.benchmarks.measure import measure


def main() -> None:
    """Run every case and print a row for each."""
    table = Table("stage", "input", "seconds", "points/s", "peak MB", "baseline", "ratio", box=None)
    for name, case in CASES.items():
        stage, baseline = case()
        cost, base = measure(stage.call), measure(baseline.call)
        rate = f"{stage.points / cost.seconds / 1e6:.2f} M" if stage.points else ""
        table.add_row(
            name, stage.input, f"{cost.seconds:.4f}", rate, f"{cost.peak_mb:.0f}",
            f"{baseline.input}: {base.seconds * baseline.scale:.4f} s",
            f"{cost.seconds / (base.seconds * baseline.scale):.3f}",
        )  # fmt: skip
    Console(width=140).print(table)


if __name__ == "__main__":
    main()

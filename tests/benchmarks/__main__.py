"""What each stage costs, beside a named yardstick in the same run: python -m tests.benchmarks

Prints seconds of the processor, what a call allocates at its peak, and the ratio to the yardstick
beside the goal and the ratio kept in figures.json. Seconds differ between machines; ratios hold,
and one that is 30 % beyond the kept one is pointed out. Names choose cases; --keep keeps the
ratios found.

    python -m tests.benchmarks segment.flange fit.rim --keep
"""

import json
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from rich.console import Console
from rich.table import Table

from tests.benchmarks.cases import CASES, GOALS
from tests.benchmarks.measure import measure

KEPT = Path(__file__).with_name("figures.json")
BEYOND = 1.3
"""Times the kept ratio that are worth a word."""


def told(ratio: float, kept: float | None) -> str:
    """Return what to say of a ratio beside the kept one."""
    if kept is None:
        return "new"
    if ratio > BEYOND * kept:
        return f"{ratio / kept - 1:+.0%}: slower than it was"
    return f"{kept:.3g}"


def rows(names: list[str], kept: dict[str, float]) -> tuple[Table, dict[str, float]]:
    """Run cases; return a table with a row for each, and their ratios."""
    table = Table(
        "work", "input", "CPU s", "peak MB", "yardstick", "ratio", "goal", "kept", box=None
    )
    found = {}
    for name in names:
        pair = CASES[name]()
        if pair is None:
            continue
        work, yardstick = pair
        cost, base = measure(work.call), measure(yardstick.call)
        found[name] = cost.seconds / (base.seconds * yardstick.scale)
        table.add_row(
            name, work.input, f"{cost.seconds:.4f}", f"{cost.peak_mb:.0f}",
            f"{yardstick.input}: {base.seconds * yardstick.scale:.4f} s",
            f"{found[name]:.3g}", GOALS.get(name, ""), told(found[name], kept.get(name)),
        )  # fmt: skip
    return table, found


def main(words: list[str]) -> None:
    """Run the cases named, or all, and print a row for each."""
    names = [word for word in words if word != "--keep"] or list(CASES)
    if unknown := [name for name in names if name not in CASES]:
        raise SystemExit(f"no case {', '.join(unknown)}; known: {', '.join(CASES)}; or --keep")
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    table, found = rows(names, kept)
    Console(width=160).print(table)
    if "--keep" in words:
        ratios = {name: round(ratio, 4) for name, ratio in (kept | found).items()}
        KEPT.write_text(json.dumps(ratios, indent=2, sort_keys=True) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])

"""Welds in random worlds drawn wider than the envelope: was the torch ever beyond its bound?

    python -m tools.weld_worlds [--worlds 1000] [--first 0] [--workers 2]

Prints what was reported, the welds beyond their stated bound, and how often the 95 % band held.
"""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from typing import Annotated

import numpy as np
import typer

from flangeye_emulators.weld_world.worlds import Verdict, judged


def worlds(
    worlds: Annotated[int, typer.Option(help="How many.")] = 1000,
    first: Annotated[int, typer.Option(help="Seed of the first.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes.")] = 2,
) -> None:
    """Weld in each world and print what came of it."""
    with ProcessPoolExecutor(workers) as pool:
        verdicts = list(pool.map(judged, range(first, first + worlds), chunksize=4))
    for line in summary(verdicts):
        print(line)


def summary(verdicts: list[Verdict]) -> list[str]:
    """Return what came of all of them, for people."""
    done = [v for v in verdicts if v.done]
    welded = [v for v in verdicts if v.welded]
    silent = [v for v in welded if v.silent]
    lines = [
        f"{len(verdicts)} worlds: {len(done)} reported done, {len(welded) - len(done)} stopped "
        f"while welding; {len(silent)} of these beyond their stated bound"
    ]
    lines += [
        f"  world {v.seed}: {v.largest * 1e3:.2f} mm, {v.outside:.2f} times its bound"
        for v in silent
    ]
    if done:
        rms = np.array([v.rms for v in done]) * 1e3
        lines.append(
            f"95 % band held on {np.mean([v.inside for v in welded]):.1%} of what was welded, "
            f"{np.mean([v.inside for v in done]):.1%} where it was done"
        )
        lines.append(
            f"torch off the true seam where done, rms: median {np.median(rms):.3f} mm, "
            f"95 % below {np.quantile(rms, 0.95):.3f} mm; at most "
            f"{max(v.outside for v in done):.2f} of the stated bound, "
            f"{max(v.largest for v in done) * 1e3:.2f} mm anywhere"
        )
    reasons = Counter(_kind(v.outcome) for v in verdicts)
    return lines + [f"  {count:4d}  {reason}" for reason, count in reasons.most_common()]


def _kind(outcome: str) -> str:
    """Return a reason without its numbers."""
    return "".join("#" if c.isdigit() else c for c in outcome)[:70]


if __name__ == "__main__":
    typer.run(worlds)

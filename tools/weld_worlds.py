"""Welds in random worlds drawn wider than the envelope: was the torch ever beyond its bound?

    python -m tools.weld_worlds [--worlds 1000] [--first 0] [--workers 2] [--json]

Prints what was reported, the welds beyond their stated bound, and how often the 95 % band held; with
--json one line a world.
"""

from __future__ import annotations

import json
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from typing import Annotated

import numpy as np
import typer

from flangeye_emulators.weld_world.worlds import WorldScore, judged


def worlds(
    worlds: Annotated[int, typer.Option(help="How many.")] = 1000,
    first: Annotated[int, typer.Option(help="Seed of the first.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes.")] = 2,
    as_json: Annotated[bool, typer.Option("--json", help="One line of JSON a world.")] = False,
) -> None:
    """Weld in each world and print what came of it."""
    verdicts = []
    with ProcessPoolExecutor(workers) as pool:
        for verdict in pool.map(judged, range(first, first + worlds), chunksize=4):
            verdicts.append(verdict)
            if as_json:
                print(json.dumps(asdict(verdict)), flush=True)
    for line in () if as_json else summary(verdicts):
        print(line)


def summary(verdicts: list[WorldScore]) -> list[str]:
    """Return what came of all of them, for people."""
    count = Counter(v.status for v in verdicts)
    done = [v for v in verdicts if v.status == "done"]
    silent = [v for v in verdicts if v.silent]
    lines = [
        f"{len(verdicts)} worlds: {count['done']} done, {count['refused']} refused before the arc "
        f"was struck, {count['stopped']} stopped; {len(silent)} beyond their stated bound"
    ]
    lines += [
        f"  world {v.seed}: {v.largest * 1e3:.2f} mm, {v.over_bound:.2f} times its bound, {v.status}"
        for v in silent
    ]
    if done:
        rms, share = np.array([v.rms for v in done]) * 1e3, np.array([v.share_welded for v in done])
        lines += [
            f"95 % band held on {np.mean([v.inside for v in done]):.1%} of what was done",
            f"of the seam welded where done: at least {share.min():.1%}, in {np.mean(share < 0.99):.1%} "
            "of them less than 99 %",
            f"torch off the true seam where done, rms: median {np.median(rms):.3f} mm, "
            f"95 % below {np.quantile(rms, 0.95):.3f} mm; at most "
            f"{max(v.over_bound for v in done):.2f} of the stated bound, "
            f"{max(v.largest for v in done) * 1e3:.2f} mm anywhere",
        ]
    reasons = Counter((v.status, _kind(v.reason)) for v in verdicts)
    return lines + [
        f"  {count:4d}  {status}: {reason}" for (status, reason), count in reasons.most_common()
    ]


def _kind(outcome: str) -> str:
    """Return a reason without its numbers."""
    return "".join("#" if c.isdigit() else c for c in outcome)[:70]


if __name__ == "__main__":
    typer.run(worlds)

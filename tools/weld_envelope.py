"""Welds under every condition of the envelope, scored where the torch truly is.

python -m tools.weld_envelope [--seeds 3] [--only WORDS] [--out FILE.csv]
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from flangeye.errors import StageError
from tools.weld_bench import try_condition
from tools.weld_conditions import CONDITIONS, Condition
from tools.weld_trial import Trial

COLUMNS = ("condition", "welds", "rms mm", "largest mm", "done", "otherwise")


def table(
    seeds: Annotated[int, typer.Option(help="Welds under each condition.")] = 3,
    only: Annotated[str, typer.Option(help="Conditions whose name contains this.")] = "",
    out: Annotated[Path | None, typer.Option(help="Write it here too, as CSV.")] = None,
) -> None:
    """Print the table."""
    rows: list[tuple[str, ...]] = [COLUMNS]
    print("| " + " | ".join(COLUMNS) + " |\n" + "| --- " * len(COLUMNS) + "|")
    for name, condition in CONDITIONS.items():
        if only in name:
            rows.append(_row(name, condition, seeds))
            print("| " + " | ".join(rows[-1]) + " |")
            sys.stdout.flush()
    if out is not None:
        with out.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)


def _row(name: str, condition: Condition, seeds: int) -> tuple[str, ...]:
    try:
        trials = [try_condition(condition, seed) for seed in range(seeds)]
    except StageError as refusal:
        return name, str(seeds), "", "", "0", f"refused: {str(refusal).partition(': ')[2]}"
    rms, largest = _errors([trial for trial in trials if len(trial.errors)])
    reasons = dict.fromkeys(t.controller.reason or t.phases[-1] for t in trials if not t.done)
    return name, str(seeds), rms, largest, str(sum(t.done for t in trials)), "; ".join(reasons)


def _errors(welded: list[Trial]) -> tuple[str, str]:
    """Return rms and largest error of the welded part, also of a weld that stopped later."""
    if not welded:
        return "", ""
    errors = np.concatenate([trial.errors for trial in welded])
    return f"{np.sqrt(np.mean(errors**2)) * 1e3:.3f}", f"{errors.max() * 1e3:.2f}"


if __name__ == "__main__":
    typer.run(table)

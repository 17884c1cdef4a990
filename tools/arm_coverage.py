"""How often stated 95 % regions hold the truth: python -m tools.arm_coverage [--name NAME …]

Sessions of ``solve.robust`` with arms whose joints' zeros are so many times worse than their file
says, or as bad as real ones: 16 poses here and there, or 30 along a smooth path. Of every transform
of an answer: whether the true one lies in its region, and by what factor more is stated than true.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
import typer

from flangeye.errors import CalibrationRefused
from flangeye.maths.statistics import chi2_quantile
from flangeye_emulators.world.arm import ArmErrors
from tests.handeye.arms import REAL, drawn, solved, squares, worse
from tests.handeye.cells import CONFIGURATIONS, errors

ARMS = {**{f"{times} x": worse(times) for times in (1, 2, 3, 5, 10)}, "real": REAL}


def misses(name: str, arm: ArmErrors, seeds: range, smooth: bool, corrected: bool) -> np.ndarray:
    """Return (K, 3) squared distances in the regions' measure, stated and true variances."""
    configuration, offsets = CONFIGURATIONS[name], "auto" if corrected else "off"
    found = []
    for seed in seeds:
        seen, truth = drawn(configuration, seed, arm, n=30 if smooth else 16, smooth=smooth)
        try:
            told = solved(seen, configuration, joint_offsets=offsets)
        except (
            CalibrationRefused
        ):  # a path that turns about one axis; a size that is taken for wrong
            continue
        answer = told.as_corrected() if corrected else told
        if answer is None or (corrected and told.corrected is None):
            continue
        estimates = (answer.camera, *answer.others)
        for square, estimate, true in zip(squares(answer, truth), estimates, truth, strict=True):
            off = errors(estimate, true)[3:]
            found.append((square, np.trace(estimate.covariance[3:, 3:]), off @ off))
    return np.array(found)


def table(
    name: Annotated[list[str] | None, typer.Option(help="Which; all if not given.")] = None,
    arm: Annotated[list[str] | None, typer.Option(help="Which; all if not given.")] = None,
    sessions: int = 40,
    first: int = 0,
    smooth: bool = False,
    corrected: bool = False,
) -> None:
    """Print the table."""
    arms, limit = arm or list(ARMS), chi2_quantile(0.95, 6)
    print("| configuration | " + " | ".join(arms) + " |\n|---|" + "---|" * len(arms))
    for each in name or CONFIGURATIONS:
        cells = []
        for bad in arms:
            found = misses(each, ARMS[bad], range(first, first + sessions), smooth, corrected)
            if not len(found):
                cells.append("-")
                continue
            inside, (_, stated, true) = (found[:, 0] < limit).mean(), found.mean(axis=0)
            cells.append(f"{inside:.0%} of {len(found)}, {np.sqrt(stated / true):.1f}")
        print(f"| {each} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    typer.run(table)

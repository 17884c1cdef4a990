"""Compare the mixed model's errors with its stated covariance: python -m tools.estimator_table

Sessions come from a generator that shares no code with the project (tests/estimation/foreign.py):
UR5e and Panda in turn, with recorded joints or `--no-joints`. With `--mrad 0` each arm's quality is
drawn from the estimator's prior; only this row tests the coverage when the poses do not determine
the arm's quality. For the true and the reported camera pose, each against its own truth, the table
has: mean NEES over 6, share inside the stated 95 %, stated over true rms, and true rms over the box
[mm]; for circles also that of least squares on centres (SVD).
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import typer

from flangeye.estimation.effects.arm import QUALITY
from flangeye.maths.statistics import chi2_quantile
from tests.estimation import foreign
from tests.estimation.sessions import Score, robot, score


def row(kind: str, poses: int, mrad: float, seeds: range, joints: bool) -> str:
    """Return one row of the table."""
    arms = foreign.UR5E, foreign.PANDA
    each_arm = [(arms[seed % 2], seed) for seed in seeds]
    scores = [
        score(kind, arm, mrad * 1e-3 or _drawn(arm, seed), poses, seed, joints)
        for arm, seed in each_arm
    ]
    each = [_figures([getattr(s, answer) for s in scores]) for answer in ("true", "reported")]
    svd = 1e3 * np.sqrt(np.mean([s.svd for s in scores]))
    outliers = sum(s.outliers for s in scores)
    return f"| {kind} | {poses} | {mrad:g} | {each[0]} | {each[1]} | {svd:.3f} | {outliers} |"


def _drawn(arm: dict[str, Any], seed: int) -> float:
    """Return the standard deviation of joint zeros [rad] of an arm drawn from the prior."""
    model, _ = robot(arm["name"])
    times = np.random.default_rng(seed).standard_normal()
    return float(model.joint_accuracy * QUALITY**times)


def _figures(scores: list[Score]) -> str:
    nees, stated, true = np.array(scores).T
    inside = np.mean(nees < chi2_quantile(0.95, 6) / 6)
    width = np.sqrt(stated.mean() / true.mean())
    return f"{nees.mean():.2f}, {inside:.0%}, {width:.2f}, {1e3 * np.sqrt(true.mean()):.3f}"


def table(
    kind: Annotated[list[str] | None, typer.Option(help="marker, hand, flange, centres")] = None,
    poses: Annotated[list[int] | None, typer.Option(help="Poses of a session.")] = None,
    mrad: Annotated[list[float] | None, typer.Option(help="Deviation of joint zeros.")] = None,
    sessions: int = 40,
    first: int = 0,
    joints: bool = True,
) -> None:
    """Print the table."""
    print("| target | poses | mrad | true: NEES, in, width, rms | as reported | SVD | aside |")
    print("|---|---|---|---|---|---|---|")
    for each in kind or ["flange", "centres", "marker", "hand"]:
        for n in poses or [16, 30]:
            for size in mrad or [0.05, 0.3, 1.0, 3.0]:
                print(row(each, n, size, range(first, first + sessions), joints), flush=True)


if __name__ == "__main__":
    typer.run(table)

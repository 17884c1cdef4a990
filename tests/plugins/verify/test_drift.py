"""``verify.drift``: a later run against an earlier calibration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flangeye.types import HandEye, Pair
from flangeye.workflow.log.read import read_run
from flangeye_plugins.verify.drift import DriftParams, verify_drift
from tests.workflow.doctor.monitor.cell import calibrate


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return calibrate(tmp_path_factory.mktemp("drift") / "run")


def later(run: Path, shift: float) -> HandEye:
    """Return the same poses, seen by a scanner that is aside and nearer by ``shift`` [m]."""
    found = read_run(run / "run.mcap").calibration()
    assert found is not None
    rng, moved = np.random.default_rng(4), []
    for pair in found.pairs:
        circle = pair.observation.circle
        centre = circle.centre + shift * np.array([0.6, 0.0, 0.8]) + rng.normal(0, 5e-5, 3)
        observation = replace(pair.observation, feature=replace(circle, centre=centre))
        moved.append(Pair(observation, pair.residual))
    return replace(found, pairs=tuple(moved))


@pytest.mark.parametrize(("shift", "passed"), [(0.0, True), (1e-3, False)])
def test_a_cell_that_moved_is_refused(run: Path, shift: float, passed: bool) -> None:
    found = verify_drift(
        calibration=later(run, shift), params=DriftParams(reference=run / "run.mcap")
    )
    assert found.passed is passed
    if not passed:
        assert found.figures["shift"] == pytest.approx(1e-3, rel=0.25)
        said = f", by {1e3 * found.figures['shift']:.2f} mm at the work's worst corner"
        assert found.reason == f"the cell has moved since {run / 'run.mcap'}{said}"
        assert found.figures["turn"] < 4e-4, "it was shifted, not turned"
        assert found.advice.startswith("put the scanner back; or take verify.drift out")

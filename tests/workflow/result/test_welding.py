"""The torch of a simulated weld, held against the true seam."""

from __future__ import annotations

import numpy as np
import pytest

from flangeye.types import CAMERA, PointCloud, WeldReport, WorkpieceScan
from flangeye.workflow.result.sections import weld_result

SEAM = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
SCAN = WorkpieceScan(PointCloud(CAMERA, np.zeros((1, 3))), "test", truth={"groove": SEAM})


def report(arc_from: float) -> WeldReport:
    """A torch that comes from 1 mm aside and is on the seam from 30 mm on."""
    along = np.linspace(0.0, 0.1, 101)
    torch = np.column_stack([along, np.where(along < 0.03, 1e-3, 0.0), 0 * along])
    none = np.zeros(len(along))
    return WeldReport(
        "tactile", True, "", SEAM, SEAM, np.tile([0.0, 0.0, 1.0], (2, 1)), along, torch, torch, torch,
        none, none, none, none, along, ("following",) * len(along),
        figures={"arc_from": arc_from}, true_torch=torch,
    )  # fmt: skip


def test_a_torch_is_scored_from_where_it_was_lit() -> None:
    later, whole = (weld_result(report(lit), SCAN) for lit in (0.03, 0.0))
    assert later is not None and later.truth is not None
    assert later.truth.max == pytest.approx(0.0, abs=1e-9)
    assert whole is not None and whole.truth is not None
    assert whole.truth.max == pytest.approx(1e-3)


def test_a_torch_that_never_came_near_is_scored_everywhere() -> None:
    found = weld_result(report(-1.0), SCAN)
    assert found is not None and found.truth is not None
    assert found.truth.max == pytest.approx(1e-3)

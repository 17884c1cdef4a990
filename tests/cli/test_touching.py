"""``flangeye touch``: what it writes is what verify.touch judges, and its mistakes are one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from flangeye import types as t
from flangeye.cli import touching
from flangeye.cli.touching import touch_points
from flangeye.workflow.log.read import read_run
from flangeye_plugins.verify.touch import TouchParams, verify_touch
from tests.motion.test_touching import Cell, points


def test_the_step_it_writes_says_what_it_said(
    flangeye: Callable[..., Any],
    toy_recipe: Path,
    toy_registry: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert flangeye("run", toy_recipe, "--out", "run")[0] == 0
    calibration = read_run(tmp_path / "run").calibration()
    assert isinstance(calibration, t.HandEye)
    truth = points(Cell([]))
    wrong = np.array([0.8e-3, 0.0, 0.0])
    cell = Cell(list(truth))
    monkeypatch.setattr(touching, "_toucher", lambda recipe, tip, ask: cell.toucher())
    inverse = calibration.base_T_camera.transform.inverse()
    seen = [", ".join(f"{x!r} m" for x in inverse.apply(p).tolist()) for p in truth + wrong]
    given = (seen, "0 mm, 0 mm, 150 mm")
    run, out = tmp_path / "run", tmp_path / "touch.yaml"
    said = list(touch_points(run, toy_registry, given, True, print, out))
    assert (
        said[0].endswith("predicted is off by (+0.80, -0.00, +0.00), 0.80 mm") or "0.80" in said[0]
    )
    assert said[-1].startswith("largest error 0.80 mm; ")
    (step,) = yaml.safe_load(out.read_text())
    found = verify_touch(calibration, TouchParams(**step["verify.touch"]))
    assert found.figures["max"] == pytest.approx(0.8e-3, abs=2e-5)
    assert found.figures["x"] == pytest.approx(0.8e-3, abs=2e-5)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--seen", "1 mm, 2 mm", "--tip", "0 mm, 0 mm, 1 mm"),
         "--seen '1 mm, 2 mm': has 2 coordinates, not 3; write '12 mm, -40 mm, 702 mm'"),
        (("--seen", "1 mm, 2 mm, 3", "--tip", "0 mm, 0 mm, 1 mm"),
         "--seen '1 mm, 2 mm, 3': '3' has no unit: a length needs one (mm, m, um, for example "
         "'31.5 mm'); write '12 mm, -40 mm, 702 mm'"),
        (("--seen", "1 mm, 2 mm, 3 mm", "--tip", "0 mm, 0 mm, 1 mm"),
         "run.mcap: its recipe names no robot.driver with robot.limits, so no arm can be read; touch "
         "with the calibration of a live recipe, or write the step verify.touch with poses from the "
         "pendant ('flangeye stages verify.touch')"),
    ],
)  # fmt: skip
def test_what_cannot_be_touched_is_one_line(
    flangeye: Callable[..., Any], toy_recipe: Path, words: tuple[str, ...], line: str
) -> None:
    assert flangeye("run", toy_recipe, "--out", "run")[0] == 0
    assert flangeye("touch", "run", *words)[::2] == (2, f"error: {line}\n")

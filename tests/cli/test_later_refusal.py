"""A step that uses a calibration and refuses: the calibration is not what is blamed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from flangeye.errors import CalibrationRefused
from flangeye.files.paths import bundled
from flangeye.workflow.run.runner import Runner


def test_a_seam_that_is_not_there_is_no_fault_of_the_calibration(
    command: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    side = np.linspace(-0.1, 0.1, 60)
    flat = np.column_stack([np.repeat(side, 60), np.tile(side, 60), np.full(3600, 0.8)])
    np.savetxt(tmp_path / "plate.xyz", flat)
    recipe = bundled("recipes") / "ur5_phoxi-m_sample.yaml"
    told = yaml.safe_load(recipe.read_text())
    told["steps"][0]["acquire.archive"]["path"] = str(bundled("data") / "samples/ur5_phoxi-m")
    line = [["-400 mm", "-400 mm", "300 mm"], ["-350 mm", "-400 mm", "300 mm"]]
    told["steps"] += [
        {"scan.file": {"path": "plate.xyz", "unit": "m"}},
        {"seam.joint": {"joint": "vee", "line": line, "reach": "2 m"}},
    ]
    (tmp_path / "seam.yaml").write_text(yaml.safe_dump(told))
    code, out, _ = command("run", tmp_path / "seam.yaml", "--out", tmp_path / "run")
    last = out[out.index("What is wrong") :]
    assert code == 1 and "seam.joint: no vee joint within" in last
    assert "the calibration itself passed its verification" in last and "doctor" not in last
    assert "Next step         name the joint that is there (joint)" in last
    assert "--at scan.file" in " ".join(last[last.index("then ") :].split())


def test_a_verification_that_refuses_after_another_has_passed_is_told(
    command: Callable[..., tuple[int, str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = bundled("recipes") / "ur5_phoxi-m_sample.yaml"
    told = yaml.safe_load(recipe.read_text())
    told["steps"][0]["acquire.archive"]["path"] = str(bundled("data") / "samples/ur5_phoxi-m")
    told["steps"].append({"verify.holdout": {"max_rms": "9 mm"}})
    (tmp_path / "twice.yaml").write_text(yaml.safe_dump(told))
    call, last = Runner._call, len(told["steps"]) - 1

    def refusing(self: Runner, step: Any, *values: Any) -> Any:
        if step.index == last:
            raise CalibrationRefused("a fold fails", "add poses")
        return call(self, step, *values)

    monkeypatch.setattr(Runner, "_call", refusing)
    code, out, err = command("run", tmp_path / "twice.yaml", "--out", tmp_path / "run")
    assert code == 1 and "Traceback" not in err
    assert "What is wrong     a fold fails" in out and "Next step         add poses" in out

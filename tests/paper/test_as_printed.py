"""Algorithm 2 as printed: it diverges, in simulation, and no real arm can be led by it."""

from pathlib import Path as FilePath

import numpy as np
import pytest

from flangeye.devices import RobotDriver
from flangeye.errors import StageError
from flangeye.plugin.registry import load_registry
from flangeye.plugin.stage import BoundPart
from flangeye.testing import ControllerConformance
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.run.replay import replay_steps
from flangeye_paper.as_printed import controller_as_printed
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.resuming import task_of
from flangeye_plugins.weld.settings import Following
from tests.plugins.weld.bench import DISTANCE, curved, planning_error
from tests.plugins.weld.bench import run as run_bench
from tests.plugins.weld.cell import planned, run

MODE = BoundPart(controller_as_printed, None)


class TestAsPrinted(ControllerConformance):
    part = controller_as_printed


def test_it_diverges() -> None:
    true, settings = curved(), Following()
    plan = planning_error(true, seed=0)
    controller = MODE(task_of(Path(plan), DISTANCE, settings))
    done = run_bench(true, plan, controller, settings, longest=40.0)
    assert np.sqrt(np.mean(np.square(done.deviation(-0.03)))) > 5e-3


def test_it_does_not_run_on_a_real_arm() -> None:
    def never():
        raise AssertionError("opened")

    real = RobotDriver("robot.ur_rtde", never)
    with pytest.raises(StageError, match="known to diverge and runs on a simulated arm only"):
        run(planned("v-straight", end=0.06), driver=real, mode=MODE)


def test_its_weld_is_decided_again_from_its_log(tmp_path: FilePath) -> None:
    report, journal = run(planned("v-straight", end=0.04), mode=MODE)
    assert report.mode == "as_printed"
    recorder = Recorder(tmp_path / "run.mcap", {}, False)
    for name, value in journal:
        recorder.flangeye_noted(step="7.weld.tactile", name=name, value=value)
    recorder.close()
    ((_, again),) = replay_steps(tmp_path / "run.mcap", load_registry())
    assert again.same

"""A look behind the torch in a whole weld: steered by, logged, decided again, gone on with."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from flangeye.devices import DeviceError, WeldProfile
from flangeye.errors import StageError
from flangeye.plugin.registry import Lookup, load_registry
from flangeye.plugin.stage import BoundPart
from flangeye.types import Seed
from flangeye.workflow.run.replay import replay_steps
from flangeye_emulators.finger.profiler import SimulatedProfilerParams, profiler_simulated
from flangeye_emulators.weld_world.truth import ClockTruth, ProfilerTruth, ToolTruth, WeldTruth
from flangeye_plugins.weld.camera_process import CameraProcess
from flangeye_plugins.weld.finger_camera import CameraJob
from flangeye_plugins.weld.settings import WeldTactileParams
from tests.plugins.weld.cell import FINGER, planned, run
from tests.plugins.weld.test_camera_process import Camera, first_sight, state
from tests.plugins.weld.test_replay import logged
from tools.weld_bench import try_condition
from tools.weld_conditions import CONDITIONS, Condition

ASIDE = WeldTruth(tool=ToolTruth(torch=(0.0, 0.3e-3)), clock=ClockTruth(rate=15.0))
LOOK = BoundPart(profiler_simulated, SimulatedProfilerParams(behind="10 mm"))
SETTINGS = {"distortion": "0.15 mm", "max_error": "2 mm", "speed": "8 mm/s"}
SHORT = 0.09


@pytest.fixture(scope="module")
def weld() -> Any:
    return run(
        planned("v-straight", end=0.06), seed=3, sensor={"world": ASIDE}, profiler=LOOK, **SETTINGS
    )


def test_a_weld_is_led_by_what_is_seen_behind_its_torch(weld: Any) -> None:
    _, journal = weld
    looks = [value for name, value in journal if name == "profile"]
    seen = np.array([look["offset"] for look in looks])
    assert len(looks) > 30
    assert np.median(seen[:10]) == pytest.approx(0.3e-3, abs=0.05e-3)
    assert np.median(seen[-10:]) == pytest.approx(0.0, abs=0.12e-3)
    start = next(value for name, value in journal if name == "start")
    assert start["prior"]["behind"] == 0.01


def test_every_decision_is_repeated_from_the_log(weld: Any, tmp_path: Path) -> None:
    path = logged(weld[1], tmp_path / "run.mcap")
    ((_, redone),) = replay_steps(path, load_registry())
    assert redone.same
    assert max(redone.figures.values()) == 0.0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"mode": "vision"}, "'profiler' goes with mode: tactile only"),
        ({"passes": [{"across": "1 mm"}]}, "leave out 'passes'"),
        ({"weave_width": "2 mm"}, "leave out 'weave_width'"),
    ],
)
def test_what_a_look_does_not_go_with_is_refused(given: Any, message: str) -> None:
    told = {"sensor": {"opencv": {}}, "profiler": {"simulated": {}}, **given}
    with pytest.raises(ValidationError, match=message):
        WeldTactileParams.model_validate(told, context=Lookup(load_registry()))


def test_a_simulated_look_needs_a_simulated_weld() -> None:
    with pytest.raises(StageError, match=r"sees the weld of sensor.simulated_finger, not of stand"):
        LOOK(None, Camera(FINGER, state_source(), 0), 0)


def state_source() -> Any:
    return type("Arm", (), {"state": lambda self: state(1)})()


class Looker:
    """Sees the bead wherever the arm is said to be."""

    name, behind = "stand-in look", 0.02

    def __init__(self, robot: Any, sensor: Any, seed: Any) -> None:
        assert sensor.name == "stand-in camera"
        self._robot = robot

    def profile(self) -> Any:
        return WeldProfile(0.1e-3, 0.05e-3, self._robot.state().time_ns)

    def close(self) -> None:
        pass

    def __enter__(self) -> "Looker":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class LostLooker(Looker):
    """Is unplugged."""

    def profile(self) -> Any:
        raise DeviceError("stand-in look: has ended the connection")


def nobody(robot: Any, sensor: Any, seed: Any) -> Any:
    raise DeviceError("stand-in look: cannot be reached")


def job(look: Any) -> CameraJob:
    camera: Any = Camera
    return CameraJob(camera, FINGER, state(1), Seed(0), look)


def test_the_cameras_process_reads_the_look_too() -> None:
    with CameraProcess(job(Looker)) as camera:
        assert camera.behind == 0.02
        camera.tell(state(5))
        assert first_sight(camera).time_ns == 5
        looks: list[WeldProfile] = []
        while not (looks and looks[-1].time_ns == 5):
            looks += camera.profiles()
        assert looks[-1] == WeldProfile(0.1e-3, 0.05e-3, 5)


def test_a_look_that_is_lost_is_told() -> None:
    with (
        CameraProcess(job(LostLooker)) as camera,
        pytest.raises(DeviceError, match="stand-in look: has ended the connection"),
    ):
        first_sight(camera)


def test_a_look_that_cannot_be_opened_is_told() -> None:
    with pytest.raises(DeviceError, match="stand-in look: cannot be reached"):
        CameraProcess(job(nobody)).__enter__()


def late(trial: Any, beyond: float) -> Any:
    """The errors where the torch was so far along the seam [m]."""
    return trial.errors[trial.column("torch_s")[trial.beside] > beyond]


def test_heat_around_the_torch_is_made_up_for_once_it_was_seen() -> None:
    found = try_condition(
        CONDITIONS["heat: 1 mm around the torch, with a profiler behind"], 0, SHORT, 16e-3
    )
    assert found.done
    assert found.bounded
    assert found.errors.max() > 0.9e-3  # nothing is seen of the first 30 mm
    assert np.sqrt(np.mean(late(found, 0.05) ** 2)) < 0.1e-3


def test_a_torch_that_the_files_have_elsewhere_is_told() -> None:
    world = WeldTruth(tool=ToolTruth(torch=(0.0, 1.5e-3)))
    found = try_condition(Condition(world, look=ProfilerTruth()), 0, SHORT, 16e-3)
    assert not found.done
    assert "the profile sensor behind the torch sees the bead +1." in found.controller.reason
    assert "calibrate the tool" in found.controller.reason

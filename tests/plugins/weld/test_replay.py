"""A weld's log: decided again, and seen again."""

import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye.plugin.registry import load_registry
from flangeye.workflow.log.read import read_notes
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.run.replay import replay_steps
from flangeye_plugins.sensor import McapParams, sensor_mcap
from flangeye_plugins.weld.touch.tag_observation import TagDetector
from tests.plugins.weld.cell import FINGER, welded

STEP = "7.weld.tactile"


@pytest.fixture(scope="module")
def journal() -> Any:
    return welded()[1]


def logged(journal, path):
    recorder = Recorder(path, {}, False)
    for name, value in journal:
        recorder.flangeye_noted(step=STEP, name=name, value=value)
    recorder.close()
    return path


def test_the_same_commands_come_from_what_was_logged(journal: Any, tmp_path: Path) -> None:
    ((step, redone),) = replay_steps(logged(journal, tmp_path / "run.mcap"), load_registry())
    assert step == STEP
    assert redone.same
    assert max(redone.figures.values()) == 0.0
    cycles = sum(len(value["time"]) for name, value in journal if name == "cycles")
    images = sum(name == "sight" and value["number"] >= 0 for name, value in journal)
    assert redone.what == f"{cycles} cycles from {images} images"


def test_another_command_is_noticed(journal: Any, tmp_path: Path) -> None:
    changed = copy.deepcopy(journal[: len(journal) // 3])
    block = next(value for name, value in reversed(changed) if name == "cycles")
    block["turn"][0] += 1e-4
    ((_, redone),) = replay_steps(logged(changed, tmp_path / "run.mcap"), load_registry())
    assert not redone.same
    assert redone.figures["largest difference of a command [m/s, rad/s]"] == pytest.approx(1e-4)


def test_another_image_is_noticed(journal: Any, tmp_path: Path) -> None:
    changed = journal[: len(journal) // 3]
    images = [i for i, (name, _) in enumerate(changed) if name == "image"]
    changed[images[-1]], changed[images[12]] = changed[images[12]], changed[images[-1]]
    ((_, redone),) = replay_steps(logged(changed, tmp_path / "run.mcap"), load_registry())
    assert not redone.same


def test_a_log_that_was_torn_is_decided_as_far_as_it_goes(journal: Any, tmp_path: Path) -> None:
    path = logged(journal, tmp_path / "run.mcap")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    ((_, redone),) = replay_steps(path, load_registry())
    assert redone.same


def test_a_log_without_images_says_so(journal: Any, tmp_path: Path) -> None:
    without = [(name, value) for name, value in journal if name != "image"]
    with pytest.raises(StageError, match="holds no images"):
        list(replay_steps(logged(without, tmp_path / "run.mcap"), load_registry()))


def test_a_log_without_a_weld(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mcap", {"recipe.yaml": "title: T"}, False)
    recorder.flangeye_noted(step="0.acquire.live", name="where", value={"x": 1.0})
    recorder.close()
    with pytest.raises(StageError, match="holds no step whose decisions can be repeated"):
        list(replay_steps(tmp_path / "run.mcap", load_registry()))


def test_the_images_of_a_log_are_a_sensor(journal: Any, tmp_path: Path) -> None:
    path = logged(journal, tmp_path / "run.mcap")
    times = [note.value["time_ns"] for note in read_notes(path) if note.name == "sight"]
    clock = SimpleNamespace(now=10**12)
    states = SimpleNamespace(state=lambda: SimpleNamespace(time_ns=clock.now))
    with sensor_mcap.function(FINGER, states, 0, McapParams(path=path)) as sensor:
        first = sensor.frame()
        assert sensor.frame() is None
        clock.now += times[1] - times[0] + 1
        second = sensor.frame()
    assert second.time_ns - first.time_ns == pytest.approx(times[1] - times[0], abs=2)
    assert TagDetector(FINGER).find(second.image) is not None
    original = [value for name, value in journal if name == "image"][1].pixels
    column, row = [value["corner"] for name, value in journal if name == "sight"][1]
    height, width = original.shape
    assert width < second.image.pixels.shape[1]  # only what was read is in the log
    piece = second.image.pixels[row : row + height, column : column + width]
    np.testing.assert_array_equal(piece, original)

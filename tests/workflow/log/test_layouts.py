"""What other viewers are given: circles as points, the flanges in base, and a layout."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from flangeye import types as t
from flangeye.plugin.registry import Registry
from flangeye.workflow.log.foxglove import CLOUD_TOPICS, foxglove_layout, points_of
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.recipe.load import parse_recipe
from flangeye.workflow.run.folder import RunFolder
from flangeye.workflow.run.runner import Runner
from tests import toy
from tests.conftest import TOY_RECIPE


@pytest.fixture
def messages(toy_registry: Registry, tmp_path: Path) -> Any:
    """The decoded messages of a toy run, by topic."""
    recorder = Recorder(tmp_path / "run.mcap", {"recipe.yaml": TOY_RECIPE}, False)
    toy_registry.hooks.register(recorder)
    Runner(parse_recipe(TOY_RECIPE, "toy", toy_registry), toy_registry, t.ArchivePath()).run()
    toy_registry.hooks.unregister(recorder)
    found: dict[str, list[Any]] = {}
    with (tmp_path / "run.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, raw, message in reader.iter_decoded_messages(topics=list(CLOUD_TOPICS)):
            found.setdefault(channel.topic, []).append(message)
            assert raw.log_time > 0
    return found


def test_circles_are_points_too(messages: Any) -> None:
    assert len(messages["/circle"]) == 6
    points = points_of(messages["/circle"][0])
    assert messages["/circle"][0].frame_id == "camera"
    # A ring of 10 mm, as toy.fit says, and the normal behind it.
    centre = points[:360].mean(axis=0)
    assert np.allclose(np.linalg.norm(points[:361] - centre, axis=1), 0.01, atol=1e-5)


def test_the_flanges_are_in_base_once_solved(messages: Any) -> None:
    assert len(messages["/base/flanges"]) == 6
    seen = messages["/base/flanges"][0]
    assert seen.frame_id == "base"
    first = points_of(messages["/capture/cloud"][0])
    assert np.allclose(points_of(seen), toy.BASE_T_CAMERA.apply(first), atol=1e-3)


def test_a_foxglove_layout_shows_topics_that_are_logged(flangeye: Any, tmp_path: Path) -> None:
    assert flangeye("layout", "foxglove", "--out", tmp_path / "l.json")[0] == 0
    layout = json.loads((tmp_path / "l.json").read_text())
    shown = layout["configById"]["3D!cell"]["topics"]
    assert set(CLOUD_TOPICS) <= set(shown)
    named = json.dumps(layout["layout"])
    assert all(panel in named for panel in layout["configById"])


def test_foxgloves_own_classes_write_the_same_panels() -> None:
    """The maker's typed configurations know each setting by the name and the kind we write."""
    fox = pytest.importorskip("foxglove.layouts", reason="foxglove-sdk is not installed")
    clouds = {
        t: fox.BaseRendererPointCloudTopicSettings(visible=True, point_size=2) for t in CLOUD_TOPICS
    }
    shapes = fox.BaseRendererSceneUpdateTopicSettings(visible=True)
    pose = fox.BaseRendererPoseTopicSettings(visible=True)
    topics = clouds | {"/scene": shapes, "/seam": shapes, "/pose": pose}
    camera = fox.ImageModeConfig(image_topic="/capture/image")
    theirs = {
        "3D!cell": fox.ThreeDeeConfig(follow_tf="base", topics=topics),
        "Image!camera": fox.ImageConfig(image_mode=camera),
        "RosOut!log": fox.LogConfig(min_log_level=2),
        "RawMessages!rejected": fox.RawMessagesConfig(topic_path="/rejection"),
    }
    ours = json.loads(foxglove_layout())["configById"]
    assert set(ours) == set(theirs)
    assert all(_within(ours[panel], json.loads(theirs[panel].to_json())) for panel in ours)


def _within(ours: Any, theirs: Any) -> bool:
    """Return whether every setting is among theirs, which state defaults beside."""
    if not isinstance(ours, dict):
        return bool(ours == theirs)
    return ours.keys() <= theirs.keys() and all(_within(ours[name], theirs[name]) for name in ours)


def test_a_rerun_blueprint_is_written(flangeye: Any, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    assert flangeye("layout", "rerun", "--out", tmp_path / "l.rbl")[0] == 0
    assert (tmp_path / "l.rbl").read_bytes()[:4] == b"RRF2"
    words = [sys.executable, "-m", "rerun", "rrd", "verify", str(tmp_path / "l.rbl")]
    home = os.environ | {"HOME": str(tmp_path), "RERUN_ANALYTICS": "0"}
    read = subprocess.run(words, capture_output=True, text=True, env=home)
    assert (read.returncode, "1 file verified without error" in read.stderr) == (0, True)


def test_a_rerun_blueprint_is_that_of_the_logs_name(tmp_path: Path) -> None:
    """Rerun takes a log's file name for its application, and a layout of another is not used."""
    assert RunFolder(tmp_path).log.stem == "run"


def test_another_viewer_is_not_known(flangeye: Any) -> None:
    code, _, err = flangeye("layout", "rviz")
    assert (code, err) == (2, "error: no layout for 'rviz'; known: foxglove, rerun\n")

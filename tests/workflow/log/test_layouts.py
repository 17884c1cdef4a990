"""What other viewers are given: circles as points, the flanges in base, and a layout."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from flangeye import types as t
from flangeye.plugin.registry import Registry
from flangeye.types.geometry import rigid, rotation_from_rpy
from flangeye.workflow.log.foxglove import (
    CLOUD_TOPICS,
    circle_points,
    circle_scene,
    compressed_image,
    foxglove_layout,
    point_cloud,
    points_of,
    seam_poses,
    seam_scene,
    write_rerun_blueprint,
)
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


def flanges_in_base(recorder: Recorder, camera: t.Transform, log: Path) -> list[np.ndarray]:
    """End a run that found a camera there, and return the flanges' points that its log shows."""
    estimate = t.TransformEstimate(camera, 1e-8 * np.eye(6), np.zeros(3))
    recorder.flangeye_stage_finished("3.solve.toy", None, t.HandEye(estimate, (), "toy"), 0.1)
    recorder.flangeye_run_finished({})
    with log.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        logged = list(reader.iter_decoded_messages(topics=["/base/flanges"], log_time_order=False))
    return [points_of(message) for _, _, _, message in logged]


def test_what_a_camera_on_the_arm_sees_is_in_base_by_the_arm_s_pose(tmp_path: Path) -> None:
    places = [t.Transform(t.BASE, t.FLANGE, rigid(rotation_from_rpy(0.1 * k, 0.0, 1.0), [k, 0, 1]))
              for k in (0.0, 1.0)]  # fmt: skip
    carried = t.Transform(t.FLANGE, t.CAMERA, rigid(rotation_from_rpy(0.0, 0.3, 0.0), [0, 0.1, 0]))
    xyz = np.eye(3, dtype=np.float32)
    recorder = Recorder(tmp_path / "run.mcap", {"recipe.yaml": "title: T"}, False)
    for number, pose in enumerate(places):
        cloud, name = t.PointCloud(t.CAMERA, xyz), str(number)
        recorder.flangeye_captured("0.acquire", t.Capture(name, cloud, t.by_frame(pose)), 0.1)
        seen = t.FlangeCloud(cloud, np.zeros(3), np.array([0.0, 0.0, -1.0]))
        recorder.flangeye_stage_finished("1.segment.toy", name, seen, 0.1)
    shown = flanges_in_base(recorder, carried, tmp_path / "run.mcap")
    for points, pose in zip(shown, places, strict=True):
        np.testing.assert_allclose(points, (pose @ carried).apply(xyz), atol=1e-6)


def test_a_small_grid_of_points_is_shown_whole(tmp_path: Path) -> None:
    grid = np.arange(60, dtype=np.float32).reshape(4, 5, 3)
    recorder = Recorder(tmp_path / "run.mcap", {}, False)
    pose = t.by_frame(t.Transform(t.BASE, t.FLANGE, np.eye(4)))
    recorder.flangeye_captured("0", t.Capture("0", t.PointCloud(t.CAMERA, grid), pose), 0.1)
    recorder.flangeye_run_finished({})
    with (tmp_path / "run.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        ((_, _, _, shown),) = reader.iter_decoded_messages(topics=["/capture/cloud"])
    np.testing.assert_array_equal(points_of(shown), grid.reshape(20, 3))


def test_of_each_flange_in_base_four_thousand_points_are_shown(tmp_path: Path) -> None:
    place = t.Transform(t.BASE, t.CAMERA, np.eye(4))
    recorder = Recorder(tmp_path / "run.mcap", {"recipe.yaml": "title: T"}, False)
    for points in (4_000, 4_001, 8_000):
        cloud, name = t.PointCloud(t.CAMERA, np.ones((points, 3), np.float32)), str(points)
        seen = t.FlangeCloud(cloud, np.zeros(3), np.array([0.0, 0.0, -1.0]))
        recorder.flangeye_stage_finished("1.segment.toy", name, seen, 0.1)
    shown = flanges_in_base(recorder, place, tmp_path / "run.mcap")
    assert [len(points) for points in shown] == [4_000, 2_001, 4_000]


def test_a_foxglove_layout_shows_topics_that_are_logged(flangeye: Any, tmp_path: Path) -> None:
    assert flangeye("layout", "foxglove", "--out", tmp_path / "l.json")[0] == 0
    layout = json.loads((tmp_path / "l.json").read_text())
    shown = layout["configById"]["3D!cell"]["topics"]
    assert set(CLOUD_TOPICS) <= set(shown)
    named = json.dumps(layout["layout"])
    assert all(panel in named for panel in layout["configById"])
    # Most of the window is the cell's; beside it the image has a little less than the messages
    shares = layout["layout"]["splitPercentage"], layout["layout"]["second"]["splitPercentage"]
    assert shares == (65, 45) and layout["playbackConfig"] == {"speed": 1}
    assert (tmp_path / "l.json").read_text().startswith('{\n  "')


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


def test_in_rerun_the_cell_is_twice_as_wide_as_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rrb = pytest.importorskip("rerun.blueprint", reason="rerun-sdk is not installed")
    made, plain = list[Any](), rrb.Horizontal

    def beside(*views: Any, **how: Any) -> Any:
        made.append(how)
        return plain(*views, **how)

    monkeypatch.setattr(rrb, "Horizontal", beside)
    write_rerun_blueprint(tmp_path / "l.rbl")
    assert made == [{"column_shares": [2, 1]}]


def test_a_rerun_blueprint_is_that_of_the_logs_name(tmp_path: Path) -> None:
    """Rerun takes a log's file name for its application, and a layout of another is not used."""
    assert RunFolder(tmp_path).log.stem == "run"


def test_another_viewer_is_not_known(flangeye: Any) -> None:
    code, _, err = flangeye("layout", "rviz")
    assert (code, err) == (2, "error: no layout for 'rviz'; known: foxglove, rerun\n")


# --- what is drawn, by numbers --------------------------------------------------------------------

NORMAL = np.array([0.0, 0.6, -0.8])
CIRCLE = t.CircleFeature(
    np.array([0.1, 0.2, 0.9]), NORMAL, {"rim": 0.03, "bore": 0.016},
    1e-8 * np.eye(3), 1e-8 * np.eye(3), 1.0,
)  # fmt: skip
SEAM = t.Seam(
    np.array([[0.5, 0.0, 0.1], [0.5, 0.2, 0.1], [0.5, 0.4, 0.1]]), np.tile([0.0, 0.0, 1.0], (3, 1)),
    1e-8 * np.tile(np.eye(3), (3, 1, 1)),
)  # fmt: skip


def drawn(update: Any, frame: str) -> list[Any]:
    """Return the lines (N, 3) of a scene in a frame, after a look at how they are shown.

    Circles are orange and seams are blue: whoever sees no red or no green tells them apart.
    """
    colour = {"camera": (0.9, 0.3, 0.1), "base": (0.0, 0.45, 0.7)}[frame]
    (entity,) = update.entities
    assert (entity.frame_id, entity.timestamp.ToNanoseconds()) == (frame, 5)
    for line in entity.lines:
        assert line.scale_invariant and line.color.a == 1.0
        assert (line.color.r, line.color.g, line.color.b) == pytest.approx(colour, abs=1e-6)
        assert line.pose.orientation.w == 1.0
    return [np.array([[p.x, p.y, p.z] for p in line.points]) for line in entity.lines]


def require_ring(ring: Any, centre: Any, axis: Any, radius: float, points: int) -> None:
    """Check that points lie evenly on a whole circle, the last of them on the first."""
    out, steps = ring - centre, np.linalg.norm(np.diff(ring, axis=0), axis=1)
    np.testing.assert_allclose(out @ axis, 0.0, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), radius, atol=1e-7)
    np.testing.assert_allclose(steps, 2 * radius * np.sin(np.pi / (points - 1)), atol=1e-6)
    np.testing.assert_allclose(ring[0], ring[-1], atol=1e-7)


def test_a_circle_is_drawn_as_a_ring_for_each_radius_and_three_centimetres_of_its_normal() -> None:
    assert circle_scene("7", CIRCLE, 5).entities[0].id == "circle/7"
    rim, bore, normal = drawn(circle_scene("7", CIRCLE, 5), "camera")
    assert [line.thickness for line in circle_scene("7", CIRCLE, 5).entities[0].lines] == 3 * [2.0]
    for ring, radius in ((rim, 0.03), (bore, 0.016)):
        require_ring(ring, CIRCLE.centre, NORMAL, radius, 73)
    np.testing.assert_allclose(normal[0], CIRCLE.centre)
    np.testing.assert_allclose(normal[1] - normal[0], 0.03 * NORMAL, atol=1e-12)


def test_a_circle_s_points_are_dense_and_without_a_normal_its_centre_alone() -> None:
    points = points_of(circle_points(CIRCLE, 5))
    require_ring(points[:361], CIRCLE.centre, NORMAL, 0.03, 361)
    require_ring(points[361:722], CIRCLE.centre, NORMAL, 0.016, 361)
    assert len(points) == 724
    bare = replace(CIRCLE, normal=None, normal_covariance=None)
    np.testing.assert_allclose(points_of(circle_points(bare, 5)), CIRCLE.centre[None], atol=1e-7)


def test_a_seam_is_drawn_with_rings_about_it_and_its_poses_lead_along_and_into_the_groove() -> None:
    line, *rings = drawn(seam_scene(SEAM, 5), "base")
    thick = [each.thickness for each in seam_scene(SEAM, 5).entities[0].lines]
    assert thick == [3.0, 1.0, 1.0, 1.0]
    np.testing.assert_allclose(line, SEAM.points_in_base)
    assert [round(float(ring[:, 1].mean()), 9) for ring in rings] == [0.0, 0.2, 0.4]
    poses = seam_poses(SEAM, 5)
    assert (poses.frame_id, poses.timestamp.ToNanoseconds()) == ("base", 5)
    for pose, point in zip(poses.poses, SEAM.points_in_base, strict=True):
        at, q = pose.position, pose.orientation
        assert [at.x, at.y, at.z] == point.tolist()
        turn = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        np.testing.assert_allclose(turn[:, [0, 2]].T, [[0, 1, 0], [0, 0, -1]], atol=1e-9)


def test_a_cloud_s_points_stand_in_its_frame_as_three_floats_each() -> None:
    xyz = np.arange(12, dtype=np.float32).reshape(4, 3)
    message = point_cloud(t.PointCloud("camera", xyz), xyz, 5)
    layout: Any = {
        "names": [each.name for each in message.fields],
        "formats": ["<f4"] * 3,
        "offsets": [each.offset for each in message.fields],
        "itemsize": message.point_stride,
    }
    read: Any = np.frombuffer(message.data, np.dtype(layout))
    assert [read[name].tolist() for name in "xyz"] == xyz.T.tolist()
    assert (message.frame_id, message.pose.orientation.w) == ("camera", 1.0)


@pytest.mark.parametrize("shape", [(4, 5), (4, 5, 3)])
def test_an_image_is_logged_without_loss_and_in_its_own_colours(shape: Any) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    message = compressed_image(t.Image(pixels, np.eye(3)), 5)
    read: Any = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert (message.format, message.timestamp.ToNanoseconds()) == ("png", 5)
    np.testing.assert_array_equal(read if read.ndim == 2 else read[..., ::-1], pixels)

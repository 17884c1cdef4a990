"""The log survives: a killed run, a damaged file, a full disk."""

import errno
import io
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.reader import make_reader

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.workflow.log.read import RunLog, log_of, read_notes, read_run
from flangeye.workflow.log.record import Recorder, adapter
from tests.crafted import rewritten

CIRCLE = t.CircleFeature(
    np.array([0.1, 0.2, 0.7]), np.array([0, 0, -1.0]), {"rim": 0.03}, np.eye(3), np.eye(3), 0.9
)
CAPTURE = t.Capture(
    "a",
    t.PointCloud(t.CAMERA, np.arange(12, dtype=np.float32).reshape(4, 3)),
    t.by_frame(t.Transform(t.BASE, t.FLANGE, np.eye(4))),
    np.array([0.1, 0.2]),
)


def recorded(path, full=True):
    recorder = Recorder(path, {"recipe.yaml": "title: T"}, full)
    recorder.flangeye_run_started(t.Source("hash", ("a note",)), 2)
    recorder.flangeye_captured("0.acquire.toy", CAPTURE, 0.1)
    recorder.flangeye_stage_finished("2.fit.toy", "a", CIRCLE, 0.2)
    recorder.flangeye_capture_finished("a")
    recorder.flangeye_capture_rejected(t.Rejection("b", "fit.toy", "too dark"))
    return recorder


def test_what_is_written_is_read(tmp_path: Path) -> None:
    recorder = recorded(tmp_path / "r.mcap")
    recorder.flangeye_run_finished({"status": "verified"})
    log = read_run(tmp_path / "r.mcap")
    assert log.complete
    assert log.result == {"status": "verified"}
    assert log.attachments["recipe.yaml"] == b"title: T"
    assert (log.source.fingerprint, log.source.notes, log.total) == ("hash", ["a note"], 2)
    assert log.messages == ["a note", "b set aside by fit.toy: too dark"]
    assert [(r.id, r.stage, r.reason) for r in log.rejections] == [("b", "fit.toy", "too dark")]
    (capture,) = log.captures()
    assert np.array_equal(capture.cloud.xyz, CAPTURE.cloud.xyz)
    assert np.array_equal(np.asarray(capture.joints), np.asarray(CAPTURE.joints))
    (entry,) = log.entries
    assert (entry.step, entry.stage, entry.kind, entry.capture) == (
        "2.fit.toy", "fit.toy", "fit", "a",
    )  # fmt: skip
    assert np.array_equal(entry.value.centre, CIRCLE.centre)
    assert log.given("fit.toy") is entry.value and log.given("solve.toy") is None


@pytest.mark.parametrize("what", ["poses", "entries", "rejections"])
def test_a_log_with_any_one_capture_value_or_rejection_has_gathered(what: str) -> None:
    log = RunLog(Path("r.mcap"))
    with pytest.raises(StageError, match=r"^r.mcap: the run ended early; no capture was recorded$"):
        log.require_gathered()
    some: Any = {"a": {}} if what == "poses" else ["a"]
    assert replace(log, **{what: some}).gathered
    replace(log, **{what: some}).require_gathered()


def test_a_log_knows_its_recipe_its_last_joints_and_whether_its_scans_are_whole(
    tmp_path: Path,
) -> None:
    nothing = RunLog(tmp_path / "r.mcap")
    assert (nothing.has_recipe, nothing.last_joints, nothing.has_full_clouds) == (
        False,
        None,
        False,
    )
    for full in (True, False):
        recorder = recorded(tmp_path / "r.mcap", full)
        second = replace(CAPTURE, id="b", joints=np.array([0.3, 0.4]))
        recorder.flangeye_captured("0.acquire.toy", second, 0.1)
        recorder.close()
        log = read_run(tmp_path / "r.mcap")
        assert log.has_recipe and log.has_full_clouds is full
        assert log.last_joints.tolist() == [0.3, 0.4]
        (tmp_path / "r.mcap").unlink()


def test_what_steps_noted_comes_back_as_data_and_as_pixels(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (4, 5, 3), np.uint8)
    recorder = Recorder(tmp_path / "r.mcap", {}, False)
    recorder.flangeye_noted("7.weld.tactile", "depth", {"mm": 1.5})
    recorder.flangeye_noted("7.weld.tactile", "seen", t.Image(pixels, np.eye(3)))
    recorder.flangeye_noted("0.acquire.live", "next", {"id": "4"})
    recorder.close()
    depth, seen, after = read_notes(tmp_path / "r.mcap")
    assert (depth.step, depth.name, depth.value) == ("7.weld.tactile", "depth", {"mm": 1.5})
    assert (seen.step, seen.name) == ("7.weld.tactile", "seen")
    np.testing.assert_array_equal(seen.value, pixels)
    (only,) = read_notes(tmp_path / "r.mcap", {"0.acquire.live"})
    assert only == after and only.value == {"id": "4"}
    assert read_run(tmp_path / "r.mcap").noted == {"7.weld.tactile", "0.acquire.live"}


def test_a_run_is_named_by_its_folder_or_by_any_file_in_it(tmp_path: Path) -> None:
    log, report = tmp_path / "run.mcap", tmp_path / "report.html"
    assert log_of(report) == report  # there is no log beside it
    log.write_bytes(b"")
    assert [log_of(path) for path in (tmp_path, log, report)] == [log, log, log]
    assert log_of(tmp_path / "poses.csv") == tmp_path / "poses.csv"


def test_names_that_are_no_utf_8_are_written_out_or_replaced(tmp_path: Path) -> None:
    """Python stands half a UTF-16 pair in for such a byte of a folder's or file's name."""
    recorder = Recorder(tmp_path / "r.mcap", {"recipe.yaml": "archive: a\udcff"}, True)
    recorder.flangeye_run_started(t.Source("hash", ("archive a\udcff",)), 0)
    recorder.flangeye_run_finished({"status": "verified", "notes": ["archive a\udcff"]})
    log = read_run(tmp_path / "r.mcap")
    assert log.messages == ["archive a\\udcff"]
    assert log.attachments["recipe.yaml"] == b"archive: a?"
    assert log.complete and not log.damage


@pytest.mark.parametrize("codec", ["lz4", "zstd"])
def test_a_log_whose_chunks_were_packed_is_read_alike(tmp_path: Path, codec: str) -> None:
    recorded(tmp_path / "r.mcap").flangeye_run_finished({"status": "verified"})
    same = rewritten(tmp_path / "r.mcap", tmp_path / "p.mcap", lambda n, d: (n, d), codec=codec)
    log = read_run(same)
    assert (log.complete, log.damage, log.result) == (True, [], {"status": "verified"})
    (capture,) = log.captures()
    assert np.array_equal(capture.cloud.xyz, CAPTURE.cloud.xyz)


@pytest.mark.parametrize("shape", [(30, 40), (30, 40, 3)])
def test_an_image_is_a_png_in_the_log_and_comes_back_bit_for_bit(
    tmp_path: Path, shape: tuple[Any, ...]
) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    matrix = np.array([[500.0, 0, 20], [0, 501, 15], [0, 0, 1]])
    image = t.Image(pixels, matrix, np.array([-0.1, 0.01]))
    nothing = t.PointCloud(t.CAMERA, np.zeros((0, 3), np.float32))
    second = t.Transform(t.BASE2, t.FLANGE2, np.eye(4))
    seen = replace(
        CAPTURE, image=image, cloud=nothing, poses=t.by_frame(CAPTURE.base_T_flange, second)
    )
    recorder = Recorder(tmp_path / "r.mcap", {}, full_clouds=False)
    recorder.flangeye_run_started(t.Source("hash"), 2)
    recorder.flangeye_captured("0.acquire.toy", seen, 0.1)
    recorder.flangeye_captured("0.acquire.toy", replace(CAPTURE, id="b"), 0.1)
    recorder.close()
    log = read_run(tmp_path / "r.mcap")
    assert set(log.poses["a"]["image"]) == {
        "camera_matrix", "distortion", "camera_covariance"
    }  # fmt: skip
    assert log.poses["a"]["full"]  # an image without a cloud is whole
    first, other = log.captures()
    assert np.array_equal(first.image.pixels, pixels)
    assert np.array_equal(first.image.camera_matrix, matrix)
    assert np.array_equal(first.image.distortion, image.distortion)
    assert first.poses["flange2"].name == "base2_T_flange2"
    assert other.image is None


def test_viewers_find_foxglove_schemas_and_frames(tmp_path: Path) -> None:
    recorder = recorded(tmp_path / "r.mcap")
    recorder.flangeye_run_finished({})
    with (tmp_path / "r.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    schemas = {(s.name, s.encoding) for s in summary.schemas.values()}
    assert {
        ("foxglove.PointCloud", "protobuf"), ("foxglove.PoseInFrame", "protobuf"),
        ("foxglove.FrameTransform", "protobuf"), ("foxglove.SceneUpdate", "protobuf"),
        ("foxglove.Log", "protobuf"), ("flangeye.CircleFeature", "jsonschema"),
    } <= schemas  # fmt: skip


@pytest.mark.parametrize("full", [True, False])
def test_whole_scans_are_kept_where_they_are_asked_for(tmp_path: Path, full: bool) -> None:
    recorded(tmp_path / "r.mcap", full).flangeye_run_finished({})
    with (tmp_path / "r.mcap").open("rb") as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    assert "/capture/cloud" in topics
    assert ("/capture/scan" in topics) == full


@pytest.mark.parametrize(
    ("count", "told"),
    [(1, ""), (2, " (and 1 more)"), (10, " (and 9 more)"), (11, " (and 10 more)"),
     (12, " (and 11 more)")],
)  # fmt: skip
def test_how_much_is_damaged_is_said(count: int, told: str) -> None:
    log = RunLog(Path("r.mcap"))
    log.require_sound()
    log.damage += map(str, range(count))
    with pytest.raises(StageError) as error:
        log.require_sound()
    said = "r.mcap: damaged: 0; kept: 0 captures, 0 values of steps"
    assert str(error.value) == said + told
    assert log.notes[0] == said
    left = max(0, count - 10)
    assert log.notes[10:] == [f"r.mcap: damaged: and {left} more"] * (left > 0)


@pytest.mark.parametrize("keep", [0.2, 0.5, 0.8, 0.99])
def test_a_cut_file_is_read_as_far_as_it_goes(tmp_path: Path, keep: float) -> None:
    path = tmp_path / "r.mcap"
    recorded(path).flangeye_run_finished({})
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])
    log = read_run(path)
    assert not log.complete


@given(st.integers(0, 2_000), st.binary(min_size=1, max_size=40))
def test_a_damaged_file_never_raises_anything_else(
    tmp_path_factory: pytest.TempPathFactory, at: int, junk: bytes
) -> None:
    path = tmp_path_factory.mktemp("d") / "r.mcap"
    recorded(path).flangeye_run_finished({})
    data = bytearray(path.read_bytes())
    data[at : at + len(junk)] = junk
    path.write_bytes(data)
    try:
        read_run(path)
    except StageError as error:
        assert str(path) in str(error)


def test_what_is_no_log_is_said(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="none.mcap: cannot be read: No such file"):
        read_run(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("hello, this is not a log at all")
    with pytest.raises(StageError, match=r"text.mcap: is not an MCAP file"):
        read_run(tmp_path / "text.mcap")
    (tmp_path / "empty.mcap").write_bytes(b"")
    assert not read_run(tmp_path / "empty.mcap").gathered


def test_a_log_that_cannot_be_read_to_its_end_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken(io.BytesIO):
        def read(self, size: int | None = -1) -> bytes:
            raise OSError(errno.EIO, "Input/output error")

    recorded(tmp_path / "r.mcap").close()
    monkeypatch.setattr("flangeye.workflow.log.read.open_regular", lambda path: Broken())
    with pytest.raises(StageError, match=r"r.mcap: cannot be read: Input/output error$"):
        read_run(tmp_path / "r.mcap")


def test_a_result_is_text_for_people(tmp_path: Path) -> None:
    recorded(tmp_path / "r.mcap").flangeye_run_finished({"status": "verified", "of": "Größe"})
    told = read_run(tmp_path / "r.mcap").text("result.json")
    assert told == '{\n  "status": "verified",\n  "of": "Größe"\n}\n'


def test_where_a_capture_shows_a_marker_viewers_are_told_and_not_where_it_shows_none(
    tmp_path: Path,
) -> None:
    marker = t.PoseFeature(t.Transform(t.CAMERA, t.TARGET, np.eye(4)), np.eye(6))
    recorder = Recorder(tmp_path / "r.mcap", {}, False)
    for capture in ("a", None):
        recorder.flangeye_stage_finished("2.fit.toy", capture, marker, 0.2)
        recorder.flangeye_stage_finished("2.fit.toy", capture, CIRCLE, 0.2)
    recorder.flangeye_run_finished({})
    with (tmp_path / "r.mcap").open("rb") as file:
        topics = [channel.topic for _, channel, _ in make_reader(file).iter_messages()]
    assert [topics.count(each) for each in ("/tf", "/scene", "/circle")] == [1, 1, 1]


def test_a_capture_that_cannot_be_read_is_set_aside_by_the_stage_that_took_it(
    tmp_path: Path,
) -> None:
    recorded(tmp_path / "r.mcap").close()
    log = read_run(tmp_path / "r.mcap")
    log.poses["a"]["shape"] = [5, 3]  # of four points
    (told,) = log.readings()
    assert isinstance(told, t.Rejection)
    assert (told.id, told.stage) == ("a", "acquire.toy")


@given(arrays(np.float64, (3, 3), elements=st.floats(-1e9, 1e9)), st.floats(0, 1))
def test_values_are_lossless(covariance: Any, coverage: float) -> None:
    circle = t.CircleFeature(
        covariance[0], np.array([0, 0, -1.0]), {"rim": coverage}, covariance, np.eye(3), coverage
    )
    again = adapter(t.CircleFeature).validate_json(adapter(t.CircleFeature).dump_json(circle))
    assert np.array_equal(again.covariance, circle.covariance)
    assert again.radii == circle.radii


def test_kill_minus_nine_loses_nothing_that_was_finished(tmp_path: Path, toy_recipe: Path) -> None:
    script = f"""
import sys, time
sys.path.insert(0, {str(Path(__file__).parents[3])!r})
from pathlib import Path
from tests.conftest import _registry_with
from tests import toy
from flangeye import types as t
from flangeye.workflow.recipe.load import load_recipe
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.run.runner import Runner
plain = toy.segment.function
def slow(capture):
    time.sleep(0.3 if capture.id >= "003" else 0)
    return plain(capture)
object.__setattr__(toy.segment, "function", slow)
registry = _registry_with(("toy", toy))
recipe = load_recipe(Path({str(toy_recipe)!r}), registry)
registry.hooks.register(Recorder(Path({str(tmp_path / "run.mcap")!r}), {{}}, True))
Runner(recipe, registry, t.ArchivePath()).run()
"""
    process = subprocess.Popen([sys.executable, "-c", script])
    log = None
    for _ in range(400):
        time.sleep(0.05)
        if (tmp_path / "run.mcap").exists() and (tmp_path / "run.mcap").stat().st_size:
            log = read_run(tmp_path / "run.mcap")
            if len(log.finished) >= 3:
                break
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    log = read_run(tmp_path / "run.mcap")
    assert not log.complete
    assert log.finished[:3] == ["000", "001", "002"]
    assert [e.capture for e in log.of_kind("fit")][:3] == ["000", "001", "002"]


def test_a_full_disk_is_one_line(tmp_path: Path) -> None:
    script = f"""
import resource, sys
from pathlib import Path
sys.path.insert(0, {str(Path(__file__).parents[3])!r})
from tests.workflow.log.test_record import recorded
from flangeye.workflow.log.record import LogWriteError
import signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
try:
    recorded(Path({str(tmp_path / "r.mcap")!r}))
except LogWriteError as error:
    print(error)
"""
    told = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert told.stdout == (
        f"{tmp_path / 'r.mcap'}: cannot be written: File too large; what was written so far can be "
        "read with 'flangeye show'\n"
    )


def test_the_clouds_of_a_step_keep_their_rows_and_columns(tmp_path: Path) -> None:
    grid = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    scan = t.WorkpieceScan(t.PointCloud(t.CAMERA, grid), "a scan")
    recorder = Recorder(tmp_path / "r.mcap", {"recipe.yaml": "title: T"}, full_clouds=False)
    recorder.flangeye_stage_finished("5.scan.simulated", None, scan, 0.0)
    recorder.close()
    back = read_run(tmp_path / "r.mcap").last(t.WorkpieceScan)
    assert back.cloud.organised
    np.testing.assert_array_equal(back.cloud.xyz, grid)

"""A whole scan in the log: bit for bit, in fewer bytes than zstandard alone reaches."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from flangeye import types as t
from flangeye.workflow.log.read import read_run
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.log.records import pack, unpack


def scan(rows=300, columns=400):
    """Return a tilted plane as a scanner sees it, with noise and a hole."""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, columns), np.linspace(-0.2, 0.2, rows))
    z = 0.9 + 0.1 * x + 5e-5 * np.random.default_rng(0).standard_normal(x.shape)
    xyz = np.stack([x * z, y * z, z], axis=-1).astype(np.float32)
    xyz[50:90, 100:200] = np.nan
    return xyz


@settings(max_examples=40)
@given(
    arrays.arrays(np.uint32, st.integers(0, 40)),
    st.sampled_from([0, 1, 2047, 2048]),
)
def test_every_bit_comes_back(bits: Any, more: Any) -> None:
    flat = np.resize(bits, 3 * (len(bits) + more)).astype(np.uint32).view(np.float32)
    points = flat.reshape(-1, 3)
    assert unpack(pack(points), points.shape).tobytes() == points.tobytes()


@pytest.mark.parametrize("points", [0, 1, 2047, 2048, 2049, 4096, 5000])
def test_of_2048_points_at_once_the_first_bytes_stand_side_by_side_then_the_second(
    points: int,
) -> None:
    """So are the scans of logs that exist: what is written otherwise cannot be read with them."""
    xyz = np.random.default_rng(points).normal(size=(points, 3)).astype("<f4")
    raw = xyz.tobytes()
    blocks = [raw[at : at + 12 * 2048] for at in range(0, len(raw), 12 * 2048)]
    planes = b"".join(block[byte::12] for block in blocks for byte in range(12))
    assert zstandard.decompress(pack(xyz)) == planes
    back = unpack(zstandard.compress(planes), xyz.shape)
    assert back is not None and back.tobytes() == raw


def test_it_is_smaller_than_the_points_by_zstandard() -> None:
    xyz = scan()
    assert len(pack(xyz)) < 0.8 * len(zstandard.compress(xyz.tobytes()))


@pytest.mark.parametrize("shape", [(5, 3), (6, 3), (10**9, 3), (5, 4)])
def test_points_of_another_number_or_damaged_are_none(shape: tuple[Any, ...]) -> None:
    packed = pack(np.zeros((4, 3), np.float32))
    assert unpack(packed, shape) is None
    assert unpack(packed[:-3], (4, 3)) is None
    assert unpack(b"nothing of the kind", (4, 3)) is None


def recorded(xyz: Any, path: Path, full_clouds: bool) -> tuple[Any, int]:
    """Record a run of one scan; return what viewers see of it, and its number of points."""
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
    from mcap.reader import make_reader

    pose = t.by_frame(t.Transform(t.BASE, t.FLANGE, np.eye(4)))
    recorder = Recorder(path, {"recipe.yaml": "title: T"}, full_clouds)
    recorder.flangeye_run_started(t.Source("hash"), 1)
    recorder.flangeye_captured("0.acquire", t.Capture("a", t.PointCloud(t.CAMERA, xyz), pose), 0.1)
    recorder.flangeye_run_finished({})
    with path.open("rb") as file:
        ((_, _, message),) = make_reader(file).iter_messages(topics=["/capture/cloud"])
    shown = PointCloud.FromString(message.data)
    return shown, len(shown.data) // shown.point_stride


def test_viewers_see_the_scan_thinned_and_runs_have_all_of_it(tmp_path: Path) -> None:
    xyz = scan()
    shown, points = recorded(xyz, tmp_path / "r.mcap", True)
    assert [field.name for field in shown.fields] == ["x", "y", "z"]
    assert 10_000 < points <= 40_000
    (capture,) = read_run(tmp_path / "r.mcap").captures()
    assert capture.cloud.xyz.tobytes() == xyz.tobytes() and capture.cloud.xyz.shape == xyz.shape


@pytest.mark.parametrize(
    ("points", "shown"), [(100, 100), (40_000, 40_000), (40_001, 20_001), (79_999, 40_000)]
)
def test_viewers_see_a_small_cloud_whole_and_of_a_large_one_at_most_40000_points(
    points: int, shown: int, tmp_path: Path
) -> None:
    xyz = np.random.default_rng(0).normal(0.0, 0.1, (points, 3)).astype(np.float32)
    assert recorded(xyz, tmp_path / "r.mcap", False)[1] == shown

"""Point cloud files: every encoding round trips, every defect has its one line."""

import subprocess
import time
import tracemalloc
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from flangeye import StageError
from flangeye.files.clouds import check_cloud_file, read_cloud, write_cloud
from flangeye.files.clouds.table import LzfError, decompress
from flangeye.types import CAMERA, PointCloud

QUICK = settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
POINTS = np.array([[0.1, -0.2, 0.4], [np.nan, np.nan, np.nan], [1e-3, 2.5, 0.7]], np.float32)


# --- writers, for files that the project itself never writes -----------------------------------


def compress(data: bytes) -> bytes:
    """LZF, greedy, with a table of where each three bytes were last seen."""
    out, literals, at = bytearray(), bytearray(), 0
    seen: dict[bytes, int] = {}

    def flush():
        for i in range(0, len(literals), 32):
            run = literals[i : i + 32]
            out.append(len(run) - 1)
            out.extend(run)
        literals.clear()

    while at < len(data):
        key = data[at : at + 3]
        back = seen.get(key) if len(key) == 3 else None
        seen[key] = at
        if back is None or at - back > 8192:
            literals.append(data[at])
            at += 1
            continue
        length = 3
        while length < 264 and at + length < len(data) and data[back + length] == data[at + length]:
            length += 1
        flush()
        distance = at - back - 1
        if length - 2 < 7:
            out.append((length - 2) << 5 | distance >> 8)
        else:
            out.extend((7 << 5 | distance >> 8, length - 2 - 7))
        out.append(distance & 255)
        at += length
    flush()
    return bytes(out)


def text_of(record: np.ndarray) -> bytes:
    rows = (" ".join(f"{float(value):.9g}" for value in row) for row in record.tolist())
    return ("\n".join(rows) + "\n").encode()


def with_extras(xyz: np.ndarray, extras: bool) -> np.ndarray:
    """A record array of x, y, z, or of those among others."""
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4")]
    if extras:
        fields = [("intensity", "u2"), *fields[:2], ("normal_x", "f8"), fields[2], ("rgb", "u4")]
    record = np.ones(len(xyz), fields)
    for i, axis in enumerate("xyz"):
        record[axis] = xyz[:, i]
    return record


def pcd(record: np.ndarray, encoding: str, shape=None) -> bytes:
    names = record.dtype.names or ()
    kinds = [record.dtype[name] for name in names]
    width, height = (len(record), 1) if shape is None else (shape[1], shape[0])
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(names)}\nSIZE {' '.join(str(k.itemsize) for k in kinds)}\n"
        f"TYPE {' '.join(k.kind.upper() for k in kinds)}\nCOUNT {' '.join('1' for _ in kinds)}\n"
        f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(record)}\n"
        f"DATA {encoding}\n"
    ).encode()
    if encoding == "ascii":
        return header + text_of(record)
    if encoding == "binary":
        return header + record.tobytes()
    columns = b"".join(record[name].tobytes() for name in names)
    packed = compress(columns)
    sizes = len(packed).to_bytes(4, "little") + len(columns).to_bytes(4, "little")
    return header + sizes + packed


def ply(record: np.ndarray, encoding: str, others: bool) -> bytes:
    names = {"f4": "float", "f8": "double", "u2": "ushort", "u4": "uint"}
    kinds = [(name, names[record.dtype[name].str[1:]]) for name in record.dtype.names or ()]
    before = "element marker 2\nproperty short a\nproperty double b\n" if others else ""
    after = "element face 1\nproperty list uchar int vertex_index\n" if others else ""
    header = (
        f"ply\nformat {encoding} 1.0\ncomment made by a test\n{before}"
        f"element vertex {len(record)}\n"
        + "".join(f"property {kind} {name}\n" for name, kind in kinds)
        + f"{after}end_header\n"
    ).encode()
    if encoding == "ascii":
        body = text_of(record)
        return header + (b"1 2\n3 4\n" + body + b"3 0 1 2\n" if others else body)
    order: Literal["<", ">"] = "<" if "little" in encoding else ">"
    marker = np.zeros(2, [("a", f"{order}i2"), ("b", f"{order}f8")]).tobytes()
    body = record.astype(record.dtype.newbyteorder(order)).tobytes()
    return header + (marker + body + b"\x03\x00" if others else body)


# --- round trips -------------------------------------------------------------------------------

coordinates = st.one_of(
    st.floats(-1e4, 1e4, width=32), st.just(np.nan), st.sampled_from([0.0, -0.0, 1.5, 1e-30])
)
clouds = st.integers(1, 60).flatmap(lambda n: hnp.arrays(np.float32, (n, 3), elements=coordinates))


@QUICK
@given(clouds, st.sampled_from(["ascii", "binary", "binary_compressed"]), st.booleans())
def test_pcd_round_trips_in_every_encoding(
    tmp_path: Path, xyz: Any, encoding: Any, extras: bool
) -> None:
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd(with_extras(xyz, extras), encoding))
    assert check_cloud_file(path) == len(xyz)
    cloud = read_cloud(path)
    assert (cloud.frame, cloud.organised) == (CAMERA, False)
    np.testing.assert_array_equal(cloud.xyz, xyz)


@QUICK
@given(
    clouds,
    st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]),
    st.booleans(),
    st.booleans(),
)
def test_ply_round_trips_in_every_encoding(
    tmp_path: Path, xyz: Any, encoding: Any, extras: bool, others: bool
) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(ply(with_extras(xyz, extras), encoding, others))
    assert check_cloud_file(path) == len(xyz)
    np.testing.assert_array_equal(read_cloud(path).xyz, xyz)


@QUICK
@given(st.data(), st.integers(2, 6), st.integers(1, 6))
def test_organised_clouds_keep_their_grid_and_their_gaps(
    tmp_path: Path, data: Any, height: int, width: int
) -> None:
    xyz = data.draw(hnp.arrays(np.float32, (height, width, 3), elements=coordinates))
    path = tmp_path / "a.pcd"
    write_cloud(path, PointCloud(CAMERA, xyz))
    np.testing.assert_array_equal(read_cloud(path).xyz, xyz)
    for encoding in ("ascii", "binary_compressed"):
        record = with_extras(xyz.reshape(-1, 3), extras=False)
        path.write_bytes(pcd(record, encoding, (height, width)))
        np.testing.assert_array_equal(read_cloud(path).xyz, xyz)
    np.save(tmp_path / "a.npy", xyz)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npy").xyz, xyz)


@QUICK
@given(hnp.arrays(np.float32, (7, 3), elements=st.floats(-5, 5, width=32)))
def test_millimetres_come_back_as_metres(tmp_path: Path, xyz: Any) -> None:
    path = tmp_path / "a.pcd"
    write_cloud(path, PointCloud(CAMERA, xyz), unit="mm")
    np.testing.assert_allclose(read_cloud(path, "mm").xyz, xyz, rtol=2e-7, atol=1e-30)


@pytest.mark.parametrize("dtype", ["f4", "f8", "i4"])
def test_coordinates_may_be_of_any_number_type(tmp_path: Path, dtype: str) -> None:
    record = np.array([(1, 2, 400), (3, 4, 500)], [(axis, dtype) for axis in "xyz"])
    (tmp_path / "a.pcd").write_bytes(pcd(record, "binary"))
    assert read_cloud(tmp_path / "a.pcd", "mm").xyz[1].tolist() == pytest.approx([3e-3, 4e-3, 0.5])


def test_plain_text_is_read_with_and_without_a_heading(tmp_path: Path) -> None:
    for name, text in {
        "a.xyz": "1 2 3 200\n4 5 6 210\n",
        "b.csv": "intensity,x,y,z\n200,1,2,3\n210,4,5,6\n",
        "c.txt": "# x;y;z\n1;2;3\n4;5;6\n",
    }.items():
        (tmp_path / name).write_text(text)
        assert read_cloud(tmp_path / name).xyz.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_nothing_but_nan_is_a_valid_file(tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.pcd", PointCloud(CAMERA, np.full((4, 3), np.nan)))
    assert len(read_cloud(tmp_path / "a.pcd").points()) == 0


def test_padding_after_binary_points_is_not_a_fault(tmp_path: Path) -> None:
    for encoding in ("binary", "binary_compressed"):
        path = tmp_path / f"{encoding}.pcd"
        path.write_bytes(pcd(with_extras(POINTS, False), encoding) + bytes(4096))
        np.testing.assert_array_equal(read_cloud(path).xyz, POINTS)


@QUICK
@given(st.binary(max_size=400).flatmap(lambda b: st.just(b) | st.just(b * 9)), st.integers(0, 4000))
@example(bytes(9000), 9000)
def test_lzf_decompresses_what_was_compressed_and_no_further(data: Any, wanted: int) -> None:
    wanted = min(wanted, len(data))
    assert bytes(decompress(compress(data), wanted)) == data[:wanted]


@pytest.mark.parametrize(
    ("stream", "message"),
    [
        (b"\x05ab", "it ends early"),
        (b"\x00a\xe0", "it ends early"),
        (b"\x00a\x20\x07", "it refers to bytes before its beginning"),
    ],
)
def test_a_damaged_lzf_stream_is_refused(stream: bytes, message: str) -> None:
    with pytest.raises(LzfError, match=message):
        decompress(stream, 99)


# --- defects -----------------------------------------------------------------------------------

ASCII = pcd(with_extras(POINTS, False), "ascii")
BINARY = pcd(with_extras(POINTS, False), "binary")
PACKED = pcd(with_extras(np.zeros((50, 3), np.float32), False), "binary_compressed")
PLY = ply(with_extras(POINTS, False), "ascii", others=False)
PLY_BINARY = ply(with_extras(POINTS, False), "binary_little_endian", others=False)
STREAM = PACKED.index(b"compressed\n") + len(b"compressed\n") + 8


def npy(array: np.ndarray, tmp_path: Path) -> bytes:
    np.save(tmp_path / "x.npy", array)
    return (tmp_path / "x.npy").read_bytes()


DEFECTS = {
    "empty": ("a.pcd", b"", "is empty (0 bytes)"),
    "another format": ("a.abc", b"solid", "'.abc' is not a point cloud; known: .asc, .csv, .npy, .npz, "
                       ".pcd, .ply, .pts, .txt, .xyz"),
    "not pcd": ("a.pcd", b"hello\nworld\n", "is not a PCD file: its header has no DATA line"),
    "not ply": ("a.ply", b"hello\nworld\n", "is not a PLY file: its header has no end_header line"),
    "ply by name only": ("a.ply", b"plx\nend_header\n",
                         "is not a PLY file: it does not begin with 'ply'"),
    "no vertices": ("a.ply", b"ply\nformat ascii 1.0\nelement face 1\nend_header\n",
                    "its header has no element 'vertex'"),
    "no format": ("a.ply", PLY.replace(b"format ascii 1.0\n", b""),
                  "its header states format none; known: ascii, binary_little_endian, "
                  "binary_big_endian"),
    "odd property": ("a.ply", PLY.replace(b"property float x", b"property half x"),
                     "its header has a property it cannot have: 'property half x'"),
    "lists": ("a.ply", PLY_BINARY.replace(b"property float y", b"property list uchar float y"),
              "its element 'vertex' holds lists, which cannot be skipped"),
    "truncated ply": ("a.ply", PLY_BINARY[:-13],
                      "truncated: its header promises 3 points (36 bytes), it has 1 (23 bytes)"),
    "no z": ("a.pcd", BINARY.replace(b"FIELDS x y z", b"FIELDS x y w"),
             "has no x, y, z; its fields are: x, y, w"),
    "no fields": ("a.pcd", BINARY.replace(b"FIELDS x y z\n", b""), "its PCD header has no FIELDS"),
    "no size": ("a.pcd", BINARY.replace(b"SIZE 4 4 4\n", b""), "its PCD header has no SIZE"),
    "sizes": ("a.pcd", BINARY.replace(b"SIZE 4 4 4", b"SIZE 4 4"),
              "its header names 3 fields, but 2 SIZE and 3 TYPE"),
    "counts": ("a.pcd", BINARY.replace(b"COUNT 1 1 1", b"COUNT 1 1"),
               "its header names 3 fields, but gives 2 COUNT"),
    "vector x": ("a.pcd", BINARY.replace(b"COUNT 1 1 1", b"COUNT 2 1 1"),
                 "its header gives x, y and z a COUNT other than 1"),
    "type": ("a.pcd", BINARY.replace(b"SIZE 4 4 4", b"SIZE 3 4 4"),
             "its header states TYPE F with SIZE 3, which PCD does not have"),
    "encoding": ("a.pcd", BINARY.replace(b"DATA binary", b"DATA base64"),
                 "its header states DATA base64; known: ascii, binary, binary_compressed"),
    "endless count": ("a.pts", b"9" * 5001 + b"\n1 2 3\n",
                      "its header states points '999999999999999999999999', which is not a count"),
    "raised count": ("a.pts", "²\n1 2 3\n".encode("latin-1"),
                     "its header states points '²', which is not a count"),
    "width": ("a.pcd", BINARY.replace(b"WIDTH 3", b"WIDTH -3"),
              "its header states WIDTH '-3', which is not a count"),
    "points": ("a.pcd", BINARY.replace(b"POINTS 3", b"POINTS 4"),
               "its header states 3 x 1 points, and also 4"),
    "no points": ("a.pcd", pcd(with_extras(POINTS[:0], False), "binary"), "holds no points"),
    "record": ("a.pcd", pcd(with_extras(POINTS, True), "binary")
               .replace(b"COUNT 1 1", b"COUNT 99999 1"),
               "its header states that one point has more than 65536 bytes"),
    "truncated": ("a.pcd", BINARY[:-1],
                  "truncated: its header promises 3 points (36 bytes), it has 2 (35 bytes)"),
    "truncated text": ("a.pcd", ASCII[: ASCII.rindex(b"0.001")],
                       "truncated: its header promises 3 rows, it has 2"),
    "truncated row": ("a.pcd", ASCII[: ASCII.rindex(b" ")],
                      "truncated: its last row has 2 of 3 values"),
    "too many rows": ("a.pcd", ASCII + b"1 2 3\n",
                      "its header promises 3 rows, but it has 4"),
    "packed, cut": ("a.pcd", PACKED[:-1],
                    f"truncated: {len(PACKED) - STREAM} compressed bytes promised, it has "
                    f"{len(PACKED) - STREAM - 1}"),
    "no text": ("a.xyz", b"1 2\n3 4\n", "its first row has 2 values; a point has 3 or more"),
    "no names": ("a.csv", b"a,b,c\n1,2,3\n", "has no x, y, z; its fields are: a, b, c"),
    "npy": ("a.npy", b"hello", "is not a NumPy array: EOF: reading magic string, expected 8 bytes "
            "got 5"),
}  # fmt: skip


@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_is_refused_in_one_line_before_decoding(tmp_path: Path, name: str) -> None:
    file, content, message = DEFECTS[name]
    path = tmp_path / file
    path.write_bytes(content)
    for act in (check_cloud_file, read_cloud):
        with pytest.raises(StageError) as refused:
            act(path)
        assert str(refused.value) == f"{path}: {message}"


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (
            np.zeros((4, 2)),
            "has shape (4, 2); a point cloud is (N, 3), (H, W, 3), (3, N) or (3, H, W)",
        ),
        (np.zeros((4, 3), complex), "holds 'complex128', not numbers"),
        (np.array([{}]), "holds 'object', not numbers"),
    ],
)
def test_an_array_that_is_no_cloud_is_refused(tmp_path: Path, array: Any, message: str) -> None:
    path = tmp_path / "a.npy"
    np.save(path, array)
    with pytest.raises(StageError) as refused:
        check_cloud_file(path)
    assert str(refused.value) == f"{path}: {message}"


def test_a_truncated_array_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    path.write_bytes(npy(np.zeros((4, 3)), tmp_path)[:-8])
    with pytest.raises(StageError) as refused:
        check_cloud_file(path)
    assert str(refused.value) == f"{path}: truncated: shape (4, 3) needs 96 bytes, it has 88"


def test_missing_files_and_folders_are_refused(tmp_path: Path) -> None:
    for path, message in ((tmp_path / "a.pcd", "does not exist"),):
        with pytest.raises(StageError, match=f"^{path}: {message}$"):
            check_cloud_file(path)
    (tmp_path / "b.pcd").mkdir()
    with pytest.raises(StageError, match=r"b\.pcd: is a folder, not a point cloud$"):
        read_cloud(tmp_path / "b.pcd")


def test_damage_inside_the_data_is_found_when_it_is_decoded(tmp_path: Path) -> None:
    text, packed = tmp_path / "a.pcd", tmp_path / "b.pcd"
    text.write_bytes(ASCII.replace(b"-0.2", b"-0.x"))
    packed.write_bytes(PACKED[:-6] + b"\xff" * 6)
    for path, message in (
        (text, "is not a table of numbers: could not convert string '-0.x00000003' to float32 at "
               "row 0, column 2."),
        (packed, "its compressed data is damaged: it refers to bytes before its beginning"),
    ):  # fmt: skip
        check_cloud_file(path)
        with pytest.raises(StageError) as refused:
            read_cloud(path)
        assert str(refused.value) == f"{path}: {message}"


def test_a_cloud_of_an_endless_name_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="a.pcd: does not exist"):
        read_cloud(tmp_path / f"{'a' * 300}.pcd")


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_a_header_of_a_billion_points_allocates_nothing(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.pcd"
    content = pcd(with_extras(POINTS, False), encoding)
    path.write_bytes(
        content.replace(b"WIDTH 3", b"WIDTH 1000000000000").replace(b"POINTS 3\n", b"")
    )
    tracemalloc.start()
    with pytest.raises(StageError, match="its header promises 1000000000000 "):
        read_cloud(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1e6


def test_a_small_stream_cannot_promise_much(tmp_path: Path) -> None:
    path = tmp_path / "a.pcd"
    n = 10**8
    header = PACKED[: STREAM - 8].replace(b" 50\n", f" {n}\n".encode())
    sizes = (40).to_bytes(4, "little") + (12 * n).to_bytes(4, "little")
    path.write_bytes(header + sizes + bytes(40))
    with pytest.raises(StageError, match=r"40 compressed bytes cannot expand to 1200000000$"):
        check_cloud_file(path)


@settings(QUICK, max_examples=150)
@given(
    st.sampled_from([("a.pcd", ASCII), ("a.pcd", BINARY), ("a.pcd", PACKED), ("a.ply", PLY),
                     ("a.ply", PLY_BINARY), ("a.xyz", b"1 2 3\n4 5 6\n")]),
    st.lists(st.tuples(st.integers(0, 600), st.binary(min_size=1, max_size=4)), max_size=4),
    st.integers(0, 600),
)  # fmt: skip
def test_whatever_the_bytes_are_there_is_a_cloud_or_one_line(
    tmp_path: Path, file: Any, edits: Any, cut: int
) -> None:
    name, content = file
    damaged = bytearray(content[: len(content) - cut] if cut < len(content) else content)
    for at, new in edits:
        damaged[at : at + len(new)] = new
    path = tmp_path / name
    path.write_bytes(bytes(damaged))
    try:
        assert read_cloud(path).xyz.size
    except StageError as error:
        assert "\n" not in str(error)


# --- real files and speed ----------------------------------------------------------------------


def test_published_clouds_are_read_as_open3d_reads_them(ancorasir: Path) -> None:
    from open3d import io

    for name in (
        "data/aubo/tool0_5.pcd",
        "flange_ground_truth/flange_aubo_cropped.pcd",
        "Kinect_Result/flange.pcd",
        "calib_toolbox/data/2019-06-14-sample/01_tool.ply",
        "calib_toolbox/data/2019-06-14-sample/01_tool_valid.pcd",
    ):
        ours = read_cloud(ancorasir / name).points()
        theirs = io.read_point_cloud(ancorasir / name, remove_nan_points=True)
        np.testing.assert_allclose(ours, np.asarray(theirs.points), rtol=1e-6)


def test_a_scan_of_three_million_points_is_read_at_a_few_times_the_cost_of_its_bytes(
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.pcd"
    write_cloud(path, PointCloud(CAMERA, np.ones((1544, 2064, 3), np.float32)))
    began = time.process_time()
    for _ in range(3):
        np.fromfile(path, np.float32).copy()
    of_bytes = time.process_time() - began
    began = time.process_time()
    assert read_cloud(path).xyz.shape == (1544, 2064, 3)
    assert time.process_time() - began < 5 * of_bytes


def lines_of(points, form="{:f} {:f} {:f}"):
    return "".join(form.format(*point) + "\n" for point in points.tolist())


TABLES_OF_POINTS = {
    "normals.npy": lambda f, p: np.save(f, np.hstack([p, p])),
    "records.npy": lambda f, p: np.save(f, np.array(
        [tuple(q) for q in p], [("z", "f4"), ("y", "f4"), ("x", "f4")])),
    "units.csv": lambda f, p: f.write_text("x_mm,y_mm,z_mm\n" + lines_of(1e3 * p, "{},{},{}")),
    "brackets.csv": lambda f, p: f.write_text("X [mm];Y [mm];Z [mm]\n"
                                              + lines_of(1e3 * p, "{};{};{}").replace(".", ",")),
    "counted.pts": lambda f, p: f.write_text(f"{len(p)}\n" + lines_of(p)),
    "titled.xyz": lambda f, p: f.write_text(f"{len(p)}\na flange\n" + lines_of(p)),
    "comma.csv": lambda f, p: f.write_text(lines_of(p, "{:f};{:f};{:f}").replace(".", ",")),
    "axes_first.npy": lambda f, p: np.save(f, p.T),
    "image.npy": lambda f, p: np.save(f, p.T.reshape(3, 2, 20)),
    "remarks.xyz": lambda f, p: f.write_text(
        "# scan 3 of 12\n# mm\n" + lines_of(p[:20]) + "  # second half\n\n" + lines_of(p[20:])),
    "heading.txt": lambda f, p: f.write_text(
        "% exported\n//R X Y Z\n" + lines_of(p, "7 {:f} {:f} {:f}")),
    "unit.xyz": lambda f, p: f.write_text("# x_mm y_mm z_mm\n" + lines_of(1e3 * p)),
    "tabs.txt": lambda f, p: f.write_text(lines_of(p, "{:f}\t{:f}\t{:f}").replace(".", ",")),
    "named.npz": lambda f, p: np.savez(f, colors=p + 1, points=p),
    "alone.npz": lambda f, p: np.savez(f, p, labels=np.arange(len(p))),
    "image.npz": lambda f, p: np.savez_compressed(f, xyz=p.reshape(2, 20, 3)),
    "axes.npz": lambda f, p: np.savez(f, x=p[:, 0], y=p[:, 1], z=p[:, 2]),
    "mark.csv": lambda f, p: f.write_text("\ufeffx,y,z\n" + lines_of(p, "{},{},{}"), "utf-8"),
    "bare_mark.csv": lambda f, p: f.write_text("\ufeff" + lines_of(p, "{},{},{}"), "utf-8"),
    "loud.csv": lambda f, p: f.write_text("X_MM,Y_MM,Z_MM\n" + lines_of(1e3 * p, "{},{},{}")),
    "cm.csv": lambda f, p: f.write_text("x (cm),y (cm),z (cm)\n" + lines_of(1e2 * p, "{},{},{}")),
    "paraview.csv": lambda f, p: f.write_text(
        '"Points:0","Points:1","Points:2"\n' + lines_of(p, "{},{},{}")),
    "words.csv": lambda f, p: f.write_text(
        "px,py,Position X [mm],Position Y [mm],Position Z [mm]\n"
        + lines_of(1e3 * p, "4,5,{},{},{}")),
    "slash.csv": lambda f, p: f.write_text("X/mm;Y in mm;z.mm\n" + lines_of(1e3 * p, "{};{};{}")),
    "long.csv": lambda f, p: f.write_text(
        "x (millimeters),y (millimeters),z (millimeters)\n" + lines_of(1e3 * p, "{},{},{}")),
    "below.csv": lambda f, p: f.write_text("X,Y,Z\nmm,mm,mm\n" + lines_of(1e3 * p, "{},{},{}")),
    "quoted.csv": lambda f, p: f.write_text(
        '"X";"Y";"Z"\n' + lines_of(p, '"{}";"{}";"{}"').replace(".", ",")),
    "preamble.csv": lambda f, p: f.write_text(
        "Scanner ACME\nserial;123\nX [mm];Y [mm];Z [mm]\n" + lines_of(1e3 * p, "{};{};{}")),
    "spaced.xyz": lambda f, p: f.write_text("# X [mm] Y [mm] Z [mm]\n" + lines_of(1e3 * p)),
    "records_mm.npy": lambda f, p: np.save(
        f, np.rec.fromarrays(1e3 * p.T, dtype=[(f"{axis}_mm", "f8") for axis in "xyz"])),
    "unit.npz": lambda f, p: np.savez(f, xyz_mm=1e3 * p, K=np.eye(3), pose=np.eye(4)),
    "other.npz": lambda f, p: np.savez(f, pc=p, K=np.eye(3), pose=np.eye(4)),
    "axes_first.npz": lambda f, p: np.savez(f, points=p.T),
    "ended.csv": lambda f, p: f.write_text(lines_of(p, "{},{},{},")),
}  # fmt: skip


@pytest.mark.parametrize("name", TABLES_OF_POINTS)
def test_points_are_read_from_tables_as_other_programs_write_them(
    tmp_path: Path, name: str
) -> None:
    points = np.random.default_rng(5).random((40, 3)).astype(np.float32)
    TABLES_OF_POINTS[name](tmp_path / name, points)
    said: list[str] = []
    found = read_cloud(tmp_path / name, told=said.append).points()
    wanted = points[:, ::-1] if name == "records.npy" else points
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    first = name.startswith("axes_first") or name == "image.npy"
    assert said == ["its rows are x, y and z, with one point a column"] * first


def test_empty_cells_are_missing_points(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y,z\n1,2,3\n,,\n4,5,\n7,8,9\n")
    assert read_cloud(tmp_path / "a.csv").points().tolist() == [[1, 2, 3], [7, 8, 9]]


def test_arrays_of_which_several_may_be_points_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", one=np.ones((9, 3)), two=np.ones((9, 3)))
    with pytest.raises(StageError, match=r"one \(9, 3\), two \(9, 3\); call one points"):
        read_cloud(tmp_path / "a.npz")


def test_a_pointer_of_git_lfs_is_named_as_such(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\n")
    with pytest.raises(StageError, match="a Git LFS pointer, not the file itself; fetch it: git l"):
        read_cloud(tmp_path / "a.pcd")


MISSING: dict[str, tuple[list[float | None], str]] = {
    "zeros": ([0, 0, 0], "(0, 0, 0)"),
    "a number of no place": ([-10000, -10000, -10000], "(-10000, -10000, -10000)"),
    "a far depth": ([None, None, 65535], "a depth of 65535"),
    "no depth": ([None, None, 0], "a depth of 0"),
    "a depth behind the scanner": ([None, None, -1], "a depth of -1"),
}


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".xyz", ".pcd"])
@pytest.mark.parametrize("name", MISSING)
def test_numbers_that_stand_for_missing_points_are_missing(
    tmp_path: Path, name: str, suffix: str
) -> None:
    sentinel, shown = MISSING[name]
    rng = np.random.default_rng(0)
    xyz = (rng.random((3000, 3)) * [400, 300, 100] + [0, 0, 800]).astype(np.float32)
    gone = rng.random(len(xyz)) < 0.6
    for axis, value in enumerate(sentinel):
        if value is not None:
            xyz[gone, axis] = value
    path = tmp_path / f"scan{suffix}"
    if suffix == ".ply":
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n"
        head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
        path.write_bytes(head.encode() + xyz.tobytes())
    elif suffix == ".npy":
        np.save(path, xyz)
    elif suffix == ".xyz":
        np.savetxt(path, xyz, fmt="%.6g")
    else:
        write_cloud(path, PointCloud(CAMERA, xyz))
    told: list[str] = []
    read = read_cloud(path, "mm", told.append)
    assert np.array_equal(np.isnan(read.xyz).all(axis=1), gone)
    assert told == [f"scan{suffix}: {gone.sum()} of 3000 points have {shown}: taken as missing"]


@pytest.mark.parametrize("change", [lambda xyz: xyz, lambda xyz: xyz * [1, 1, 0] + [0, 0, 800]])
def test_points_on_a_plane_are_not_missing(tmp_path: Path, change: Any) -> None:
    xyz = np.random.default_rng(0).random((3000, 3)) * 400
    np.save(tmp_path / "a.npy", change(xyz))
    told: list[str] = []
    assert np.isfinite(read_cloud(tmp_path / "a.npy", told=told.append).xyz).all()
    assert not told


def test_a_viewpoint_is_said_and_applied_on_request(tmp_path: Path) -> None:
    path, xyz = tmp_path / "a.pcd", np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    write_cloud(path, PointCloud(CAMERA, xyz))
    raw = path.read_bytes()
    half = np.sqrt(0.5)
    words = f"0.5 0 1 {half:.9f} 0 0 {half:.9f}".encode()  # a quarter turn about z
    path.write_bytes(raw.replace(b"VIEWPOINT 0 0 0 1 0 0 0", b"VIEWPOINT " + words))
    told: list[str] = []
    assert np.allclose(read_cloud(path, told=told.append).xyz, xyz)
    assert "VIEWPOINT 0.5 0 1 0.707107 0 0 0.707107 is not applied" in told[0]
    seen = read_cloud(path, from_viewpoint=True).xyz
    assert np.allclose(seen, [[2, -0.5, 2], [5, -3.5, 5]], atol=1e-6)
    path.write_bytes(raw.replace(b"VIEWPOINT 0 0 0 1 0 0 0", b"VIEWPOINT 0 0 0 9 0 0 0"))
    with pytest.raises(StageError, match="VIEWPOINT 0 0 0 9 0 0 0: no position and quaternion"):
        read_cloud(path)


@pytest.mark.parametrize("suffix", [".stl", ".las", ".e57"])
def test_other_kinds_are_named_with_their_conversion(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(StageError, match=f"save it as .ply|as .ply: CloudCompare -O .*a{suffix}"):
        read_cloud(tmp_path / f"a{suffix}")


def test_the_command_that_takes_the_points_of_an_obj_runs_as_it_is_printed(tmp_path: Path) -> None:
    path = tmp_path / "a; touch b 'c'.obj"
    path.write_text("# points\nv 1 2 3\nvn 0 0 1\nv 4 5 6\nf 1 2 1\n")
    with pytest.raises(StageError, match="take its points: awk ") as refused:
        read_cloud(path)
    command = str(refused.value).split("take its points: ")[1]
    subprocess.run(["sh", "-c", command], check=True, cwd=tmp_path)
    assert read_cloud(path.with_suffix(".xyz")).xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert {each.name for each in tmp_path.iterdir()} == {path.name, "a; touch b 'c'.xyz"}


def test_a_makers_own_kind_is_named_with_what_exports_it(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="a.ZDF: only Zivid's SDK reads it; export it as .ply"):
        read_cloud(tmp_path / "a.ZDF")

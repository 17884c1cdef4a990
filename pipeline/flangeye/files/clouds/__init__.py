"""Read point cloud files strictly: PCD, PLY, NumPy arrays and plain text.

A damaged file is refused, never repaired. Its header is checked against its size before memory is
allocated, so a header that states a billion points costs nothing. Points that are not finite are
kept as missing points, so that organised clouds keep their grid. A file with nothing but missing
points is valid.
"""

import math
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from flangeye.files.clouds.pcd import Viewpoint, open_pcd
from flangeye.files.clouds.plain import STATED, open_npy, open_npz, open_text
from flangeye.files.clouds.ply import open_ply
from flangeye.files.clouds.table import Points, PointTable, refuse
from flangeye.files.remote import at_hand
from flangeye.types import CAMERA, PointCloud


def mark_missing(xyz: Points) -> str:
    """Set the values by which scanners mark missing points to NaN, in place.

    A repeated point is missing if it is the scanner's origin, or farther than all others. Points of
    one depth are missing if that depth is more than three times all others, or if it is zero or
    less and all others are on one side.

    Args:
        xyz: (N, 3) points in the file's own unit.

    Returns:
        Sentence about which points were taken as missing, and how many; empty if none were.
    """
    some = xyz[:: max(1, len(xyz) // 4096)]
    some = some[np.isfinite(some).all(axis=1)]
    depths, counts = np.unique(some[:, 2], return_counts=True)
    # Measured points are not equal to the last bit this often. Fewer than 100 do no harm, and small
    # tables may repeat measured values
    if not len(depths) or counts.max() < max(0.01 * len(some), 100):
        return ""
    depth = depths[counts.argmax()]
    alike, others = some[some[:, 2] == depth], some[some[:, 2] != depth]
    point = alike[0]
    repeated = (alike == point).all(axis=1).mean() > 0.5
    if repeated and (not point.any() or _beyond(np.abs(point).max(), np.abs(others), 1.0)):
        gone, called = (xyz == point).all(axis=1), f"({', '.join(f'{x:g}' for x in point)})"
    elif _beyond(abs(depth), np.abs(others[:, 2]), 3.0) or _not_among(depth, others[:, 2]):
        gone, called = xyz[:, 2] == depth, f"a depth of {depth:g}"
    else:
        return ""
    xyz[gone] = np.nan
    return f"{np.count_nonzero(gone)} of {len(xyz)} points have {called}: taken as missing"


def _beyond(value: float, others: Points, times: float) -> bool:
    return bool(others.size) and value > times * float(others.max())


def _not_among(depth: float, others: Points) -> bool:
    """Return whether a depth is zero or behind the scanner, while all others are before it."""
    ahead = np.sign(others[:1])
    return bool(others.size) and bool((others * ahead > 0).all() and depth * ahead <= 0)


FileUnit = Literal["m", "mm", "cm", "in"]
PER_METRE: Mapping[FileUnit, float] = {"m": 1, "mm": 1000, "cm": 100, "in": 1 / 0.0254}
"""Number of each unit in a metre."""

CLOUD_FILES: Mapping[str, Callable[[Path], PointTable]] = {
    ".asc": open_text,
    ".csv": open_text,
    ".npy": open_npy,
    ".npz": open_npz,
    ".pcd": open_pcd,
    ".ply": open_ply,
    ".pts": open_text,
    ".txt": open_text,
    ".xyz": open_text,
}
"""Function that opens a file, by the file's ending."""
VENDOR = {".zdf": "Zivid's SDK", ".praw": "Photoneo's PhoXi Control", ".mraw": "Mech-Mind's SDK"}
"""Endings of proprietary formats, and the program that converts such files."""
CONVERSIONS: Mapping[str, str] = {
    **{end: f"only {by} reads it; export it as .ply or .pcd" for end, by in VENDOR.items()},
    **{
        ending: f"is {what} as .ply: CloudCompare -O {{file}} {step}-C_EXPORT_FMT PLY -SAVE_CLOUDS"
        for endings, what, step in (
            ((".e57",), "an E57 scan, which is not read; save it", ""),
            ((".las", ".laz"), "a LAS scan, which is not read; save it", ""),
            ((".off", ".vtk", ".ptx"), "a cloud or mesh that is not read; save it", ""),
            ((".stl",), "a mesh, not a scan; sample it to points",
             "-SAMPLE_MESH POINTS 1000000 "),
        )
        for ending in endings
    },
    ".obj": "is a mesh or a cloud that is not read; take its points: "
    "awk '$1 == \"v\" {{print $2, $3, $4}}' {file} > {stem}.xyz",
    ".exr": "is a depth image that is not read; save it as .tiff or .npy",
    ".pfm": "is a depth image that is not read; save it as .tiff or .npy",
    ".gz": "is compressed; unpack all of them: gunzip *.gz",
    ".zip": "is an archive; unpack it: unzip {file} -d {stem}",
}  # fmt: skip
"""Ending -> what such a file is, and the command that turns it into one that can be read."""


def read_cloud(
    path: Path,
    unit: FileUnit = "m",
    told: Callable[[str], None] | None = None,
    from_viewpoint: bool = False,
) -> PointCloud:
    """Read a point cloud.

    Args:
        path: A file with one of :data:`CLOUD_FILES`.
        unit: Unit of the file's coordinates, if its heading states none.
        told: Called with each note about the file: x, y and z as its first index, numbers that
            stand for missing points, and a VIEWPOINT that is not the identity.
        from_viewpoint: Whether to turn the points into the frame of the file's VIEWPOINT.

    Returns:
        The points in ``camera`` [m], organised (H, W, 3) if the file is; a missing point is NaN.

    Raises:
        StageError: The file is missing, empty, truncated, or not a point cloud.
    """
    with at_hand(path):
        table = _open(path)
        xyz = table.decode()
    if told and getattr(table, "axes_first", False):
        told("its rows are x, y and z, with one point a column")
    xyz = marked(path, xyz, told)
    viewpoint: Viewpoint | None = table.viewpoint
    if viewpoint is not None and from_viewpoint:
        xyz = viewpoint.seen_from(xyz)
    if viewpoint is not None and told:
        told(f"{path.name}: {viewpoint.note(from_viewpoint)}")
    per_metre = STATED.get(getattr(table, "unit", "")) or PER_METRE[unit]
    if per_metre != 1:
        xyz /= np.float32(per_metre)  # exact to the last bit, which times 0.001 is not
    return PointCloud(CAMERA, xyz.reshape(*table.shape, 3))


def marked(path: Path, xyz: Points, told: Callable[[str], None] | None) -> Points:
    """Return the points of a file with missing ones as NaN; report their number to ``told``."""
    xyz = xyz if xyz.flags.writeable else xyz.copy()
    if (missing := mark_missing(xyz)) and told:
        told(f"{path.name}: {missing}")
    return xyz


def check_cloud_file(path: Path) -> int:
    """Return the number of points in a file, after checking its header against its size.

    Raises:
        StageError: As :func:`read_cloud`, except for damage inside the data.
    """
    return math.prod(_open(path).shape)


def write_cloud(path: Path, cloud: PointCloud, unit: FileUnit = "m") -> None:
    """Write a cloud as binary PCD, organised if it is; missing points stay missing.

    Args:
        path: File to write.
        cloud: The points [m].
        unit: Unit of the file's coordinates.
    """
    height, width = cloud.xyz.shape[:2] if cloud.organised else (1, len(cloud.xyz))
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\n"
        f"TYPE F F F\nCOUNT 1 1 1\nWIDTH {width}\nHEIGHT {height}\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {width * height}\nDATA binary\n"
    )
    xyz = cloud.xyz * np.float32(PER_METRE[unit])
    path.write_bytes(header.encode() + xyz.astype("<f4").tobytes())


def _open(path: Path) -> PointTable:
    opener, other = CLOUD_FILES.get(path.suffix.lower()), CONVERSIONS.get(path.suffix.lower())
    if other is not None:
        # The command is there to be pasted into a shell
        file, stem = (shlex.quote(str(each)) for each in (path, path.with_suffix("")))
        refuse(path, other.format(file=file, stem=stem))
    if opener is None:
        refuse(path, f"'{path.suffix}' is not a point cloud; known: {', '.join(CLOUD_FILES)}")
    table = opener(path)
    if math.prod(table.shape) == 0:
        refuse(path, "holds no points")
    table.check()
    return table

"""Writes captures as a folder that `reader.folder` reads."""

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from flangeye.files.clouds import write_cloud
from flangeye.types import FLANGE2, Capture, Transform
from flangeye.types.geometry import quaternion_from_rotation
from flangeye_plugins.reader.folder import SECOND


def write_folder(path: Path, captures: Iterable[Capture]) -> None:
    """Write captures as a folder of binary PCD clouds and ``poses.csv``, in metres.

    Args:
        path: Folder to write into; it is created.
        captures: At least one capture; either all or none have joint angles and a second arm.
    """
    path.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for capture in captures:
        write_cloud(path / f"{capture.id}.pcd", capture.cloud)
        rows.append(_row_of(capture))
    with (path / "poses.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _row_of(capture: Capture) -> dict[str, Any]:
    joints = [] if capture.joints is None else capture.joints.tolist()
    second = capture.poses.get(FLANGE2)
    return {
        "cloud": f"{capture.id}.pcd", "id": capture.id, "role": capture.role,
        "time_ns": capture.time_ns, **_cells_of(capture.base_T_flange),
        **{f"j{i}_rad": angle for i, angle in enumerate(joints, 1)},
        **({} if second is None else _cells_of(second, SECOND)),
    }  # fmt: skip


def _cells_of(pose: Transform, prefix: str = "") -> dict[str, float]:
    numbers = [*pose.translation.tolist(), *quaternion_from_rotation(pose.rotation).tolist()]
    names = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    return {prefix + name: number for name, number in zip(names, numbers, strict=True)}

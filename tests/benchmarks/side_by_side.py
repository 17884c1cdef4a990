"""One scan to the rim's circle, three ways: python -m tests.benchmarks.side_by_side [FILE]

Ours; what a user would write with Open3D; and the authors' loop, one draw at a time as they
published it (7.5 s a cloud on their machine). Prints a Markdown table, or puts it into FILE
between its markers.
"""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from flangeye_plugins.fit.ransac import circles_through
from flangeye_plugins.fit.rim import fit_rim
from flangeye_plugins.segment.flange import segment_flange
from tests.benchmarks.cases import _asked, stages
from tests.benchmarks.measure import measure

DRAWS = 10_000
BEGIN, END = "<!-- begin python -m tests.benchmarks.side_by_side -->\n", "<!-- end -->"


def ours() -> object:
    """segment.flange and fit.rim on the whole scan."""
    flange = segment_flange(stages().capture, **_asked(segment_flange))
    return fit_rim(flange, **_asked(fit_rim))


def with_open3d() -> object:
    """Thin to two millimetres, remove outliers, take planes off, cluster, draw circles."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(stages().capture.cloud.points()))
    cloud, _ = cloud.voxel_down_sample(2e-3).remove_statistical_outlier(20, 2.0)
    for _ in range(2):
        _, inliers = cloud.segment_plane(1e-3, 3, 1000)
        rest = cloud.select_by_index(inliers, invert=True)
        cloud = rest if len(rest.points) > 1000 else cloud
    labels = np.asarray(cloud.cluster_dbscan(6e-3, 10))
    largest = np.asarray(cloud.points)[labels == np.bincount(labels[labels >= 0]).argmax()]
    return draws(largest, 1000)


def authors_loop() -> object:
    """The circle alone, one draw at a time over the flange's points; a hundredth is timed."""
    return draws(stages().flange.cloud.points().astype(float), DRAWS // 100)


def draws(points: np.ndarray, count: int) -> tuple[int, np.ndarray | None]:
    """Return the best of ``count`` circles through three points, drawn and scored one by one."""
    rng, best, place = np.random.default_rng(0), 0, None
    for _ in range(count):
        centre, radius = circles_through(points[rng.integers(0, len(points), 3)][None])
        near = np.abs(np.linalg.norm(points - centre, axis=1) - radius) < 3e-4
        if near.sum() > best:
            best, place = int(near.sum()), centre[0]
    return best, place


def spent_by(call: Callable[[], object]) -> float:
    """Return the seconds of the processor that one call takes; they are many."""
    start = time.process_time()
    call()
    return time.process_time() - start


def table() -> str:
    """Return the costs as Markdown."""
    seconds = {
        "`segment.flange` and `fit.rim`": measure(ours).seconds,
        "Open3D: thin, outliers, planes, DBSCAN, 1,000 circles": spent_by(with_open3d),
        "the authors' loop, 10,000 circles, the flange already found": 100 * spent_by(authors_loop),
    }
    own = next(iter(seconds.values()))
    lines = ["| one scan of 3.2 M pixels | CPU s | times ours |", "|---|---|---|"]
    lines += [f"| {name} | {cost:.2f} | {cost / own:.0f} |" for name, cost in seconds.items()]
    return "\n".join(lines) + "\n"


def main(words: list[str]) -> None:
    """Print the table, or renew it in a file."""
    found = table()
    if not words:
        print(found)
        return
    page = Path(words[0])
    before, _, after = page.read_text().partition(BEGIN)
    page.write_text(before + BEGIN + found + END + after.partition(END)[2])


if __name__ == "__main__":
    main(sys.argv[1:])

"""Figure 11: calibration error by the number of poses, on the published recordings."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flangeye.files.arrays import read_npz
from flangeye.types import Floats
from flangeye_paper import tables
from flangeye_paper.published import stored_file

ROBOTS = {"aubo": "Aubo i5", "ur5": "UR5", "franka": "Franka"}


class Runs(NamedTuple):
    """Many runs of Algorithm 1 on one recording.

    Attributes:
        poses: (K,) poses seen.
        errors: (R, K, 6) errors of each run, mm and deg; NaN before the first finite cost.
        others_rms: (R,) residual of the last answers on the poses outside their pools [mm].
    """

    poses: list[int]
    errors: Floats
    others_rms: Floats | None = None


def fig11(
    batches: tables.Batches, archive: tables.FolderOption, out: tables.OutOption = Path()
) -> None:
    """Write fig11.csv, fig11_summary.csv and fig11.png.

    Args:
        batches: Folder with the batch fig11_aubo.
        archive: The published folder.
        out: Folder for the files.
    """
    runs = {("aubo", "run again"): rerun(batches / "fig11_aubo")}
    runs |= {(robot, "stored"): stored(archive, robot) for robot in ROBOTS}
    rows = [row for (robot, source), many in runs.items() for row in _rows(robot, source, many)]
    tables.write_csv(out / "fig11.csv", rows)
    tables.write_csv(
        out / "fig11_summary.csv", [_summary(*key, many) for key, many in runs.items()]
    )
    _draw(runs).save(out / "fig11.png")


def stored(archive: Path, robot: str) -> Runs:
    """Return the authors' 50 runs on one robot."""
    file = stored_file(archive, robot)
    shifts, turns = (read_npz(file, name, (None, None, 3)) for name in ("arr_1", "arr_2"))
    first = 5  # the authors' loop gives its first error once five poses are there
    poses = list(range(first, first + shifts.shape[1]))
    return Runs(poses, np.concatenate([shifts, turns], axis=2))


def rerun(batch: Path) -> Runs:
    """Return the runs of a batch of verify.algorithm_1_by_iteration."""
    sessions = [s for s in tables.read_sessions(batch) if s.accepted]
    found = [s.figures("verify.algorithm_1_by_iteration") for s in sessions]
    poses = sorted({int(name[2:]) for name in found[0] if name.startswith("x_")})
    names = [[f"{axis}_{n:02d}" for axis in tables.AXIS_COLOURS] for n in poses]
    errors = np.array([[[f.get(name, np.nan) for name in row] for row in names] for f in found])
    errors = np.concatenate([1e3 * errors[..., :3], np.degrees(errors[..., 3:])], axis=2)
    return Runs(poses, errors, np.array([f["others_rms"] * 1e3 for f in found]))


def _rows(robot: str, source: str, runs: Runs) -> list[tables.Row]:
    means, deviations = np.nanmean(runs.errors, axis=0), np.nanstd(runs.errors, axis=0)
    return [
        {
            "robot": robot,
            "source": source,
            "poses": n,
            **{f"{axis}_mean": float(means[k, i]) for i, axis in enumerate(tables.AXIS_COLOURS)},
            **{
                f"{axis}_std": float(deviations[k, i]) for i, axis in enumerate(tables.AXIS_COLOURS)
            },
        }
        for k, n in enumerate(runs.poses)
    ]


def _summary(robot: str, source: str, runs: Runs) -> tables.Row:
    """Return a summary of the final results of all runs."""
    last = runs.errors[:, -1]
    norms = np.linalg.norm(last[:, :3], axis=1)
    told = [f"{m:+.2f} ± {s:.2f}" for m, s in zip(last.mean(axis=0), last.std(axis=0), strict=True)]
    return {
        "recording": f"{ROBOTS[robot]}, {source}",
        "runs": len(norms),
        # Section 3.2.3: what the translation and rotation errors converge to, Aubo and UR5 alike
        "the paper": "< 0.4 mm, 0.6 deg" if robot == "franka" else "< 0.28 mm, 0.25 deg",
        "translation mean mm": float(norms.mean()),
        "worst mm": float(norms.max()),
        **tables.with_units(told),
    }


def _draw(runs: Mapping[tuple[str, str], Runs]) -> Any:
    page = tables.sheet(2, 3, 10.5, 6.0)
    for column, robot in enumerate(ROBOTS):
        for row, axes, unit in (
            (0, [*tables.AXIS_COLOURS][:3], "mm"),
            (1, [*tables.AXIS_COLOURS][3:], "deg"),
        ):
            panel = page.panels[3 * row + column]
            _spread(panel, _rows(robot, "stored", runs[robot, "stored"]), axes, filled=True)
            if (robot, "run again") in runs:
                again = _rows(robot, "run again", runs[robot, "run again"])
                _spread(panel, again, axes, filled=False)
            what = "stored (bands) and run again (lines)" if column == 0 else "stored"
            tables.dress(panel, f"{ROBOTS[robot]}, {what}", "poses", f"mean ± deviation [{unit}]")
            panel.set_xlim(5, 45)
            panel.set_ylim((-2, 2) if row == 0 else (-0.7, 0.7))
            if column == 2:
                tables.legend(panel, loc="upper right", ncols=3)
    return page


def _spread(panel: Any, rows: Sequence[tables.Row], axes: Sequence[str], filled: bool) -> None:
    """Draw mean and standard deviation of each axis as a band, or as its two edges."""
    for axis in axes:
        poses, mean, deviation = map(
            np.array, tables.columns(rows, "poses", f"{axis}_mean", f"{axis}_std")
        )
        low, high, colour = mean - deviation, mean + deviation, tables.AXIS_COLOURS[axis]
        if filled:
            panel.plot(poses, mean, color=colour, linewidth=1.0, label=axis)
            panel.fill_between(poses, low, high, color=colour, alpha=0.2, lw=0)
        else:
            panel.plot(poses, low, "--", poses, high, "--", color=colour, linewidth=0.9)

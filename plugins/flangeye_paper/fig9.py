"""Figure 9: calibration error by scanner noise."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flangeye.maths.statistics import rms
from flangeye_paper import tables


def fig9(batches: tables.Batches, out: tables.OutOption = Path()) -> None:
    """Write fig9.csv, fig9_summary.csv, fig9_pools.csv and fig9.png.

    Args:
        batches: Folder with the batches fig9_<method>, fig9-outliers_<method> and fig9-pools.
        out: Folder for the files.
    """
    rows = [
        {"method": method, "outliers": share, **realised(session)}
        for share, prefix in ((0.0, "fig9"), (0.15, "fig9-outliers"))
        for method in tables.METHOD_LOOKS
        for session in tables.read_sessions(batches / f"{prefix}_{method}")
    ]
    tables.write_csv(out / "fig9.csv", rows)
    tables.write_csv(
        out / "fig9_summary.csv", [_summary(rows, method) for method in tables.METHOD_LOOKS]
    )
    tables.write_csv(
        out / "fig9_pools.csv", [_pool(s) for s in tables.read_sessions(batches / "fig9-pools")]
    )
    _draw(rows).save(out / "fig9.png")


def realised(session: tables.SessionRow) -> dict[str, Any]:
    """Return a session's figures in millimetres and degrees, as its row of the CSV."""
    found = session.figures("verify.realisations")
    scale = {axis: 1e3 if len(axis) == 1 else np.degrees(1.0) for axis in tables.AXIS_COLOURS}
    noise = session.row.get("steps.0.noise")
    return {
        "noise_mm": session.number("steps.0.noise") if noise else 1.0,
        **{f"{axis}_std": found[f"{axis}_std"] * scale[axis] for axis in tables.AXIS_COLOURS},
        **{f"{axis}_mean": found[f"{axis}_mean"] * scale[axis] for axis in tables.AXIS_COLOURS},
        **{f"{axis}_bound": found[f"bound_{axis}"] * scale[axis] for axis in tables.AXIS_COLOURS},
        "centre_x_std": found["centre_x_std"] * 1e3,
        "centre_y_std": found["centre_y_std"] * 1e3,
        "workspace_rms": found["workspace_rms"] * 1e3,
        "workspace_bound": found["bound_workspace_rms"] * 1e3,
        "inliers_alone_rms": found["inliers_alone_rms"] * 1e3,
        "realisations": int(found["realisations"]),
        "refused": int(found["refused"]),
    }


def _summary(rows: Sequence[tables.Row], method: str) -> dict[str, Any]:
    """Return each error's slope over the noise, and its change with outliers, of a method."""
    clean = [r for r in rows if r["method"] == method and r["outliers"] == 0]
    gross = [r for r in rows if r["method"] == method and r["outliers"] > 0]
    over = [r["workspace_rms"] / r["workspace_bound"] for r in clean]
    alone = [r["workspace_rms"] / r["inliers_alone_rms"] for r in gross]
    at_one = [r["workspace_rms"] for r in gross if r["noise_mm"] == 1]
    return {
        "method": tables.METHOD_LOOKS[method].label,
        **{f"{axis} {_unit(axis)}": _growth(clean, f"{axis}_std") for axis in tables.AXIS_COLOURS},
        "x at work mm/mm": _growth(clean, "centre_x_std"),
        "workspace rms mm/mm": _growth(clean, "workspace_rms"),
        "times the bound": rms(over),
        "15 % outliers, 1 mm: workspace rms mm": at_one[0] if at_one else None,
        "times the inliers alone": rms(alone),
    }


def _pool(session: tables.SessionRow) -> dict[str, Any]:
    """Return a text that compares a pool of this size with the paper's claim of one seventh."""
    row = realised(session)
    return {
        "pool": int(session.number("steps.1.pool")),
        **{f"{axis} {_unit(axis)}": row[f"{axis}_std"] for axis in ("x", "y", "z", "yaw")},
        "x: all data / Algorithm 1": row["x_bound"] / row["x_std"],
        "z: all data / Algorithm 1": row["z_bound"] / row["z_std"],
        "workspace rms mm/mm": row["workspace_rms"],
        "times the bound": row["workspace_rms"] / row["workspace_bound"],
    }


def _unit(axis: str) -> str:
    return "mm/mm" if len(axis) == 1 else "deg/mm"


def _growth(rows: Sequence[tables.Row], column: str) -> float:
    return rms([r[column] / r["noise_mm"] for r in rows])


def _draw(rows: Sequence[tables.Row]) -> Any:
    page = tables.sheet(2, 3, 10.5, 6.0)
    clean = [r for r in rows if r["outliers"] == 0]
    gross = [r for r in rows if r["outliers"] > 0]
    printed = (
        ("x_std", "x_bound", "x at the camera's origin, as printed", "mm"),
        ("z_std", "z_bound", "z at the camera's origin, as printed", "mm"),
        ("yaw_std", "yaw_bound", "yaw, as printed", "deg"),
        ("workspace_rms", "workspace_bound", "at the work: over the workspace, rms", "mm"),
    )
    for panel, (column, bound, title, unit) in zip(page.panels, printed, strict=False):
        _lines(panel, clean, column, bound)
        tables.dress(panel, title, "noise [mm]", f"standard deviation [{unit}]")
    page.panels[3].set_ylabel("error [mm]", fontsize=8)
    tables.logarithmic(page.panels[0], 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20)
    noise, all_data = _of(clean, "all-data", "noise_mm", "x_bound")
    page.panels[0].plot(noise, np.array(all_data) * tables.GROWTH, ":", color=tables.PRINTED.colour)
    page.panels[0].annotate(
        "one seventh, says the paper", (10, all_data[-1] * tables.GROWTH), fontsize=7, ha="right",
        xytext=(0, -32), textcoords="offset points", color=tables.PRINTED.colour,
    )  # fmt: skip
    _lines(page.panels[4], gross, "workspace_rms", "workspace_bound")
    tables.logarithmic(page.panels[4], 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50)
    tables.dress(page.panels[4], "the same with 15 % gross outliers", "noise [mm]", "error [mm]")
    _key(page.panels[5])
    return page


def _lines(panel: Any, rows: Sequence[tables.Row], column: str, bound: str) -> None:
    for method, look in tables.METHOD_LOOKS.items():
        panel.plot(*_of(rows, method, "noise_mm", column), color=look.colour, linewidth=1.4)
    panel.plot(
        *_of(rows, "all-data", "noise_mm", bound), "--", color=tables.BOUND.colour, linewidth=1.0
    )


def _of(rows: Sequence[tables.Row], method: str, *names: str) -> list[list[float]]:
    return tables.columns((r for r in rows if r["method"] == method), *names)


def _key(panel: Any) -> None:
    """Turn the last panel into the legend of all."""
    for look in tables.METHOD_LOOKS.values():
        panel.plot([], [], color=look.colour, linewidth=2, label=look.label)
    panel.plot([], [], "--", color=tables.BOUND.colour, label=tables.BOUND.label)
    panel.set_axis_off()
    tables.legend(panel, loc="center left")

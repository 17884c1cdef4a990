"""Figure 10: calibration error by the number of poses, at 1 mm of noise."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flangeye_paper import tables
from flangeye_paper.fig9 import realised


def fig10(batches: tables.Batches, out: tables.OutOption = Path()) -> None:
    """Write fig10.csv, fig10_summary.csv and fig10.png.

    Args:
        batches: Folder with the batches fig10_<method>.
        out: Folder for the files.
    """
    rows = [
        {"method": method, "poses": int(session.number("steps.0.poses")), **realised(session)}
        for method in tables.METHOD_LOOKS
        for session in tables.read_sessions(batches / f"fig10_{method}")
        if session.accepted
    ]
    tables.write_csv(out / "fig10.csv", rows)
    tables.write_csv(
        out / "fig10_summary.csv", [_summary(rows, poses) for poses in (5, 10, 20, 40, 75)]
    )
    _draw(rows).save(out / "fig10.png")


def _summary(rows: Sequence[tables.Row], poses: int) -> dict[str, Any]:
    """Return the simulated errors in the paper's measure, and each method's error at the work."""
    here = {r["method"]: r for r in rows if r["poses"] == poses}
    oracle = here["algorithm-1-oracle"]
    printed = tables.with_units(oracle[f"{axis}_std"] for axis in tables.AXIS_COLOURS)
    at_work = {
        f"workspace rms mm: {look.label}": here.get(method, {}).get("workspace_rms")
        for method, look in tables.METHOD_LOOKS.items()
    }
    return {"poses": poses, **printed, **at_work, "bound mm": oracle["workspace_bound"]}


def _draw(rows: Sequence[tables.Row]) -> Any:
    page = tables.sheet(1, 3, 10.5, 3.4)
    oracle = [r for r in rows if r["method"] == "algorithm-1-oracle"]
    for panel, axes, unit in (
        (page.panels[0], [*tables.AXIS_COLOURS][:3], "mm"),
        (page.panels[1], [*tables.AXIS_COLOURS][3:], "deg"),
    ):
        for axis in axes:
            colour = tables.AXIS_COLOURS[axis]
            panel.plot(*tables.columns(oracle, "poses", f"{axis}_std"), color=colour, label=axis)
        tables.dress(
            panel, f"emulated as printed, in {unit}", "poses", f"standard deviation [{unit}]"
        )
        panel.set_ylim(bottom=0)
        tables.legend(panel)
    # Section 3.1: translational deviations [mm] after so many poses, at 1 mm of noise
    for poses, limit, above in ((10, 1.0, 3), (20, 0.2, -10)):
        page.panels[0].plot([poses, 75], [limit, limit], ":", color=tables.PRINTED.colour)
        page.panels[0].annotate(
            f"below {limit:g} mm within {poses}, says the paper", (poses, limit), fontsize=7,
            xytext=(2, above), textcoords="offset points", color=tables.PRINTED.colour,
        )  # fmt: skip
    _at_work(page.panels[2], rows)
    return page


def _at_work(panel: Any, rows: Sequence[tables.Row]) -> None:
    for method, look in tables.METHOD_LOOKS.items():
        mine = [r for r in rows if r["method"] == method]
        poses, rms = tables.columns(mine, "poses", "workspace_rms")
        panel.plot(poses, rms, color=look.colour, label=look.label)
    mine = [r for r in rows if r["method"] == "all-data"]
    poses, rms = tables.columns(mine, "poses", "workspace_bound")
    panel.plot(poses, rms, "--", color=tables.BOUND.colour, linewidth=1.0, label=tables.BOUND.label)
    tables.logarithmic(panel, 0.2, 0.5, 1, 2, 5)
    tables.dress(panel, "at the work: over the workspace, rms", "poses", "error [mm]")
    tables.legend(panel)

"""Table 1 and the Kinect row: errors of the calibration from all poses, measured by ICP."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flangeye_paper import tables

ICP, STORED = "verify.icp_as_in_paper", "verify.stored_results_as_in_paper"

NORMALS = {"open3d_0_7_normals": "defective normals", "sound": "sound normals"}


def table1(batches: tables.Batches, out: tables.OutOption = Path()) -> None:
    """Write table1.csv, table1_iterations.csv and table1.png.

    Args:
        batches: Folder with the batches table1_<recording> and table1_aubo-iterations.
        out: Folder for the files.
    """
    path = tables.read_sessions(batches / "table1_aubo-iterations")
    rows = [
        *_stored_rows("UR5 PhoXi M", batches / "table1_ur5"),
        _printed_row("UR10e PhoXi M", tables.TABLE_1["UR10e PhoXi M"]),
        *_stored_rows("Franka PhoXi M", batches / "table1_franka"),
        *_stored_rows("Aubo i5 PhoXi S", batches / "table1_aubo"),
        *(
            _icp_row("Aubo i5 PhoXi S", s, "")
            for s in tables.read_sessions(batches / "table1_aubo")
        ),
        *(_icp_row("Aubo i5 PhoXi S", s, ", converged") for s in path if _iterations(s) == 500),
        _printed_row("UR10e Azure Kinect", tables.TABLE_1["UR10e Azure Kinect"]),
        *(_kinect_row(s) for s in tables.read_sessions(batches / "table1_kinect")),
    ]
    tables.write_csv(out / "table1.csv", rows)
    tables.write_csv(out / "table1_iterations.csv", [_iteration_row(s) for s in path])
    _draw(path).save(out / "table1.png")


def _stored_rows(setup: str, batch: Path) -> list[tables.Row]:
    """Return the printed row, and what the authors' stored results imply."""
    found = tables.read_sessions(batch)[0].figures(STORED)
    row = _row(setup, "implied by their stored results", tables.printed_units(found), found)
    spread = tables.printed_units({axis: found[f"{axis}_std"] for axis in tables.AXIS_COLOURS})
    disagree = max(spread[axis] for axis in [*tables.AXIS_COLOURS][:3])
    return [
        _printed_row(setup, tables.TABLE_1[setup]),
        {**row, "at flange mm": None, "note": f"the 50 disagree by {disagree:.1f} mm"},
    ]


def _printed_row(setup: str, values: Sequence[float]) -> tables.Row:
    return _row(setup, "the paper", dict(zip(tables.AXIS_COLOURS, values, strict=True)), {})


def _icp_row(setup: str, session: tables.SessionRow, how: str) -> tables.Row:
    found = session.figures(ICP)
    what = NORMALS[session.row["steps.2.normals"]] + (how or ", stopped as published")
    return _row(
        setup, f"{what} ({found['iterations']:.0f} steps)", tables.printed_units(found), found
    )


def _kinect_row(session: tables.SessionRow) -> tables.Row:
    setup = "UR10e Azure Kinect"
    normals, distance = session.row["steps.2.normals"], session.row["steps.2.distance"]
    what = f"{NORMALS[normals]}, pairs within {distance} mm"
    if not session.accepted:
        return {
            **_row(setup, what, dict.fromkeys(tables.AXIS_COLOURS), {}),
            "note": session.row["reason"],
        }
    found = session.figures(ICP)
    return _row(setup, what, tables.printed_units(found), found)


def _row(
    setup: str, source: str, values: Mapping[str, float | None], found: Mapping[str, float]
) -> tables.Row:
    at_flange = [found[f"flange_{axis}"] * 1e3 for axis in "xyz"] if "flange_x" in found else None
    return {
        "setup": setup,
        "source": source,
        **tables.with_units(_signed(values[axis]) for axis in tables.AXIS_COLOURS),
        "at flange mm": None if at_flange is None else float(np.linalg.norm(at_flange)),
        "note": None,
    }


def _signed(value: float | None) -> str | None:
    return None if value is None else f"{value:+.3f}"


def _iterations(session: tables.SessionRow) -> int:
    return int(session.number("steps.2.iterations"))


def _iteration_row(session: tables.SessionRow) -> tables.Row:
    found = session.figures(ICP)
    values = tables.printed_units(found)
    return {
        "normals": session.row["steps.2.normals"],
        "iterations": _iterations(session),
        **{axis: values[axis] for axis in tables.AXIS_COLOURS},
        "rms": found["rms"] * 1e3,
    }


def _draw(path: Sequence[tables.SessionRow]) -> Any:
    page = tables.sheet(1, 3, 10.5, 3.2)
    rows = [_iteration_row(session) for session in path]
    for panel, axis in zip(page.panels, "xyz", strict=True):
        for normals, label in NORMALS.items():
            mine = sorted(
                (r for r in rows if r["normals"] == normals), key=lambda r: r["iterations"]
            )
            steps, values = [r["iterations"] for r in mine], [r[axis] for r in mine]
            colour = "#1d4ed8" if normals == "sound" else "#d97706"
            panel.plot(steps, values, ".-", color=colour, label=label)
        panel.axvline(5, color="#94a3b8", linewidth=1, linestyle=":")
        value = tables.TABLE_1["Aubo i5 PhoXi S"]["xyz".index(axis)]
        panel.plot([5], [value], "D", color=tables.PRINTED.colour, label="Table 1, after 5 steps")
        panel.set_xscale("log")
        tables.dress(panel, f"{axis} of the Aubo's verification", "steps of ICP", f"{axis} [mm]")
    page.panels[0].set_ylim(bottom=-0.95)  # room for the key below the lines
    tables.legend(page.panels[0], loc="lower right")
    return page

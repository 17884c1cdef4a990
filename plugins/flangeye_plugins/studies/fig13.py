"""Figure 13 and what the paper does not measure: how far the torch is from the true seam."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye import FlangeyeError
from flangeye.runlog import read_run
from flangeye.seamline import torch_deviation
from flangeye.types import WeldReport, WorkpieceScan
from flangeye_plugins.studies.drawing import dress, legend, sheet
from flangeye_plugins.studies.tables import Row, Session, read_sessions, write_csv

Floats = NDArray[np.float64]

WORKPIECES = ("straight", "curved")
GAP = (0.09, 0.11)
"""Where the wall is missing in the batches fig13-gap [m]."""

MODE = "steps.5.mode"
PATHS = (("robot", "#d97706"), ("tip", "#1d4ed8"), ("torch", "#be123c"))


def fig13(batches: Path, out: Path) -> None:
    """Write fig13.csv and fig13.png.

    Args:
        batches: Folder with the batches fig13_…, fig13-others_…, fig13-gap_…, fig13-across_….
        out: Folder for the files.
    """
    rows = [row for workpiece in WORKPIECES for row in _rows(batches, workpiece)]
    write_csv(out / "fig13.csv", rows)
    _draw(batches).save(out / "fig13.png")


def _rows(batches: Path, workpiece: str) -> Iterable[Row]:
    plain = read_sessions(batches / f"fig13_{workpiece}")
    yield _row(workpiece, "by touch", plain)
    others = read_sessions(batches / f"fig13-others_{workpiece}")
    for mode, name in (("vision", "the plan alone"), ("as_printed", "Algorithm 2 as printed")):
        yield _row(workpiece, name, [s for s in others if s.row[MODE] == mode])
    gap = read_sessions(batches / f"fig13-gap_{workpiece}")
    yield _row(workpiece, "by touch, 20 mm of wall missing: there", gap, GAP)
    across = read_sessions(batches / f"fig13-across_{workpiece}")
    yield _row(workpiece, "by touch, started across the seam: from 160 mm on", across, (0.16, 1.0))


def _row(
    workpiece: str, name: str, sessions: Sequence[Session], part: tuple[float, float] = (0.0, 1.0)
) -> Row:
    """Return the figures over all sessions, of a part of the seam by arc length [m]."""
    welds = [_weld(session) for session in sessions]
    found = [_deviation(weld, truth, part) for weld, truth in welds]
    every = np.concatenate(found)
    return {
        "workpiece": workpiece,
        "followed": name,
        "welds": str(len(welds)),
        "to the end": str(sum(weld.completed for weld, _ in welds)),
        "rms mm": f"{np.sqrt(np.mean(every**2)) * 1e3:.3f}",
        "worst weld's rms mm": f"{max(np.sqrt(np.mean(e**2)) for e in found) * 1e3:.3f}",
        "largest mm": f"{every.max() * 1e3:.3f}",
        "turn rate deg/s": f"{np.degrees(max(np.abs(w.turn).max() for w, _ in welds)):.1f}",
    }


def _weld(session: Session) -> tuple[WeldReport, Floats]:
    """Return the weld of a session and the true seam (N, 3)."""
    log = read_run(session.folder / "run.mcap")
    weld, scan = log.last(WeldReport), log.last(WorkpieceScan)
    if weld is None or scan is None:
        raise FlangeyeError(f"{session.folder}: did not weld")
    (truth,) = scan.truth.values()
    return weld, np.asarray(truth)


def _deviation(weld: WeldReport, truth: Floats, part: tuple[float, float]) -> Floats:
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth, axis=0), axis=1))])
    inside = (along >= part[0]) & (along <= part[1])
    return torch_deviation(weld.torch, truth[inside], weld.opening)


def _draw(batches: Path) -> Any:
    """Draw the paths in the plane, and the torch's distance from the true seam, by workpiece."""
    page = sheet(2, 2, 9.0, 5.4)
    for column, workpiece in enumerate(WORKPIECES):
        weld, truth = _weld(read_sessions(batches / f"fig13_{workpiece}")[0])
        _paths(page.panels[column], workpiece, weld, truth)
        _distance(page.panels[2 + column], batches, workpiece)
    legend(page.panels[0], loc="lower right", ncols=2)
    legend(page.panels[2], loc="upper right")
    return page


def _paths(panel: Any, workpiece: str, weld: WeldReport, truth: Floats) -> None:
    start, x = truth[0], truth[-1] - truth[0]
    x = x / np.linalg.norm(x)
    axes = np.stack([x, np.cross(weld.opening, x)], axis=1) * 1e3
    panel.plot(*((truth - start) @ axes).T, color="black", linewidth=2.5, label="true seam")
    panel.plot(*((weld.planned - start) @ axes).T, color="#64748b", ls=":", label="planned")
    for name, colour in PATHS:
        at = (getattr(weld, name) - start) @ axes
        panel.plot(*at.T, color=colour, linewidth=1.0, label=name)
    dress(panel, f"paths, {workpiece} groove", "along [mm]", "across [mm]")


def _distance(panel: Any, batches: Path, workpiece: str) -> None:
    others = read_sessions(batches / f"fig13-others_{workpiece}")
    shown = [
        ("by touch", "#be123c", read_sessions(batches / f"fig13_{workpiece}")),
        ("the plan alone", "#64748b", [s for s in others if s.row[MODE] == "vision"]),
        ("as printed", "#d97706", [s for s in others if s.row[MODE] == "as_printed"]),
    ]
    for name, colour, sessions in shown:
        for i, session in enumerate(sessions):
            weld, truth = _weld(session)
            off = _deviation(weld, truth, (0.0, 1.0)) * 1e3
            at = np.linspace(0, np.linalg.norm(truth[-1] - truth[0]) * 1e3, len(off))
            panel.plot(at, off, color=colour, linewidth=0.8, label=None if i else name)
    panel.set_yscale("log")
    panel.set_ylim(1e-3, 1e2)
    dress(panel, "torch from the true seam", "along [mm]", "distance [mm]")

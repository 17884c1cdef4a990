"""Figure 13, and a quantity the paper does not measure: the torch's distance from the true seam."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flangeye import FlangeyeError
from flangeye.maths.seam_geometry import WeldPlane, torch_deviation
from flangeye.types import Floats, WeldReport, WorkpieceScan
from flangeye.types.geometry import arc_lengths
from flangeye.workflow.log.read import read_run
from flangeye_paper import tables

WORKPIECES = ("straight", "curved")
FOLLOWED = {
    "touch": "by touch", "plan": "the plan alone", "printed": "Algorithm 2 as printed",
    "across": "by touch, started across the seam: from 160 mm on",
    "bridged": "by touch, 20 mm of wall missing: there",
}  # fmt: skip
"""Ways of following a seam."""


@dataclass(frozen=True, eq=False)
class SeenWeld:
    """A simulated weld with its truth.

    Attributes:
        report: Report of the weld from its log.
        truth: (N, 3) the true seam in base [m].
    """

    report: WeldReport
    truth: Floats

    @property
    def torch(self) -> Floats:
        """True positions (K, 3) of the torch in base [m]; estimated ones without truth."""
        return self.report.true_torch if len(self.report.true_torch) else self.report.torch

    def deviation(self, part: tuple[float, float] = (0.0, np.inf)) -> Floats:
        """Return the torch's distances from the true seam, on a part of it by arc length [m]."""
        along = arc_lengths(self.truth)
        inside = (along >= part[0]) & (along <= part[1])
        return torch_deviation(self.torch, self.truth[inside], self.report.opening)

    @property
    def regained(self) -> bool:
        """Whether contact was lost, and regained later."""
        phases = self.report.phases
        return "bridging" in phases and "following" in phases[phases.index("bridging") :]

    @property
    def recovery(self) -> float:
        """Way of the tip until the torch stays near the seam [m]."""
        _, off = self._seen(self.torch)
        tip, _ = self._seen(self.report.robot)
        # A torch this near to the seam is back on it [m]
        away = np.flatnonzero(np.abs(off) > 0.4e-3)
        return float(tip[away[-1]] - tip[0]) if len(away) else 0.0

    @property
    def end_step(self) -> float:
        """Largest step across the seam of torch, tip and robot, near the end and after it [m].

        A weld that never came there has none.
        """
        along, _ = self._seen(self.report.robot)
        # Where the seam's end begins to matter [m]
        leaving = along > arc_lengths(self.truth)[-1] - 20e-3
        time = self.report.time[leaving]
        if not len(time):
            return 0.0
        step_time = 0.1  # within this time [s]
        both = time + step_time <= time[-1]
        paths = (self.torch, self.report.tip, self.report.robot)
        laterals = [self._seen(path)[1][leaving] for path in paths]
        steps = [np.abs(np.interp(time + step_time, time, off) - off)[both] for off in laterals]
        return float(np.max(steps, initial=0.0))

    def _seen(self, points: Floats) -> tuple[Floats, Floats]:
        """Return arc lengths (K,) and offsets to the left (K,) of points (K, 3) [m]."""
        plane = WeldPlane(self.truth, self.report.opening)
        return plane.beside(self.truth, points)


def seen(session: tables.SessionRow) -> SeenWeld:
    """Return the weld of a session.

    Raises:
        FlangeyeError: The session ended before the weld.
    """
    log = read_run(session.folder / "run.mcap")
    weld, scan = log.last(WeldReport), log.last(WorkpieceScan)
    if weld is None or scan is None:
        raise FlangeyeError(f"{session.folder}: did not weld")
    (truth,) = scan.truth.values()
    return SeenWeld(weld, np.asarray(truth))


Welds = Mapping[str, Sequence[SeenWeld]]
"""Welds by the method that followed the seam."""


def fig13(batches: tables.Batches, out: tables.OutOption = Path()) -> None:
    """Write fig13.csv and fig13.png.

    Args:
        batches: Folder with the batches fig13_…, fig13-others_…, fig13-gap_…, fig13-across_….
        out: Folder for the files.
    """
    welds = {name: _welds(batches, name) for name in WORKPIECES}
    tables.write_csv(
        out / "fig13.csv", [row for name in WORKPIECES for row in _rows(name, welds[name])]
    )
    _draw(welds).save(out / "fig13.png")


def _welds(batches: Path, workpiece: str) -> Welds:
    """Return the welds of a workpiece by the method that followed the seam."""
    others = tables.read_sessions(batches / f"fig13-others_{workpiece}")
    mode = "steps.5.mode"
    sessions = {
        "touch": tables.read_sessions(batches / f"fig13_{workpiece}"),
        "plan": [s for s in others if s.row[mode] == "vision"],
        "printed": [s for s in others if s.row[mode] == "as_printed"],
        "across": tables.read_sessions(batches / f"fig13-across_{workpiece}"),
        "bridged": tables.read_sessions(batches / f"fig13-gap_{workpiece}"),
    }
    return {name: [seen(session) for session in listed] for name, listed in sessions.items()}


def _rows(workpiece: str, welds: Welds) -> Iterable[tables.Row]:
    for name, listed in welds.items():
        yield {"workpiece": workpiece, "followed": FOLLOWED[name], **_figures(name, listed)}


def _figures(name: str, welds: Sequence[SeenWeld]) -> tables.Row:
    """Return the figures over all welds that were followed in one way."""
    # By arc length [m]: after four tool lengths; in the gap
    part = {"across": (0.16, np.inf), "bridged": (0.09, 0.11)}.get(name, (0.0, np.inf))
    # A weld that was stopped before its torch came there has none.
    found = [off for weld in welds if len(off := weld.deviation(part))]
    every = np.concatenate(found)
    touched = name not in ("plan", "printed")
    return {
        "welds": str(len(welds)),
        "to the end": str(sum(weld.report.completed for weld in welds)),
        "rms mm": _mm(np.sqrt(np.mean(every**2))),
        "worst weld's rms mm": _mm(max(np.sqrt(np.mean(e**2)) for e in found)),
        "largest mm": _mm(every.max()),
        "turn rate deg/s": f"{np.degrees(max(np.abs(w.report.turn).max() for w in welds)):.1f}",
        "step at the end mm": _mm(max(w.end_step for w in welds)) if touched else "",
        "back on the seam after mm": (
            f"{max(w.recovery for w in welds) * 1e3:.0f}" if name == "across" else ""
        ),
        "contact regained": str(sum(w.regained for w in welds)) if name == "bridged" else "",
    }


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.3f}"


def _draw(welds: Mapping[str, Welds]) -> Any:
    """Draw the paths in the plane, and the torch's distance from the true seam, by workpiece."""
    page = tables.sheet(2, 2, 9.0, 5.4)
    for column, workpiece in enumerate(WORKPIECES):
        _paths(page.panels[column], workpiece, welds[workpiece]["touch"][0])
        _distance(page.panels[2 + column], welds[workpiece])
    tables.legend(page.panels[0], loc="lower right", ncols=2)
    tables.legend(page.panels[2], loc="upper right")
    return page


def _paths(panel: Any, workpiece: str, weld: SeenWeld) -> None:
    report, truth = weld.report, weld.truth
    flat = WeldPlane(truth, report.opening).flat
    panel.plot(*flat(truth).T * 1e3, color="black", linewidth=2.5, label="true seam")
    panel.plot(*flat(report.planned).T * 1e3, color="#64748b", ls=":", label="planned")
    for name, colour in (("robot", "#d97706"), ("tip", "#1d4ed8"), ("torch", "#be123c")):
        at = flat(getattr(report, name)) * 1e3
        panel.plot(*at.T, color=colour, linewidth=1.0, label=name)
    tables.dress(panel, f"paths, {workpiece} groove", "along [mm]", "across [mm]")


def _distance(panel: Any, welds: Welds) -> None:
    for name, colour in (("touch", "#be123c"), ("plan", "#64748b"), ("printed", "#d97706")):
        for i, weld in enumerate(welds[name]):
            off = weld.deviation() * 1e3
            length = np.linalg.norm(weld.truth[-1] - weld.truth[0]) * 1e3
            at = np.linspace(0, length, len(off))
            panel.plot(at, off, color=colour, linewidth=0.8, label=None if i else FOLLOWED[name])
    panel.set_yscale("log")
    panel.set_ylim(1e-3, 1e2)
    tables.dress(panel, "torch from the true seam", "along [mm]", "distance [mm]")

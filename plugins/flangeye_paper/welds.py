"""What a weld in a batch did, measured against the true seam: for the study alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye import FlangeyeError
from flangeye.log.read import read_run
from flangeye.maths.seam_geometry import torch_deviation
from flangeye.types import Floats, WeldReport, WorkpieceScan
from flangeye_paper.tables import SessionRow

BEYOND = 0.2
"""The true seam is extended straight by this much, for what happens before and after it [m]."""


STEP = 0.1
"""A lateral step is what happens across the seam within this time [s]."""


@dataclass(frozen=True, eq=False)
class SeenWeld:
    """A weld and the truth.

    Attributes:
        report: What was logged of it.
        truth: (N, 3) the true seam, in base [m].
    """

    report: WeldReport
    truth: Floats

    @property
    def torch(self) -> Floats:
        """(K, 3) where the torch really was, in base [m]; as believed in logs that do not say."""
        return self.report.true_torch if len(self.report.true_torch) else self.report.torch

    def deviation(self, part: tuple[float, float] = (0.0, np.inf)) -> Floats:
        """Return the torch's distances from the true seam, on a part of it by arc length [m]."""
        along = _arc_length(self.truth)
        inside = (along >= part[0]) & (along <= part[1])
        return torch_deviation(self.torch, self.truth[inside], self.report.opening)

    @property
    def regained(self) -> bool:
        """Whether contact was lost, and regained later."""
        phases = self.report.phases
        return "bridging" in phases and "following" in phases[phases.index("bridging") :]

    @property
    def recovery(self) -> float:
        """How far the tip went until the torch was near the seam for good [m]."""
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
        leaving = along > _arc_length(self.truth)[-1] - 20e-3
        time = self.report.time[leaving]
        if not len(time):
            return 0.0
        both = time + STEP <= time[-1]
        paths = (self.torch, self.report.tip, self.report.robot)
        laterals = [self._seen(path)[1][leaving] for path in paths]
        steps = [np.abs(np.interp(time + STEP, time, off) - off)[both] for off in laterals]
        return float(np.max(steps, initial=0.0))

    def _seen(self, points: Floats) -> tuple[Floats, Floats]:
        """Return arc lengths (K,) of points (K, 3) and how far they are to the left (K,) [m]."""
        line = np.vstack([
            self.truth[0] - BEYOND * _unit(self.truth[1] - self.truth[0]),
            self.truth,
            self.truth[-1] + BEYOND * _unit(self.truth[-1] - self.truth[-2]),
        ])  # fmt: skip
        start, step = line[:-1], np.diff(line, axis=0)
        lengths = np.linalg.norm(step, axis=1)
        ahead = step / lengths[:, None]
        left = np.cross(self.report.opening, ahead)
        away = points[:, None] - start
        along = np.clip(np.einsum("kni,ni->kn", away, ahead), 0.0, lengths)
        distance = np.linalg.norm(_flat(away - along[..., None] * ahead, self.report), axis=2)
        nearest = distance.argmin(axis=1)
        rows = np.arange(len(points))
        arc = np.concatenate([[0.0], np.cumsum(lengths)])[nearest] + along[rows, nearest] - BEYOND
        return arc, np.einsum("ki,ki->k", away[rows, nearest], left[nearest])


def seen(session: SessionRow) -> SeenWeld:
    """Return the weld of a session.

    Raises:
        FlangeyeError: It did not get so far.
    """
    log = read_run(session.folder / "run.mcap")
    weld, scan = log.last(WeldReport), log.last(WorkpieceScan)
    if weld is None or scan is None:
        raise FlangeyeError(f"{session.folder}: did not weld")
    (truth,) = scan.truth.values()
    return SeenWeld(weld, np.asarray(truth))


def _flat(vectors: Floats, report: WeldReport) -> Floats:
    """Return vectors (..., 3) without what lies along the opening."""
    return np.asarray(vectors - (vectors @ report.opening)[..., None] * report.opening)


def _arc_length(line: Floats) -> Floats:
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector))

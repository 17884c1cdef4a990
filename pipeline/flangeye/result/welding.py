"""The sections about the seam and the weld."""

from __future__ import annotations

import numpy as np

from flangeye import types as t
from flangeye.maths.seam_geometry import errors_from, torch_deviation, tube_radii
from flangeye.maths.statistics import rms
from flangeye.result.contract import SeamResult, SeamTruthResult, WeldResult, WeldTruthResult


def seam_result(seam: t.Seam | None, scan: t.WorkpieceScan | None) -> SeamResult | None:
    """Return the section ``seam``."""
    if seam is None:
        return None
    return SeamResult(
        source=seam.source,
        length=float(seam.arc_length[-1]),
        points=seam.points_in_base.tolist(),
        openings=seam.openings_in_base.tolist(),
        covariance=seam.covariance.tolist(),
        tube=tube_radii(seam).tolist(),
        half_angle=seam.half_angle,
        half_width=seam.half_width,
        figures=dict(seam.figures),
        notes=list(seam.notes),
        truth=_seam_truth(seam, list(scan.truth.values())) if scan and scan.truth else None,
    )


def _seam_truth(seam: t.Seam, true_seams: list[t.Array]) -> SeamTruthResult:
    """Compare with the true seam that is nearest: a workpiece may have several."""
    errors = min((errors_from(seam, truth) for truth in true_seams), key=lambda e: float(e.max()))
    return SeamTruthResult(
        rms=rms(errors),
        max=float(errors.max()),
        inside=float(np.mean(errors <= tube_radii(seam))),
    )


def weld_result(weld: t.WeldReport | None, scan: t.WorkpieceScan | None) -> WeldResult | None:
    """Return the section ``weld``."""
    if weld is None:
        return None
    ticks = np.diff(weld.time, append=weld.time[-1:])
    names = np.array(weld.phases)
    correction = torch_deviation(weld.refined, weld.planned, weld.opening)
    return WeldResult(
        mode=weld.mode,
        completed=weld.completed,
        reason=weld.reason,
        seconds=float(weld.time[-1]) if len(weld.time) else 0.0,
        correction_rms=rms(correction) if len(correction) else None,
        phases={name: float(ticks[names == name].sum()) for name in dict.fromkeys(weld.phases)},
        figures=dict(weld.figures),
        truth=_weld_truth(weld, list(scan.truth.values())) if scan and scan.truth else None,
    )


def _weld_truth(weld: t.WeldReport, true_seams: list[t.Array]) -> WeldTruthResult | None:
    """Compare with the true seam that is nearest, where the torch was between its ends.

    Not while the tip still feels for the groove, and not before the torch was near enough to the
    seam to be lit: that of a weld that is gone on with comes back to the seam first, unlit. Passes
    after the root's are beside the seam, as they were asked to be.
    """
    torch = weld.true_torch if len(weld.true_torch) else weld.torch
    welds = ~np.isin(weld.phases, ("seeking", "probing", "returning", "passing"))
    torch = torch[welds & (weld.along >= weld.figures.get("lit_from", 0.0) - 1e-9)]
    found = [torch_deviation(torch, truth, weld.opening) for truth in true_seams]
    errors = min((e for e in found if len(e)), key=lambda e: float(e.max()), default=None)
    return None if errors is None else WeldTruthResult(rms=rms(errors), max=float(errors.max()))

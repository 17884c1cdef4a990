"""A marker that was printed in another size than the recipe says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flangeye import part
from flangeye.diagnosis import Finding, Findings, Floats, Session
from flangeye_plugins.doctoring.asis import fit_of
from flangeye_plugins.doctoring.significance import best_of, exceedance

NEGLIGIBLE_SCALE = 5e-3
"""A printer is no better, and nobody measures a marker with less care."""


@part("check.size")
def size(session: Session) -> Findings:
    """The marker's distances are all too long or too short by one factor: its size is wrong."""
    if not np.isfinite(session.rotations).any():
        return
    null = fit_of(session)
    factor = _factor(session, null.unknowns.rotation[0])
    if not 0.2 < factor < 5:
        return
    mended = replace(session, centres=session.centres * factor)
    found = fit_of(mended)
    evidence = best_of(null, found, 1)
    ratio, count = float(found.likelihood[0] - null.likelihood[0]), float(null.count[0])
    effect = abs(np.log(factor)) / NEGLIGIBLE_SCALE
    p = exceedance(ratio, count, 1, count - found.parameters - 1, effect)
    if p < 1:
        what = f"the marker is {factor:.4f} times as large as the recipe says"
        fix = f"measure it after printing: its lengths in the fit step times {factor:.4f}"
        yield Finding("target size", what, fix, (), evidence.before, evidence.after, p,
                      evidence.gain, mended)  # fmt: skip


def _factor(session: Session, rotation: Floats) -> float:
    """Return by how much the marker's positions must grow; linear once the rotation is known."""
    from flangeye_plugins.doctoring.equations import mounts_of

    seen = session.seen
    mounts = mounts_of(session, session.poses)[seen]
    turned = session.centres[seen] @ rotation.T
    eye = np.broadcast_to(np.eye(3), (len(turned), 3, 3))
    rows = np.concatenate([turned[..., None], eye, -mounts[:, :3, :3]], axis=-1).reshape(-1, 7)
    return float(np.linalg.lstsq(rows, mounts[:, :3, 3].ravel(), rcond=1e-10)[0][0])

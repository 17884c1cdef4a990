"""A marker that was printed in another size than the recipe says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flangeye import part
from flangeye.doctor.diagnosis import Findings, NotApplicable, RecordedSession
from flangeye_plugins.check.as_recorded import fit_of
from flangeye_plugins.check.equations import equations_of
from flangeye_plugins.check.fitting import VariantFits
from flangeye_plugins.check.held_out import explained
from flangeye_plugins.check.significance import best_of, exceedance

NEGLIGIBLE_SCALE = 5e-3
"""A printer is no better, and nobody measures a marker with less care."""


@part("check.size")
def size(session: RecordedSession) -> Findings:
    """The marker's distances are all too long or too short by one factor: its size is wrong."""
    session.require_samples()
    if not np.isfinite(session.rotations).any():
        raise NotApplicable("no marker's whole pose was measured")
    null = fit_of(session)
    factor = _factor(session, null)
    if not 0.2 < factor < 5:
        return
    corrected_session = replace(session, centres=session.centres * factor)
    found = fit_of(corrected_session)
    evidence = best_of(null, found, 1)
    ratio, count = float(found.likelihood[0] - null.likelihood[0]), float(null.count[0])
    effect = abs(np.log(factor)) / NEGLIGIBLE_SCALE
    p = exceedance(ratio, count, 1, count - found.parameters - 1, effect)
    if p < 1 and explained(corrected_session):
        what = f"the marker is {factor:.4f} times as large as the recipe says"
        fix = f"measure it after printing: its lengths in the fit step times {factor:.4f}"
        if session.acquire == "acquire.samples":
            fix = session.read_with(target_scale=float(f"{factor:.4f}")).step()
        evidence = evidence._replace(probability=p)
        yield evidence.finding("target size", what, corrected_session, fix)


def _factor(session: RecordedSession, null: VariantFits) -> float:
    """Return by how much the marker's positions must grow; linear once the rotations are known."""
    seen, equations = session.seen, equations_of(session)
    turned = session.centres[seen] @ null.unknowns.rotation[0].T
    mounts = equations.carried(null.unknowns.other)[0][seen]
    eye = np.broadcast_to(np.eye(3), (len(turned), 3, 3))
    parts, right = [turned[..., None], eye, -mounts[:, :3, :3]], mounts[:, :3, 3]
    if equations.bases is not None:
        # The second arm's base moves too: what it is now comes off, and is found again.
        bases = equations.bases[0, seen, :3, :3]
        parts.append(-bases)
        right = right - (bases @ null.unknowns.other[0, :3, 3])
    rows = np.concatenate(parts, axis=-1).reshape(len(right) * 3, -1)
    return float(np.linalg.lstsq(rows, right.ravel(), rcond=1e-10)[0][0])

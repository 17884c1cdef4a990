"""Single samples that are wrong, and targets that were seen turned over."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flangeye import part
from flangeye.doctor.diagnosis import Findings, NotApplicable, RecordedSession
from flangeye.maths.geometry import rotation_exp
from flangeye.types import Floats
from flangeye_plugins.check.equations import equations_of
from flangeye_plugins.check.fitting import VariantFits, fit, fit_of
from flangeye_plugins.check.significance import Significance, best_of, exceedance, negligible

FLIPS: dict[str, Floats] = {
    "half a turn about its x": rotation_exp(np.array([np.pi, 0, 0])),
    "half a turn about its y": rotation_exp(np.array([0, np.pi, 0])),
    "half a turn about its normal": rotation_exp(np.array([0, 0, np.pi])),
    "a quarter turn about its normal": rotation_exp(np.array([0, 0, np.pi / 2])),
    "a quarter turn back about its normal": rotation_exp(np.array([0, 0, -np.pi / 2])),
}
NEAR = 0.2
"""A flip explains a rotation that is within this of it [rad]."""
MOST = 0.5
"""If more of the samples are wrong, it is not they."""


@part("check.outlier")
def outlier(session: RecordedSession) -> Findings:
    """One sample disagrees with all the others."""
    session.require_samples()
    null = fit_of(session)
    distances = ((null.lengths[0] / null.scales[0]) ** 2).sum(axis=-1)
    index = int(np.nanargmax(distances))
    evidence = _without(session, null, index)
    if evidence.probability == 1:
        return
    name = session.ids[index]
    distance = float(null.lengths[0, index, 0])
    what = f"'{name}' is {distance * 1e3:.1f} mm off where the others agree"
    corrected_session = session.without(np.arange(len(session)) == index)
    yield evidence.finding("outlier", what, corrected_session, samples=(name,))


def _without(session: RecordedSession, null: VariantFits, index: int) -> Significance:
    """Hold "this sample has an error of its own" against the session as it is."""
    freed = fit(equations_of(session).without(np.arange(len(session))[None] == index))
    dimensions = _dimensions(null)
    # An error of its own takes up all that the sample says; what is left of it is the scales.
    own = -float((dimensions * np.log(freed.scales[0])).sum())
    ratio = float(freed.likelihood[0] - null.likelihood[0]) + own
    count, further = float(null.count[0]), int(dimensions.sum())
    freedom = count - null.parameters - further
    effect = float((null.lengths[0, index] / negligible(len(dimensions))).max())
    tried = int(session.seen.sum())
    p = min(1.0, tried * exceedance(ratio, count, further, freedom, effect))
    gain = ratio - 0.5 * further * np.log(count) - np.log(tried)
    return Significance(index, null.misfit(), freed.misfit(), p, gain)


def _dimensions(null: VariantFits) -> Floats:
    """Return (B,) how many coordinates each kind of error has, from how many there are in all."""
    rest = int(null.count[0] / np.isfinite(null.lengths[0, :, 0]).sum()) - 3
    return np.array([3.0, rest]) if len(null.residuals) > 1 else np.array([3.0])


@part("check.flips")
def flips(session: RecordedSession) -> Findings:
    """Some targets were seen turned over, as a symmetric or frontal one may be."""
    session.require_samples()
    if not np.isfinite(session.rotations).any():
        raise NotApplicable("no marker's whole pose was measured")
    null = fit_of(session)
    which = _flipped(session, null)
    if not (which >= 0).any() or (which >= 0).sum() > MOST * session.seen.sum():
        return
    turned = np.array(session.rotations)
    for index, flip in zip(np.flatnonzero(which >= 0), which[which >= 0], strict=True):
        turned[index] = turned[index] @ list(FLIPS.values())[flip]
    corrected_session = replace(session, rotations=turned)
    changed = int((which >= 0).sum())
    evidence = best_of(
        null, fit_of(corrected_session), 3 * changed, tried=len(FLIPS) * len(session)
    )
    if evidence.probability == 1:
        return
    names = tuple(n for n, w in zip(session.ids, which, strict=True) if w >= 0)
    kinds = " or ".join(list(FLIPS)[flip] for flip in np.unique(which[which >= 0]))
    what = f"{changed} of {len(session)} targets were seen with {kinds}"
    kept = session.without(which >= 0)
    fix = f"{kept.step()}  # or a target without that symmetry"
    yield evidence.finding("target flips", what, kept, fix, names)


def _flipped(
    session: RecordedSession, null: VariantFits
) -> np.ndarray[tuple[int, ...], np.dtype[np.intp]]:
    """Return (N,) which flip each sample shows, -1 for none."""
    unknowns = null.unknowns
    mounts = equations_of(session).carried(unknowns.other)[0, :, :3, :3]
    expected = mounts @ unknowns.turn[0]
    seen = unknowns.rotation[0] @ session.rotations
    apart = seen.swapaxes(-1, -2) @ expected
    candidates = np.stack(list(FLIPS.values()))
    cosines = (np.einsum("nij,fij->nf", apart, candidates) - 1) / 2
    best = np.argmax(cosines, axis=1)
    near = cosines[np.arange(len(best)), best] > np.cos(NEAR)
    return np.where(near, best, -1)

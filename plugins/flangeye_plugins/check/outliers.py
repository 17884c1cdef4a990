"""Checks for single wrong samples, targets detected with a flipped rotation, and missing motion."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from flangeye import part
from flangeye.types import Floats
from flangeye.types.geometry import levers, rotation_exp, rotation_log
from flangeye.workflow.doctor.diagnosis import Finding, Findings, NotApplicable, RecordedSession
from flangeye_plugins.check.equations import equations_of
from flangeye_plugins.check.fitting import (
    Significance,
    VariantFits,
    best_of,
    covariance_of,
    exceedance,
    fit,
    fit_of,
    negligible,
    offset_left_open,
)

FLIPS: dict[str, Floats] = {
    "half a turn about its x": rotation_exp(np.array([np.pi, 0, 0])),
    "half a turn about its y": rotation_exp(np.array([0, np.pi, 0])),
    "half a turn about its normal": rotation_exp(np.array([0, 0, np.pi])),
    "a quarter turn about its normal": rotation_exp(np.array([0, 0, np.pi / 2])),
    "a quarter turn back about its normal": rotation_exp(np.array([0, 0, -np.pi / 2])),
}


@part("check.outlier")
def outlier(session: RecordedSession) -> Findings:
    """Find a sample that disagrees with all the others."""
    session.require_samples()
    null = fit_of(session)
    distances = ((null.lengths[0] / null.scales[0]) ** 2).sum(axis=-1)
    index = int(np.nanargmax(distances))
    evidence = _without(session, null, index)
    if evidence.probability == 1:
        return
    name = session.ids[index]
    distance, *turns = null.lengths[0, index].tolist()
    turned = "".join(f" and {np.degrees(turn):.2g} deg" for turn in turns)
    what = f"'{name}' is {distance * 1e3:.1f} mm{turned} off the calibration of all others"
    corrected_session = session.without(np.arange(len(session)) == index)
    yield evidence.finding("outlier", what, corrected_session, samples=(name,))


def _without(session: RecordedSession, null: VariantFits, index: int) -> Significance:
    """Test the hypothesis that one sample has an error of its own against the unchanged session."""
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
    """Return the number of coordinates (B,) of each kind of error in one sample."""
    rest = int(null.count[0] / np.isfinite(null.lengths[0, :, 0]).sum()) - 3
    return np.array([3.0, rest]) if len(null.residuals) > 1 else np.array([3.0])


@part("check.flips")
def flips(session: RecordedSession) -> Findings:
    """Find targets that were detected turned over, as symmetric or frontal ones may be."""
    session.require_samples()
    if not np.isfinite(session.rotations).any():
        raise NotApplicable("no marker's whole pose was measured")
    null = fit_of(session)
    which = _flipped(session, null)
    # If more of the samples are wrong, it is not they
    largest_share = 0.5
    if not (which >= 0).any() or (which >= 0).sum() > largest_share * session.seen.sum():
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


@part("check.scatter")
def scatter(session: RecordedSession) -> Findings:
    """Find markers' rotations that scatter although their positions fit."""
    session.require_samples()
    if not np.isfinite(session.rotations).any():
        raise NotApplicable("no marker's whole pose was measured")
    misfit = fit_of(session).misfit()
    # More than verify.holdout lets pass [rad]
    if misfit.angle is None or misfit.angle < np.radians(2.0) or misfit.position > session.limit:
        return
    if np.isfinite(session.places).all():
        what = (
            f"the body's rotations scatter by {np.degrees(misfit.angle):.1f} deg about one "
            f"calibration, which its positions fit to {misfit.position * 1e3:.2g} mm: it is on "
            "another part of the arm than the recipe says, or it turns against that part"
        )
        fix = "target: {at: …} names what carries the body: flange, link1, link2, …"
        yield Finding("body rotations", what, fix, gain=0.0)
        return
    what = (
        f"the markers' rotations scatter by {np.degrees(misfit.angle):.1f} deg about one "
        f"calibration, which their positions fit to {misfit.position * 1e3:.2g} mm: detect the "
        "marker again, larger or sharper in the image, or use its positions alone"
    )
    alone = _positions_alone(session)
    fix = alone.step() if alone else "acquire.centres reads positions"
    # Whatever explains the rotations comes first
    yield Finding("marker rotations", what, fix, gain=0.0, corrected_session=alone)


def _positions_alone(session: RecordedSession) -> RecordedSession | None:
    """Return the session with the markers' positions alone; None unless they are from a table."""
    table = {} if isinstance(session.reader, str) else session.reader.get("table", {})
    target = table.get("target")
    if not isinstance(target, Mapping) or "columns" not in target:
        return None
    about = {key: value for key, value in target.items() if key != "angle"}
    point = {**about, "rotation": "point", "columns": target["columns"][:3]}
    return replace(
        session,
        rotations=np.full_like(session.rotations, np.nan),
        acquire="acquire.centres",
        reader={"table": {**table, "target": point}},
        changes={k: v for k, v in session.changes.items() if k in ("path", "leave_out")},
        again=None,
    )


def _flipped(
    session: RecordedSession, null: VariantFits
) -> np.ndarray[tuple[int, ...], np.dtype[np.intp]]:
    """Return the index (N,) of the flip that each sample shows, -1 for none."""
    unknowns = null.unknowns
    mounts = equations_of(session).carried(unknowns.other)[0, :, :3, :3]
    expected = mounts @ unknowns.turn[0]
    seen = unknowns.rotation[0] @ session.rotations
    apart = seen.swapaxes(-1, -2) @ expected
    candidates = np.stack(list(FLIPS.values()))
    # trace(R^T F) = 1 + 2 cos of the angle between them
    cosines = (np.einsum("nij,fij->nf", apart, candidates) - 1) / 2
    best = np.argmax(cosines, axis=1)
    # A flip explains a rotation that is within this of it [rad]
    flip_within = 0.2
    near = cosines[np.arange(len(best)), best] > np.cos(flip_within)
    return np.where(near, best, -1)


TOO_UNCERTAIN = np.radians(2.0)
"""Standard deviation of the camera's rotation beyond which it counts as unknown [rad]."""
SHIFT = 5e-3
"""Standard deviation of a point of the work beyond which its position is unknown [m]."""
LITTLE = np.radians(10.0)
"""Poses that differ by less do not turn the target enough [rad]."""


@part("check.motion")
def motion(session: RecordedSession) -> Findings:
    """Find motion that leaves the camera's pose unknown: too little rotation, or a single line."""
    session.require_samples()
    null = fit_of(session)
    turn, shift = _uncertainty(session, null)
    if turn < TOO_UNCERTAIN and shift < SHIFT:
        yield from _offset_unknown(session)
        return
    spread, axes = _rotations(session)
    needs = not np.isfinite(session.places).all()
    name = "too little rotation" if needs else "too little motion"
    what = f"{_left_open(turn, shift)}: {_missing(session, needs, spread, axes)}"
    if session.marks_open and turn < TOO_UNCERTAIN:
        yield Finding(
            name, what, "none needed: the recipe marks the unobservable directions", note=True
        )
        return
    yield Finding(name, what, _advice(needs, axes < LITTLE <= spread))


def _left_open(turn: float, shift: float) -> str:
    known = []
    if turn >= TOO_UNCERTAIN:
        degrees = np.degrees(turn)
        known.append(
            f"rotation to {degrees:.2g} deg only" if degrees < 90 else "rotation not at all"
        )
    if shift >= SHIFT:
        known.append(
            f"position to {shift * 1e3:.3g} mm only" if shift < 1 else "position not at all"
        )
    return f"the poses determine the camera's {' and its '.join(known)}"


def _missing(session: RecordedSession, needs: bool, spread: float, axes: float) -> str:
    if needs and spread < LITTLE:
        return f"the poses turn by {np.degrees(spread):.2g} deg at most"
    if needs and axes < LITTLE:
        return f"all turns are about one axis, at most {np.degrees(axes):.2f} deg about any other"
    return f"the {int(session.seen.sum())} places of the target are nearly on a line"


def _advice(needs: bool, one_axis: bool) -> str:
    if needs:
        four = ", or, with an arm of four joints, set unobservable: mark in the solver"
        return "record again: turn the flange by 20 deg and more about two axes between samples" + (
            four if one_axis else ""
        )
    return "record again: move the target through the workspace, not along one line"


def _uncertainty(session: RecordedSession, null: VariantFits) -> tuple[float, float]:
    """Return the largest standard deviation of the camera's rotation, and at the work [rad, m].

    Errors count up to 3 mm and 1 deg only: more motion does not make up for larger ones.
    """
    scales = null.scales[0]
    # Larger ones [m, rad] are a mistake's or an outlier's, and no motion makes up for them
    errors = np.array([3e-3, np.radians(1.0)])
    share = min(1.0, float((errors[: len(scales)] / scales).min()))
    covariance = share**2 * covariance_of(null.information[0])[:6, :6]
    work = null.unknowns.rotation[0] @ np.nanmean(session.centres, axis=0)
    at_work = levers(work)
    # The largest eigenvalue is the variance in the least certain direction.
    turn = np.linalg.eigvalsh(covariance[:3, :3])[-1]
    shift = np.linalg.eigvalsh(at_work @ covariance @ at_work.T)[-1]
    return float(np.sqrt(max(turn, 0.0))), float(np.sqrt(max(shift, 0.0)))


def _rotations(session: RecordedSession) -> tuple[float, float]:
    """Return the largest turn between two poses, and the largest about a second axis [rad].

    They are turns between target and camera; with two arms, of the arm that turned less.
    """
    if session.seconds is not None:
        return min(_turns(p[session.seen]) for p in (session.poses, session.seconds))
    return _turns(equations_of(session).mounts[0, session.seen])


def _turns(poses: Floats) -> tuple[float, float]:
    turns = poses[:, :3, :3]
    between = rotation_log(turns[:, None].swapaxes(-1, -2) @ turns[None]).reshape(-1, 3)
    # Principal axes of all pairwise rotation vectors: two of them must be long, since rotation
    # about one axis alone leaves the translation along it unknown (Tsai and Lenz 1989).
    _, _, axes = np.linalg.svd(between, full_matrices=False)
    along = np.abs(between @ axes.T).max(axis=0)
    return float(np.linalg.norm(between, axis=1).max()), float(along[1])


def _offset_unknown(session: RecordedSession) -> Findings:
    """Yield a note if the motion could not show a constant offset of the target."""
    if not np.isfinite(session.places).all() or session.carried == "camera":
        return
    if not (known := offset_left_open(session)):
        return
    spread, axes = _rotations(session)
    told = f"known to {known * 1e3:.2g} mm only" if known < 1 else "not observable"
    what = (
        f"the poses turn by {np.degrees(spread):.2g} deg at most, {np.degrees(axes):.2g} deg about "
        f"a second axis: a constant offset of the target from the flange is {told}"
    )
    yield Finding("little rotation", what, "turn the flange by 20 deg and more about two axes "
                  "to be sure of that", note=True)  # fmt: skip

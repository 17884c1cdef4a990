"""Motion that is missing: recordings that leave the answer open, whatever the solver."""

from __future__ import annotations

import numpy as np

from flangeye import part
from flangeye.doctor.diagnosis import Finding, Findings, RecordedSession
from flangeye.maths.geometry import hat
from flangeye.types import Floats
from flangeye_plugins.check.equations import equations_of
from flangeye_plugins.check.fitting import VariantFits, fit, fit_of, log_of

TURN = np.radians(2.0)
"""Uncertainty of the camera's rotation that is no answer (one sigma) [rad]."""
SHIFT = 5e-3
"""Likewise of where it sees the work [m]."""
LITTLE = np.radians(10.0)
"""Poses that differ by less do not turn the target enough [rad]."""
ERRORS = np.array([3e-3, np.radians(1.0)])
"""Errors beyond these [m, rad] are a mistake's or an outlier's, and no motion makes up for them."""
OFFSET = 1e-3
"""An offset of the target that would be known less well cannot be told [m]."""


@part("check.motion")
def motion(session: RecordedSession) -> Findings:
    """The poses do not determine the camera's pose: too little rotation, or all on a line."""
    session.require_samples()
    null = fit_of(session)
    turn, shift = _uncertainty(session, null)
    if turn < TURN and shift < SHIFT:
        yield from _offset_unknown(session)
        return
    spread, axes = _rotations(session)
    needs = not np.isfinite(session.places).all()
    name = "too little rotation" if needs else "too little motion"
    what = f"{_left_open(turn, shift)}: {_missing(session, needs, spread, axes)}"
    if session.marks_open and turn < TURN:
        yield Finding(name, what, "none needed: the recipe marks what stays open", note=True)
        return
    yield Finding(name, what, _advice(needs, axes < LITTLE <= spread))


def _left_open(turn: float, shift: float) -> str:
    known = []
    if turn >= TURN:
        degrees = np.degrees(turn)
        known.append(
            f"its turn to {degrees:.2g} deg only" if degrees < 90 else "its turn not at all"
        )
    if shift >= SHIFT:
        known.append(
            f"its place to {shift * 1e3:.3g} mm only" if shift < 1 else "its place not at all"
        )
    return f"of the camera, {' and '.join(known)} is known"


def _missing(session: RecordedSession, needs: bool, spread: float, axes: float) -> str:
    if needs and spread < LITTLE:
        return f"the poses turn by {np.degrees(spread):.2g} deg at most"
    if needs and axes < LITTLE:
        return f"all turns are about one axis, others are {np.degrees(axes):.2f} deg at most"
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

    With errors as large as :data:`ERRORS` at most: what larger ones leave open, motion does not
    tell.
    """
    scales = null.scales[0]
    share = min(1.0, float((ERRORS[: len(scales)] / scales).min()))
    covariance = share**2 * _covariance(null.information[0])[:6, :6]
    work = null.unknowns.rotation[0] @ np.nanmean(session.centres, axis=0)
    at_work = np.concatenate([-hat(work), np.eye(3)], axis=1)
    turn = np.linalg.eigvalsh(covariance[:3, :3])[-1]
    shift = np.linalg.eigvalsh(at_work @ covariance @ at_work.T)[-1]
    return float(np.sqrt(max(turn, 0.0))), float(np.sqrt(max(shift, 0.0)))


def _covariance(information: Floats) -> Floats:
    """Return the inverse; directions without information get a variance beyond all limits."""
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(size, size) + 1e-13 * np.eye(len(size))
    return np.asarray(np.linalg.inv(scaled) / np.outer(size, size))


def _rotations(session: RecordedSession) -> tuple[float, float]:
    """Return the largest turn between two poses, and the largest about a second axis [rad].

    Of target and camera against each other; of two arms that which turned less.
    """
    if session.seconds is not None:
        return min(_turns(p[session.seen]) for p in (session.poses, session.seconds))
    return _turns(equations_of(session).mounts[0, session.seen])


def _turns(poses: Floats) -> tuple[float, float]:
    turns = poses[:, :3, :3]
    between = log_of(turns[:, None].swapaxes(-1, -2) @ turns[None]).reshape(-1, 3)
    _, _, axes = np.linalg.svd(between, full_matrices=False)
    along = np.abs(between @ axes.T).max(axis=0)
    return float(np.linalg.norm(between, axis=1).max()), float(along[1])


def _offset_unknown(session: RecordedSession) -> Findings:
    """Note where a constant offset of the target could not be seen."""
    if not np.isfinite(session.places).all() or session.carried == "camera":
        return
    free = fit(equations_of(session).with_free_place())
    known = float(np.sqrt(np.linalg.eigvalsh(_covariance(free.information[0])[6:9, 6:9])[-1]))
    if known < OFFSET:
        return
    spread, axes = _rotations(session)
    told = f"{known * 1e3:.2g} mm" if known < 1 else "nothing"
    what = (
        f"the poses turn by {np.degrees(spread):.2g} deg at most, {np.degrees(axes):.2g} deg about "
        f"a second axis: a constant offset of what is seen from the flange is known to {told} only"
    )
    yield Finding("little rotation", what, "turn the flange by 20 deg and more about two axes "
                  "to be sure of that", note=True)  # fmt: skip

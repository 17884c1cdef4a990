"""Lengths in other units than was said: positions of the arm, or of the target."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from flangeye import part
from flangeye.diagnosis import Finding, Findings, Floats, Session
from flangeye.mending import scaled
from flangeye_plugins.doctoring.asis import fit_of, variants
from flangeye_plugins.doctoring.fitting import fit
from flangeye_plugins.doctoring.significance import Evidence, best_of

UNITS: Mapping[str, float] = {
    "mm": 1e-3, "cm": 1e-2, "inches": 25.4e-3, "feet": 0.3048, "um": 1e-6,
}  # fmt: skip
"""In metres."""
STANDING = 1e-9
"""With so small positions the target does not move: no unit, if that explains samples better."""
ARMS = (0.1, 4.0)
"""Median distance of a flange from its base [m], from the smallest arm to the largest."""


@part("check.units")
def units(session: Session) -> Findings:
    """Positions of the arm or of the target are in another unit than was said."""
    if not session.seen.any():
        return
    names, factors = _ratios()
    poses = np.stack([scaled(session.poses, factor) for factor in [*factors, STANDING]])
    evidence = best_of(fit_of(session), fit(variants(session, poses)))
    if evidence.probability < 1 and evidence.which < len(names):
        said, meant = names[evidence.which]
        yield _of_one_side(session, said, meant, evidence)
    elif (both := _both(session)) is not None:
        yield both


def _ratios() -> tuple[list[tuple[str, str]], Floats]:
    """Return (as read, as meant) of the arm's unit, and what its positions are multiplied with."""
    sizes = {"m": 1.0, **UNITS}
    pairs = {
        round(sizes[meant] / sizes[said], 12): (said, meant)
        for said, meant in (
            *(("m", unit) for unit in UNITS), *((unit, "m") for unit in UNITS),
            ("mm", "inches"), ("inches", "mm"),
        )
    }  # fmt: skip
    return list(pairs.values()), np.array(list(pairs))


def _of_one_side(session: Session, said: str, meant: str, evidence: Evidence) -> Finding:
    """Say whose lengths are wrong: of arm and target, the one that they make more plausible."""
    sizes = {"m": 1.0, **UNITS}
    factor = sizes[meant] / sizes[said]
    arm = _outside(_distance_of_arm(session) * factor, ARMS) + _outside(
        _distance_of_target(session), session.reach
    )
    target = _outside(_distance_of_arm(session), ARMS) + _outside(
        _distance_of_target(session) / factor, session.reach
    )
    times = factor
    if arm <= target:
        mended = session.corrected(scaled(session.poses, factor), scale=_number(factor))
        what = f"the robot's positions were read in {said} and are in {meant}"
    else:
        times = 1 / factor
        mended = _of_target(session, times, said)
        what = f"the target's positions were read in {meant} and are in {said}"
    after = fit_of(mended).misfit()
    return Finding(
        "unit", f"{what} (a factor of {times:.6g})", mended.step(), (),
        evidence.before, after, evidence.probability, evidence.gain, mended,
    )  # fmt: skip


def _of_target(session: Session, factor: float, unit: str) -> Session:
    """Return the session with the target's positions times ``factor``."""
    mended = replace(session, centres=session.centres * factor)
    if session.acquire == "acquire.archive" and unit in ("m", "mm"):
        return mended.with_changes(unit=unit)
    return mended.corrected(session.poses, target_scale=_number(factor))


def _both(session: Session) -> Finding | None:
    """Arm and target agree with each other, and both are in the same wrong unit."""
    distance, target = _distance_of_arm(session), _distance_of_target(session)
    ranges = _outside(distance, ARMS), _outside(target, session.reach)
    if min(ranges) < np.log(3):  # one of them at least is as it should be
        return None
    unit = min(UNITS, key=lambda u: _outside(distance * UNITS[u], ARMS))
    factor = UNITS[unit]
    if _outside(distance * factor, ARMS) > 0:
        return None
    mended = replace(session, centres=session.centres * factor).corrected(
        scaled(session.poses, factor), scale=_number(factor), target_scale=_number(factor)
    )
    what = (
        f"robot and target agree, but the flange is {distance:.4g} m from the base and the target "
        f"{target:.4g} m from the camera: both are in {unit}"
    )
    before, after = fit_of(session).misfit(), fit_of(mended).misfit()
    return Finding("unit", what, mended.step(), (), before, after, mended=mended)


def _distance_of_arm(session: Session) -> float:
    return float(np.median(np.linalg.norm(session.poses[:, :3, 3], axis=1)))


def _distance_of_target(session: Session) -> float:
    return float(np.nanmedian(np.linalg.norm(session.centres, axis=1)))


def _outside(distance: float, allowed: tuple[float, float]) -> float:
    """Return by how many e-folds a distance is outside a range; 0 inside."""
    low, high = np.log(allowed)
    value = np.log(max(distance, 1e-12))
    return float(max(low - value, value - high, 0.0))


def _number(factor: float) -> float:
    return float(f"{factor:.10g}")

"""Lengths in other units than configured: positions of the arm or of the target."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from flangeye import part
from flangeye.maths.pose_corrections import scaled
from flangeye.types import Floats
from flangeye.workflow.doctor.diagnosis import (
    Arms,
    Finding,
    Findings,
    NotApplicable,
    RecordedSession,
)
from flangeye_plugins.check.equations import equations_of
from flangeye_plugins.check.fitting import (
    HELPS,
    Significance,
    VariantFits,
    arm_possessive,
    best_of,
    exceedance,
    explained,
    fit,
    fit_of,
    helps,
    size_by_chance,
)

METRES: Mapping[str, float] = {
    "m": 1.0, "mm": 1e-3, "cm": 1e-2, "inches": 25.4e-3, "feet": 0.3048, "um": 1e-6,
}  # fmt: skip
"""Units of lengths."""
ARM_DISTANCES = (0.1, 4.0)
"""Median distance of a flange from its base [m], from the smallest arm to the largest."""


class OtherUnit(NamedTuple):
    """A session with some lengths read in another unit.

    Attributes:
        session: The session with these lengths in the other unit.
        said: Unit in which they were read.
        meant: Unit in which they may be written.
        arms: Arms whose positions are concerned; None for the target's.
    """

    session: RecordedSession
    said: str
    meant: str
    arms: Arms | None


@part("check.units")
def units(session: RecordedSession) -> Findings:
    """Find positions of arm or target whose unit is not the stated one."""
    session.require_samples()
    tried = list(_alternatives(session))
    evidence = best_of(fit_of(session), fit(equations_of(*(each.session for each in tried))))
    found = None
    if evidence.probability < 1 and tried[evidence.which].said:
        found = _finding(session, tried[evidence.which], evidence)
    if found and found.corrected_session and helps(session, found.corrected_session):
        yield found
    elif (far := _too_far(session)) is not None:
        yield far


def _alternatives(session: RecordedSession) -> Iterator[OtherUnit]:
    """Yield the session with positions of arms or target in other units.

    Scaling the target's positions has the same effect as scaling the arm's inversely, so only one
    is tried.

    The exception is a camera on a link, whose position follows from the arm's model in metres.
    """
    for said, meant, factor in _ratios():
        if session.uses_poses:
            for arms in session.arms:
                yield OtherUnit(_of_arm(session, arms, factor), said, meant, arms)
        if session.links is not None:
            yield OtherUnit(_of_target(session, factor, meant), said, meant, None)
    if session.uses_poses:
        # With so small positions the target does not move: no unit, if that explains samples
        # better
        yield OtherUnit(_of_arm(session, "both", 1e-9), "", "", "both")


def _of_arm(session: RecordedSession, arms: Arms, factor: float) -> RecordedSession:
    def change(poses: Floats) -> Floats:
        return scaled(poses, factor)

    return session.corrected(change, arms, robot={"scale": _number(factor)})


def _ratios() -> Iterator[tuple[str, str, float]]:
    """Yield pairs of units (read as, probably meant), and the factor that corrects lengths."""
    given = {1.0}
    for said, meant in (
        *(("m", unit) for unit in METRES), *((unit, "m") for unit in METRES),
        ("mm", "inches"), ("inches", "mm"),
    ):  # fmt: skip
        factor = round(METRES[meant] / METRES[said], 12)
        if factor not in given:
            yield said, meant, factor
        given.add(factor)


def _finding(session: RecordedSession, found: OtherUnit, evidence: Significance) -> Finding:
    said, meant = found.said, found.meant
    if found.arms is None or (found.arms == "both" and _rather_target(session, said, meant)):
        return _of_targets_unit(session, found, evidence)
    whose = arm_possessive(found.arms, session)
    factor = METRES[meant] / METRES[said]
    what = f"{whose} positions were read in {said} and are in {meant} (a factor of {factor:.6g})"
    return _refitted(what, found.session, evidence)


def _of_targets_unit(session: RecordedSession, found: OtherUnit, evidence: Significance) -> Finding:
    """Return a finding for the target's lengths, given one for the arm's that fits equally well."""
    said, meant = found.said, found.meant
    if found.arms is not None:
        said, meant = meant, said
    factor = METRES[meant] / METRES[said]
    what = (
        f"the target's positions were read in {said} and are in {meant} (a factor of {factor:.6g})"
    )
    return _refitted(what, _of_target(session, factor, meant), evidence)


def _refitted(what: str, corrected: RecordedSession, evidence: Significance) -> Finding:
    after = fit_of(corrected).misfit()
    return evidence._replace(after=after).finding("unit", what, corrected)


def _rather_target(session: RecordedSession, said: str, meant: str) -> bool:
    """Return whether the target's unit is the more plausible mistake, judged by usual distances."""
    if session.links is not None:
        return False
    factor = METRES[meant] / METRES[said]
    arm = _outside(_distance_of_arm(session) * factor, ARM_DISTANCES) + _outside(
        _distance_of_target(session), session.reach
    )
    target = _outside(_distance_of_arm(session), ARM_DISTANCES) + _outside(
        _distance_of_target(session) / factor, session.reach
    )
    return target < arm


def _of_target(session: RecordedSession, factor: float, unit: str) -> RecordedSession:
    """Return the session with the target's positions times ``factor``."""
    corrected_session = replace(session, centres=session.centres * factor)
    if session.acquire == "acquire.archive" and unit in ("m", "mm"):
        return corrected_session.with_changes(unit=unit)
    return corrected_session.read_with(target={"scale": _number(factor)})


def _too_far(session: RecordedSession) -> Finding | None:
    """Return a finding for positions ten times beyond an arm's reach or a scanner's range.

    It needs no calibration, so it works when there are other mistakes as well.
    """
    arm, target = _distance_of_arm(session), _distance_of_target(session)
    lengths = {"robot": (arm, ARM_DISTANCES), "target": (target, session.reach)}
    if not session.uses_poses or session.seconds is not None:
        del lengths["robot"]
    told: dict[str, Any] = {}
    said, factors = [], {"robot": 1.0, "target": 1.0}
    for whose, (distance, allowed) in lengths.items():
        off = {unit: _outside(distance * factor, allowed) for unit, factor in METRES.items()}
        unit = min(off, key=off.__getitem__)
        if distance > 10 * allowed[1] and off[unit] == 0:
            factors[whose] = METRES[unit]
            told[whose] = {"scale": _number(METRES[unit])}
            said.append(f"the {whose}'s would be {distance:.4g} m away, so they are in {unit}")
    if not told:
        return None
    corrected = replace(session, centres=session.centres * factors["target"])
    corrected = corrected.corrected(lambda poses: scaled(poses, factors["robot"]), **told)
    what = f"positions were read in m: {'; '.join(said)}"
    return Finding("unit", what, corrected.step(), corrected_session=corrected)


def _distance_of_arm(session: RecordedSession) -> float:
    return float(np.median(np.linalg.norm(session.poses[:, :3, 3], axis=1)))


def _distance_of_target(session: RecordedSession) -> float:
    return float(np.nanmedian(np.linalg.norm(session.centres, axis=1)))


def _outside(distance: float, allowed: tuple[float, float]) -> float:
    """Return the logarithm of the factor by which a distance is outside a range; 0 inside."""
    # On a logarithmic scale: a unit mistake is a factor, and a range of distances spans decades.
    low, high = np.log(allowed)
    value = np.log(max(distance, 1e-12))
    return float(max(low - value, value - high, 0.0))


def _number(factor: float) -> float:
    return float(f"{factor:.10g}")


ALONG = {"size": np.ones(3), "focal": np.array([0.0, 0.0, 1.0])}
"""Which of the target's coordinates in the camera a wrong length stretches: all of them, or, as a
wrong focal length does (Zhang 2000, equation 2), its depth alone."""


@part("check.size")
def size(session: RecordedSession) -> Findings:
    """Find a wrong target size or focal length, which scales all distances of the target."""
    session.require_samples()
    marker = bool(np.isfinite(session.rotations).any())
    if not marker and not np.isfinite(session.places).all():
        raise NotApplicable("neither a marker's pose nor the target's position was measured")
    null = fit_of(session)
    kinds = [*ALONG] if marker or session.acquire == "acquire.archive" else ["size"]
    factors = {kind: _factor(session, null, ALONG[kind]) for kind in kinds}
    tried = [_stretched(session, kind, k) for kind, k in factors.items() if 0.2 < k < 5]
    if not tried:
        return
    kind, factor, corrected_session = max(tried, key=lambda one: fit_of(one[2]).likelihood[0])
    found = fit_of(corrected_session)
    evidence = best_of(null, found, 1)
    ratio, count = float(found.likelihood[0] - null.likelihood[0]), float(null.count[0])
    # A printer is no better, and nobody measures a marker with less care; scanners are
    effect = abs(np.log(factor)) / (5e-3 if marker else 2e-3)
    p = exceedance(ratio, count, 1, count - found.parameters - 1, effect)
    if p == 1 and abs(factor - 1) * _distance_of_target(session) > session.limit:
        p = size_by_chance(session)
    if p == 1 or not explained(corrected_session):
        return
    # Bonferroni, over size and focal length
    evidence = evidence._replace(probability=min(1.0, len(tried) * p))
    if marker:
        what, fix = _wrong_marker(session, kind, factor)
        name = "focal length" if kind == "focal" else "target size"
        yield evidence.finding(name, what, corrected_session, fix)
    # Poses between which an arm's motion was interpolated are a little too near each other
    elif evidence.after.position <= HELPS**2 * evidence.before.position:
        what = f"the scanner's distances fit the arm's motion if {factor:.4f} times as long"
        what += " along its axis" if kind == "focal" else ""
        fix = session.stretched(1 + (factor - 1) * ALONG[kind]).step()
        yield evidence.finding("scale", what, corrected_session, fix)


def _wrong_marker(session: RecordedSession, kind: str, factor: float) -> tuple[str, str]:
    """Return the finding on a wrong marker or camera, with what to do."""
    calibrate = _calibrate_camera(session)
    focal = f"the camera's focal length is {factor:.4f} times as long as its calibration states"
    if kind == "focal":
        return focal, calibrate
    what = f"the marker is {factor:.4f} times as large as the recipe states"
    if session.acquire == "acquire.samples":
        return what, session.read_with(target={"scale": float(f"{factor:.4f}")}).step()
    fix = f"measure it after printing: its lengths in the fit step times {factor:.4f}"
    if session.acquire == "acquire.images":  # where the target stays near the camera's axis
        return f"{what}, or {focal}", f"{fix}; if the print has the stated size: {calibrate}"
    return what, fix


def _stretched(
    session: RecordedSession, kind: str, factor: float
) -> tuple[str, float, RecordedSession]:
    scale = 1 + (factor - 1) * ALONG[kind]
    normals = session.normals / scale
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return kind, factor, replace(session, centres=session.centres * scale, normals=normals)


def _factor(session: RecordedSession, null: VariantFits, along: Floats) -> float:
    """Return the best factor of the target's coordinates, given the rotations (linear).

    Args:
        session: The samples.
        null: Fits of the unchanged session.
        along: (3,) 1 for each coordinate in the camera that grows, 0 for the others.
    """
    seen, equations = session.seen, equations_of(session)
    turn = null.unknowns.rotation[0].T
    grown, kept = session.centres[seen] * along @ turn, session.centres[seen] * (1 - along) @ turn
    mounts = equations.carried(null.unknowns.other)[0][seen]
    eye = np.broadcast_to(np.eye(3), (len(grown), 3, 3))
    parts, right = [grown[..., None], eye, -mounts[:, :3, :3]], mounts[:, :3, 3] - kept
    if equations.knows_place:
        right = right + (mounts[:, :3, :3] @ equations.places[0, seen, :, None])[..., 0]
        del parts[2]
    if equations.bases is not None:
        # The second arm's base moves too: what it is now comes off, and is found again.
        bases = equations.bases[0, seen, :3, :3]
        parts.append(-bases)
        right = right - (bases @ null.unknowns.other[0, :3, 3])
    rows = np.concatenate(parts, axis=-1).reshape(len(right) * 3, -1)
    return float(np.linalg.lstsq(rows, right.ravel(), rcond=1e-10)[0][0])


@part("check.rounding")
def rounding(session: RecordedSession) -> Findings:
    """Find positions rounded more coarsely than the error that the recipe asks for."""
    seen = session.centres[session.seen]
    for whose, places in (("the arm", session.poses[:, :3, 3]), ("the target", seen)):
        step = _step(places)
        # Rounding to a step moves a place by half of it, rms; half the limit is too much
        if step is not None and step / 2 >= 0.5 * session.limit:
            what = (
                f"positions of {whose} are whole multiples of {1e3 * step:g} mm, and the recipe "
                f"asks for {1e3 * session.limit:g} mm; if they were rounded, that alone is an "
                f"error of {1e3 * step / 2:.2g} mm"
            )
            fix = f"write positions with {1 + round(-np.log10(step))} or more decimals of a metre"
            yield Finding("rounded", what, fix, note=True)


def _step(places: Floats) -> float | None:
    """Return the coarsest step [m] that all coordinates are multiples of; None for none."""
    # Last decimals of positions in metres, millimetres and so on [m]
    decimals = (0.1, 1e-2, 1e-3, 1e-4, 1e-5)
    for step in decimals:
        multiples = places / step
        # By what share of the step a position may miss a multiple of it
        if len(places) and np.abs(multiples - np.round(multiples)).max() < 1e-3:
            return step
    return None


def _calibrate_camera(session: RecordedSession) -> str:
    """Return the recipe line that calibrates the camera from the board, or advice to do so."""
    if session.acquire == "acquire.images" and session.board:
        return session.with_changes(board=dict(session.board)).step()
    return "calibrate the camera by views of a board"

"""Checks of order and constancy: shuffled or repeated poses, and parts that moved."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye import part
from flangeye.maths.pose_corrections import delayed_by_each, shifted, without_tool
from flangeye.maths.streams import later, pose_at
from flangeye.types import Floats, Indices, Mask
from flangeye.types.geometry import rigid, rotation_exp, rotation_log
from flangeye.workflow.doctor.diagnosis import (
    Arms,
    Finding,
    Findings,
    NotApplicable,
    RecordedSession,
)
from flangeye_plugins.check.equations import equations_of
from flangeye_plugins.check.fitting import (
    Significance,
    VariantFits,
    arm_name,
    best_of,
    exceedance,
    fit,
    fit_of,
    helps,
    moved_helps,
    narrowed,
    offset_left_open,
)

Reordering = Callable[[Floats], tuple[Floats, Mask]]
"""Gives poses (N, 4, 4), and the samples (N,) that have one."""


class Reordered(NamedTuple):
    """A session with the poses of other moments, and the samples that have such a pose."""

    session: RecordedSession
    known: Mask
    arms: Arms


@part("check.order")
def order(session: RecordedSession) -> Findings:
    """Find scans paired with the pose before or after their own, or in the opposite order."""
    session.require_samples()
    every = np.arange(1, len(session) - 1)
    # A shift by a few samples is what a lost or doubled row does; a later start is tried for shifts
    # by one only, since each start costs a fit.
    tried = [(arms, by, 0) for arms in session.arms for by in (1, -1, 2, -2, 3, -3)]
    # All starts count as tried (Bonferroni), although the search fits a few of them only.
    count = len(tried) + 2 * len(every) + 1
    for by in (1, -1):
        near = narrowed(every, lambda some, by=by: _gains(session, by, some))  # type: ignore[misc]
        tried += [("both", by, int(start)) for start in near]
    others = [*(_shifted(session, *each) for each in tried), _backwards(session)]
    evidence = _evidence(session, others, tried=count)
    if evidence is None or evidence.probability == 1:
        return
    found = others[evidence.which]
    corrected_session = found.session.where(found.known)
    if not helps(session.where(found.known), corrected_session):
        return
    if evidence.which == len(tried):
        what = (
            "the poses are in the opposite order of the scans: the first belongs to the last scan"
        )
        yield evidence.finding("poses backwards", what, corrected_session)
        return
    what = _said(session, *tried[evidence.which])
    yield evidence.finding("shifted poses", what, corrected_session)


def _said(session: RecordedSession, arms: Arms, by: int, start: int) -> str:
    which = "later" if by > 0 else "earlier"
    since = f" from '{session.ids[start]}' on" if start else ""
    of = "" if session.seconds is None else f" of {arm_name(arms)}"
    return f"each scan belongs to the pose{of} {abs(by)} {which}{since}"


def _gains(session: RecordedSession, by: int, starts: Indices) -> Floats:
    """Return (K,) logarithms of likelihood ratios of shifts that begin with some samples."""
    fits = _fits(session, [_shifted(session, "both", by, int(start)) for start in starts])
    if fits is None:
        return np.zeros(len(starts))
    given, found, against = fits
    return np.asarray(found.likelihood - given.likelihood[against])


def _shifted(session: RecordedSession, arms: Arms, by: int, start: int) -> Reordered:
    where = {"shift_from": session.ids[start]} if start else {}

    def change(poses: Floats) -> tuple[Floats, Mask]:
        return shifted(poses, by, start)

    return _at_other_times(session, change, arms, shift=by, **where)


def _backwards(session: RecordedSession) -> Reordered:
    def change(poses: Floats) -> tuple[Floats, Mask]:
        return poses[::-1], np.ones(len(poses), dtype=bool)

    return _at_other_times(session, change, "both", backwards=True)


def _at_other_times(
    session: RecordedSession, change: Reordering, arms: Arms, **correction: Any
) -> Reordered:
    """Return the session with the poses (and links' poses) of other moments."""
    moved, known = change(session.poses)

    def alike(poses: Floats) -> Floats:
        return moved if poses is session.poses else change(poses)[0]

    read = session.corrected(alike, arms, **correction)
    if session.links is not None:
        read = replace(read, links=alike(session.links))
    return Reordered(read, known, arms)


@part("check.clock")
def clock(session: RecordedSession) -> Findings:
    """Find poses that were taken before or after the scans while the arm moved."""
    session.require_samples()
    times = session.times
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise NotApplicable("the samples have no times, or these do not rise")
    step = float(np.median(np.diff(times)))
    delays = 24  # on each side of none, up to the time between samples three times over
    coarse = step * 3 * np.linspace(-1, 1, 2 * delays)
    found = _evidence(session, _delays(session, coarse, session.arms), further=1)
    if found is None:
        return
    arms, middle = session.arms[found.which // len(coarse)], coarse[found.which % len(coarse)]
    # A second grid within one step of the first: the likelihood is smooth in the delay.
    near = middle + np.linspace(-1, 1, 17) * step * 3 / delays
    others = _delays(session, near, [arms])
    finer = _evidence(session, others, further=1)
    if finer is None or finer.probability == 1:
        return
    delay = float(near[finer.which])
    which = "after" if delay > 0 else "before"
    whose = "the arm was" if session.seconds is None else f"{arm_name(arms)} was"
    what = f"{whose} at the recorded poses {abs(delay) * 1e3:.0f} ms {which} the recorded times"
    corrected_session = others[finer.which].session.where(others[finer.which].known)
    if not helps(session.where(others[finer.which].known), corrected_session):
        return
    yield finer.finding("time offset", what, corrected_session)


def _delays(session: RecordedSession, delays: Floats, arms: Sequence[Arms]) -> list[Reordered]:
    made: dict[int, tuple[Floats, Mask]] = {}

    def at_another_time(poses: Floats, k: int) -> tuple[Floats, Mask]:
        if session.motions is not None and poses is session.poses:
            delay = float(delays[k])
            known = np.array([later(each, delay) is not None for each in session.motions])
            return np.array([pose_at(each, delay) for each in session.motions]), known
        if id(poses) not in made:
            made[id(poses)] = delayed_by_each(poses, session.times, delays)
        moved, kept = made[id(poses)]
        return moved[k], kept[k]

    return [
        _at_other_times(session, partial(at_another_time, k=k), arm, delay=f"{delay * 1e3:.1f} ms")
        for arm in arms
        for k, delay in enumerate(delays)
    ]


def _evidence(
    session: RecordedSession,
    others: Sequence[Reordered],
    further: int = 0,
    tried: int | None = None,
) -> Significance | None:
    """Compare the poses of other moments with the recorded ones, on samples that have both."""
    fits = _fits(session, others)
    if fits is None:
        return None
    given, found, against = fits
    return best_of(given, found, further, tried, against)


def _fits(
    session: RecordedSession, others: Sequence[Reordered]
) -> tuple[VariantFits, VariantFits, Indices] | None:
    """Return fits of the recorded poses, of the alternatives, and each alternative's match."""
    known = np.array([other.known for other in others])
    # Samples with a target that an alternative must leave
    fewest_left = 5
    enough = (known & session.seen).sum(axis=1) >= fewest_left
    if not enough.any():
        return None
    # Those with too few samples are put in as the session is, which is no better than itself.
    known[~enough] = True
    tried = [o.session if kept else session for o, kept in zip(others, enough, strict=True)]
    chosen, against = np.unique(known, axis=0, return_inverse=True)
    given = fit(equations_of(session).without(~chosen))
    return given, fit(equations_of(*tried).without(~known)), against.reshape(-1)


NOT_MEASURED_TWICE = 1e-9
"""Numbers that differ by less were not measured twice."""


@part("check.identity")
def identity(session: RecordedSession) -> Findings:
    """Find identity matrices, which a driver without data returns as the pose of arm or marker."""
    for whose, poses in _reported(session):
        robot = np.abs(poses - np.eye(4)).max(axis=(1, 2), initial=0.0) < NOT_MEASURED_TWICE
        if robot.any():
            what = (
                f"{robot.sum()} of {len(session)} {whose} poses are the identity, which "
                "puts the flange at the base's origin: the driver had no pose to give"
            )
            yield _left_out(session, robot, "identity matrices", what)
    marker = _is_identity(session)
    if marker.any():
        what = f"{marker.sum()} of {len(session)} markers are at the camera itself, not turned"
        yield _left_out(session, marker, "identity matrices", f"{what}: nothing was detected there")


def _reported(session: RecordedSession) -> Iterator[tuple[str, Floats]]:
    """Yield each reported pose's name, such as second robot, and the poses (N, 4, 4)."""
    if session.uses_poses:
        yield "robot", session.poses
    if session.links is not None:
        yield "link", session.links
    if session.seconds is not None:
        yield "second arm's", session.seconds


def _is_identity(session: RecordedSession) -> Mask:
    at_camera = np.abs(np.nan_to_num(session.centres, nan=1.0)).max(axis=1) < NOT_MEASURED_TWICE
    turned = np.abs(session.rotations - np.eye(3)).max(axis=(1, 2))
    return np.asarray(at_camera & ~(turned > NOT_MEASURED_TWICE))


@part("check.repeated")
def repeated(session: RecordedSession) -> Findings:
    """Find a pose or detection repeated although the arm had moved, and captures taken twice."""
    reported = [poses[:, :3].reshape(len(poses), 12) for _, poses in _reported(session)]
    poses = np.concatenate(reported, axis=1)
    yield from _repeats(session, poses, session.centres, "robot pose")
    places = np.concatenate([poses[:, :3, 3] for _, poses in _reported(session)], axis=1)
    yield from _repeats(session, session.centres, places, "detection")
    _, again = _alike(poses, session.centres)
    if again.any():
        told = f"{again.sum()} of {len(session)} captures were taken at the pose of an earlier one"
        yield _left_out(session, again, "repeated capture", f"{told}, and show the same")


def _repeats(
    session: RecordedSession, numbers: Floats, others: Floats, what: str
) -> Iterator[Finding]:
    """Find rows that repeat an earlier one to the last digit although the others moved on."""
    # Of two equal rows the later one is stale: the driver had nothing newer to return.
    wrong, _ = _alike(numbers, others)
    made_up = any(
        (np.abs(p[wrong] - np.eye(4)) < NOT_MEASURED_TWICE).all() for _, p in _reported(session)
    )
    if wrong.any() and not made_up:
        told = f"{wrong.sum()} of {len(session)} {what}s repeat an earlier one to the last "
        yield _left_out(
            session,
            wrong,
            f"repeated {what}",
            f"{told}digit, although the arm had moved: they are stale",
        )


def _alike(numbers: Floats, others: Floats) -> tuple[Mask, Mask]:
    """Return the rows that repeat an earlier one to the last digit: others moved on, or did not."""
    from scipy.spatial import KDTree

    read = np.flatnonzero(np.isfinite(numbers).all(axis=1))
    alike = KDTree(numbers[read]).query_pairs(NOT_MEASURED_TWICE, p=np.inf, output_type="ndarray")
    before, after = np.sort(read[alike], axis=1).T
    # A target that has moved further was seen from another pose [m]
    moved = np.linalg.norm(others[after] - others[before], axis=1) > 1e-3
    stale, again = np.zeros((2, len(numbers)), dtype=bool)
    stale[after[moved]] = True
    again[after[~moved]] = True
    return stale, again & ~stale


def _left_out(session: RecordedSession, wrong: NDArray[np.bool_], name: str, what: str) -> Finding:
    names = [each for each, bad in zip(session.ids, wrong, strict=True) if bad]
    if (session.seen & ~wrong).sum() < session.seen.sum() / 2:
        return Finding(name, what, "record again: less than half the captures remain", tuple(names))
    corrected_session = session.without(wrong)
    return Finding(
        name, what, corrected_session.step(), tuple(names), corrected_session=corrected_session
    )


@part("check.moved")
def moved(session: RecordedSession) -> Findings:
    """Find a camera or a target that was moved during the session."""
    session.require_samples()
    null = fit_of(session)
    seen = np.flatnonzero(session.seen)
    # Samples on each side of a move beyond those that a calibration takes up
    spare = 2
    each = spare + int(np.ceil(null.parameters * len(seen) / null.count[0]))
    starts = seen[each : len(seen) - each + 1]
    if not len(starts):
        raise NotApplicable(f"{len(seen)} samples are too few for two calibrations")
    equations = equations_of(session)

    def two(some: Indices) -> VariantFits:
        after = np.arange(len(session)) >= some[:, None]
        return _together(fit(equations.without(after)), fit(equations.without(~after)))

    # Two separate calibrations cost a full set of parameters more, which the test accounts for.
    near = narrowed(starts, lambda some: two(some).likelihood)
    evidence = best_of(null, two(near), null.parameters, tried=len(starts))
    start = int(near[evidence.which])
    if evidence.probability < 1 and moved_helps(session, np.arange(len(session)) >= start):
        yield _moved_finding(session, evidence, start)


def _together(first: VariantFits, second: VariantFits) -> VariantFits:
    """Return two fits of separate samples as one."""
    counts = first.count + second.count
    share = (first.count / counts)[:, None]
    residuals = tuple(
        np.where(np.isfinite(one), one, other)
        for one, other in zip(first.residuals, second.residuals, strict=True)
    )
    return replace(
        first,
        likelihood=first.likelihood + second.likelihood,
        residuals=residuals,
        scales=np.sqrt(share * first.scales**2 + (1 - share) * second.scales**2),
        count=counts,
    )


def _moved_finding(session: RecordedSession, evidence: Significance, start: int) -> Finding:
    later = np.arange(len(session)) >= start
    shorter = later if later.sum() <= len(session) / 2 else ~later
    name = session.ids[start]
    what = (
        f"the camera or its target moved before '{name}', or the poses are written another "
        "way from there on: the samples before and after fit two calibrations"
    )
    kept = session.without(shorter)
    return evidence.finding("moved target", what, kept, samples=(session.ids[start],))


@part("check.tool")
def tool(session: RecordedSession) -> Findings:
    """Find poses of a tool (TCP) instead of the flange: a constant offset and turn."""
    _require_known_place(session)
    if np.isfinite(session.rotations).any() and session.seconds is None:
        yield from _elsewhere(session)
        return
    turn, read = _turned(session)
    known, free = fit(equations_of(read)), fit(equations_of(read).with_free_place())
    offset = read.place[:3, :3] @ (free.unknowns.place[0, 0] - read.places[0])
    length = float(np.linalg.norm(offset))
    evidence = best_of(known, free, 3)
    freedom = float(known.count[0]) - free.parameters
    ratio = float(free.likelihood[0] - known.likelihood[0])
    # A seen circle further from where the arm has it is a mistake [m]
    p = exceedance(ratio, float(known.count[0]), 3, freedom, length / 1e-3)
    shows = p < 1 and _known(free, offset)
    told = [f"{length * 1e3:.1f} mm from where the arm carries it"] if shows else []
    told += [f"turned by {np.degrees(turn):.0f} deg from the flange's axis"] if turn else []
    if not told or (session.seconds is not None and not shows):
        return
    what = (
        f"the target is always seen {' and '.join(told)}: the poses are probably those of a tool "
        "set in the controller; if the target is mounted there, write configuration: {place: "
        "unknown}"
    )
    if turn and session.seconds is None:
        null = fit_of(session)
        # A free axis costs two parameters: the share of all directions that the normals leave to
        # it. So a misread rotation, which leaves nothing free, wins where both fit alike
        evidence = best_of(null, free, 5) if shows else best_of(null, known, 2)
        share = float(known.scales[0, 1]) ** 2 / session.seen.sum()
        gain = evidence.gain + float(np.log(null.count[0] * share))
        evidence = evidence._replace(gain=gain)
        unknown = replace(read, places=np.full_like(session.places, np.nan), again=None)
        fix = "configuration: {name: eye-on-base, place: unknown}"
        if offset_left_open(read):
            fix = (
                "record again: without a tool in the controller, or turn the flange by 20 deg and "
                "more about two axes between samples"
            )
        yield evidence.finding("tool offset", what, unknown, fix)
        return
    corrected_session = session.corrected(
        lambda poses: without_tool(poses, -offset),
        "both" if session.seconds is None else "second",
        offset=[f"{value * 1e3:.2f} mm" for value in offset + 0.0],
    )
    yield evidence._replace(probability=p).finding("tool offset", what, corrected_session)


def _elsewhere(session: RecordedSession) -> Findings:
    """Find a target of whole poses that is elsewhere on its carrier than the recipe has it."""
    found = fit_of(session)
    offset = found.unknowns.place[0, 0] - session.places[0]
    turn = rotation_log(found.unknowns.turn[:1])[0]
    length, angle = float(np.linalg.norm(offset)), float(np.linalg.norm(turn))
    covariance = np.linalg.pinv(found.information[0], hermitian=True)
    of_turn = np.sqrt(np.linalg.eigvalsh(covariance[9:12, 9:12])[-1])
    aside = length > session.limit and _known(found, offset)
    turned = angle > max(np.radians(2.0), 10 * of_turn)
    # Where one calibration does not fit, the place that it gives says nothing
    misfit = found.misfit()
    fits = misfit.position < session.limit and (misfit.angle or 0.0) < np.radians(2.0)
    if not fits or not (aside or turned):
        return
    what = (
        f"the target is always seen {length * 1e3:.1f} mm and turned by {np.degrees(angle):.0f} "
        "deg from where the recipe has it: its mesh is drawn in another frame, or the poses are "
        "those of a tool set in the controller"
    )
    unknown = replace(session, places=np.full_like(session.places, np.nan), again=None)
    yield Finding(
        "target place", what, "target: {at: unknown}", gain=0.0, corrected_session=unknown
    )


def _turned(session: RecordedSession) -> tuple[float, RecordedSession]:
    """Return the normals' common angle to the target's axis [rad], and the session corrected.

    Returns:
        0 and the session as it is, where the normals do not all stand alike.
    """
    seen = np.isfinite(session.normals[:, 0])
    if not seen.any() or session.links is not None:
        return 0.0, session
    centres = replace(session, normals=np.full_like(session.normals, np.nan))
    fitted = fit(equations_of(centres).with_free_place())
    turns = equations_of(session).carried(fitted.unknowns.other)[0, seen, :3, :3]
    there = session.normals[seen] @ fitted.unknowns.rotation[0].T
    own = (turns.swapaxes(-1, -2) @ there[..., None])[..., 0]
    axis = own.mean(axis=0) / np.linalg.norm(own.mean(axis=0))
    scatter = float(np.sqrt(np.median(np.sum((own - axis) ** 2, axis=1))))
    # Where z points inwards, it is the frame's convention and no turn
    axis *= np.sign(axis[2])
    turn = float(np.arccos(np.clip(axis[2], 0.0, 1.0)))
    # A face is cut squarer than that; and known to a tenth of it
    if not turn > max(np.radians(2.0), 10 * scatter):
        return 0.0, session
    about = np.cross([0.0, 0.0, 1.0], axis)
    tilted = rigid(rotation_exp(turn * about / np.linalg.norm(about)), np.zeros(3))
    return turn, replace(session, place=session.place @ tilted)


def _require_known_place(session: RecordedSession) -> None:
    """Refuse a session in which the target's pose on the arm is unknown.

    Raises:
        NotApplicable: The target's pose is unknown, or no arm carries it.
    """
    session.require_samples()
    if session.carried == "camera":
        raise NotApplicable(
            "a constant offset of the camera's carrier is absorbed by the estimated camera pose"
        )
    if not np.isfinite(session.places).all():
        raise NotApplicable("the target's pose on the arm is unknown and absorbs any offset")


def _known(found: VariantFits, offset: Floats) -> bool:
    """Whether the offset's standard deviation is below a tenth of its length in every direction.

    If it is larger, the poses turn too little, and smooth errors of the arm look like an offset.
    """
    covariance = np.linalg.pinv(found.information[0], hermitian=True)[6:9, 6:9]
    deviation = np.sqrt(np.linalg.eigvalsh(covariance)[-1])
    return bool(deviation < 0.1 * np.linalg.norm(offset))

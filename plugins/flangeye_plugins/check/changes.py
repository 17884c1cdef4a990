"""What was taken as fixed and was not: the target or camera, and where the arm has the target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flangeye import part
from flangeye.doctor.diagnosis import Finding, Findings, NotApplicable, RecordedSession
from flangeye.maths.pose_corrections import without_tool
from flangeye.types import Floats
from flangeye_plugins.check.equations import equations_of
from flangeye_plugins.check.fitting import VariantFits, fit, fit_of
from flangeye_plugins.check.significance import Significance, best_of, exceedance, moved_helps

SPARE = 2
"""Samples on each side of a move beyond those that a calibration takes up."""
OFFSET = 1e-3
"""A seen circle further than this from where the arm has it is a mistake [m]."""


@part("check.moved")
def moved(session: RecordedSession) -> Findings:
    """The camera or the target was moved part way through."""
    session.require_samples()
    null = fit_of(session)
    seen = np.flatnonzero(session.seen)
    each = SPARE + int(np.ceil(null.parameters * len(seen) / null.count[0]))
    starts = seen[each : len(seen) - each + 1]
    if not len(starts):
        raise NotApplicable(f"{len(seen)} samples are too few for two calibrations")
    after = np.arange(len(session)) >= starts[:, None]
    equations = equations_of(session)
    halves = fit(equations.without(after)), fit(equations.without(~after))
    evidence = best_of(null, _together(*halves), null.parameters)
    start = int(starts[evidence.which])
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
        f"the camera or what it looks at moved before '{name}', or the poses are written another "
        "way from there on: the samples before and after fit two calibrations"
    )
    kept = session.without(shorter)
    return evidence.finding("moved target", what, kept, samples=(session.ids[start],))


@part("check.tool")
def tool(session: RecordedSession) -> Findings:
    """The poses are those of a tool (TCP): a constant offset in the flange frame."""
    _require_known_place(session)
    null = fit_of(session)
    found = fit(equations_of(session).with_free_place())
    offset = session.place[:3, :3] @ (found.unknowns.place[0, 0] - session.places[0])
    length = float(np.linalg.norm(offset))
    evidence = best_of(null, found, 3)
    freedom = float(null.count[0]) - found.parameters
    ratio = float(found.likelihood[0] - null.likelihood[0])
    p = exceedance(ratio, float(null.count[0]), 3, freedom, length / OFFSET)
    if p == 1 or not _known(found, offset):
        return
    listed = [f"{value * 1e3:.2f} mm" for value in offset + 0.0]
    what = (
        f"the seen target is {length * 1e3:.1f} mm from where the arm carries it, constantly: "
        "the poses are probably those of a tool set in the controller, or it is mounted there, "
        "which configuration: {place: unknown} says"
    )
    corrected_session = session.corrected(
        lambda poses: without_tool(poses, -offset),
        "both" if session.seconds is None else "second",
        target_offset=listed,
    )
    yield evidence._replace(probability=p).finding("tool offset", what, corrected_session)


def _require_known_place(session: RecordedSession) -> None:
    """Go on only where it is known where the arm has the target.

    Raises:
        NotApplicable: It is not, or no arm has it.
    """
    session.require_samples()
    if session.carried == "camera":
        raise NotApplicable("a constant offset of what carries the camera is part of the answer")
    if not np.isfinite(session.places).all():
        raise NotApplicable("the target's pose on the arm is unknown and absorbs any offset")


def _known(found: VariantFits, offset: Floats) -> bool:
    """Whether the offset is known to a tenth of itself along every direction.

    Where it is not, the smooth errors of an arm pass for one: the poses turn too little.
    """
    covariance = np.linalg.pinv(found.information[0], hermitian=True)[6:9, 6:9]
    deviation = np.sqrt(np.linalg.eigvalsh(covariance)[-1])
    return bool(deviation < 0.1 * np.linalg.norm(offset))

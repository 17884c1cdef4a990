"""Rotations that were written one way and read another; poses given the other way round."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from flangeye import part
from flangeye.doctor.diagnosis import OR_ELSE, Arms, Change, Finding, Findings, RecordedSession
from flangeye.maths.pose_corrections import inverted, reread, transposed
from flangeye.maths.pose_formats import CONVENTIONS, EULER_ORDERS
from flangeye.types import Floats
from flangeye_plugins.check.as_recorded import fit_of, named
from flangeye_plugins.check.equations import equations_of
from flangeye_plugins.check.fitting import fit
from flangeye_plugins.check.held_out import helps
from flangeye_plugins.check.significance import Significance, best_of

QUATERNIONS = ("xyzw", "wxyz")
COMMON = ("vector", "ZYX", "xyz", "XYZ", "zyx", "ZYZ", "zyz", "ZXZ")
"""What three angles mean on the arms that are sold, and rotation vectors."""

NAMES = {
    "xyzw": "a quaternion x, y, z, w", "wxyz": "a quaternion w, x, y, z",
    "vector": "a rotation vector", "ZYX": "KUKA's A, B, C (ZYX about turned axes)",
    "xyz": "roll, pitch, yaw or Fanuc's W, P, R (xyz about fixed axes)",
    "XYZ": "angles XYZ about turned axes", "ZYZ": "angles ZYZ about turned axes",
}  # fmt: skip


@part("check.convention")
def convention(session: RecordedSession) -> Findings:
    """The rotations fit far better when their numbers are read in another convention."""
    session.require_poses()
    tried = [(arms, *pair) for arms in session.arms for pair in _readings(session)]
    others = [_reread(session, *each) for each in tried]
    evidence = best_of(fit_of(session), fit(equations_of(*others)))
    if evidence.probability < 1 and helps(session, others[evidence.which]):
        arms, read_as, written_as = tried[evidence.which]
        whose = "the" if session.seconds is None else named(arms, session)
        what = f"{whose} rotations were read as {_name(read_as)}, and fit as {_name(written_as)}"
        yield evidence.finding("pose convention", what, others[evidence.which])


def _reread(session: RecordedSession, arms: Arms, read_as: str, written_as: str) -> RecordedSession:
    def change(poses: Floats) -> Floats:
        return reread(poses, read_as, written_as)

    return session.corrected(change, arms, read_as=read_as, written_as=written_as)


def _readings(session: RecordedSession) -> Iterator[tuple[str, str]]:
    """Give (as read, as written): every pair of conventions with as many numbers."""
    stated = _stated(session)
    for read_as in [stated] if stated else [*QUATERNIONS, *COMMON]:
        others = QUATERNIONS if read_as in QUATERNIONS else ("vector", *EULER_ORDERS)
        if not stated and read_as not in QUATERNIONS:
            others = COMMON
        yield from ((read_as, other) for other in others if other != read_as)


def _stated(session: RecordedSession) -> str | None:
    """Return how the recipe says the rotations are written, if it does."""
    if isinstance(session.reader, str):
        return None
    ((_, params),) = session.reader.items()
    rotation = params.get("rotation") if params else None
    if not isinstance(rotation, str):
        return None
    return CONVENTIONS[rotation].rotation if rotation in CONVENTIONS else rotation


def _name(rotation: str) -> str:
    if rotation in NAMES:
        return NAMES[rotation]
    about = "turned" if rotation.isupper() else "fixed"
    return f"angles {rotation} about {about} axes"


@part("check.direction")
def direction(session: RecordedSession) -> Findings:
    """The poses are those of the base in the flange, not of the flange in the base."""
    session.require_poses()
    tried = [(arms, way) for arms in session.arms for way in _WAYS]
    others = [session.corrected(_WAYS[way][0], arms, **{way: True}) for arms, way in tried]
    evidence = best_of(fit_of(session), fit(equations_of(*others)))
    corrected_session = others[evidence.which]
    if evidence.probability == 1 or not helps(session, corrected_session):
        return
    arms, way = tried[evidence.which]
    if way == "inverted" and _marker_rather(session):
        yield _inverted_marker(session, evidence)
        return
    whose = "the" if session.seconds is None else named(arms, session)
    what, fix = f"{whose} {_WAYS[way][1]}", corrected_session.step()
    if way == "inverted" and _may_be_mounted_otherwise(session):
        what, fix = _of_exchanged(session, fix)
    yield evidence.finding("pose direction", what, corrected_session, fix)


LENS = np.radians(35)
"""No lens sees a target further from its axis."""
_MOUNTED_OTHERWISE: Mapping[str, tuple[str, str]] = {
    "target": ("in the hand", "eye-in-hand"),
    "camera": ("beside the robot", "eye-on-base"),
}
"""By what the recipe says the arm carries: where the camera then is, and how to say so."""


def _may_be_mounted_otherwise(session: RecordedSession) -> bool:
    """Whether camera and target, exchanged, come to the same as poses the other way round."""
    unknown = not np.isfinite(session.places).any()
    return session.links is None and session.seconds is None and unknown


def _of_exchanged(session: RecordedSession, inverted: str) -> tuple[str, str]:
    """Return what may be wrong, and the lines to choose from: the samples fit each of them."""
    held, name = _MOUNTED_OTHERWISE[session.carried]
    what = f"the camera is {held}, or the poses are flange_T_base"
    lines = [f"configuration: {{name: {name}, place: unknown}}", inverted]
    if np.isfinite(session.rotations).any():
        what += ", or the target's are target_T_camera"
        lines.append(_marker_inverted(session).step())
    return f"{what}: the samples fit each", OR_ELSE.join(lines)


def _marker_rather(session: RecordedSession) -> bool:
    """Whether targets lie where no lens sees them, and do not the other way round."""
    if not np.isfinite(session.rotations).any() or not _may_be_mounted_otherwise(session):
        return False
    return bool(_off_axis(session) > LENS >= _off_axis(_marker_inverted(session)))


def _off_axis(session: RecordedSession) -> float:
    """Return the largest angle between what was seen and the camera's axis [rad]."""
    x, y, z = session.centres.T
    return float(np.nanmax(np.arctan2(np.hypot(x, y), z)))


def _marker_inverted(session: RecordedSession) -> RecordedSession:
    turned = session.rotations.swapaxes(-1, -2)
    centres = -(turned @ session.centres[..., None])[..., 0]
    read = session.read_with(target_inverted=True)
    return replace(read, rotations=turned, centres=centres)


def _inverted_marker(session: RecordedSession, evidence: Significance) -> Finding:
    what = (
        f"the markers' poses are target_T_camera: as they are read, one is "
        f"{np.degrees(_off_axis(session)):.0f} deg from the camera's axis"
    )
    return evidence.finding("inverted marker", what, _marker_inverted(session))


_WAYS: Mapping[str, tuple[Change, str]] = {
    "inverted": (
        inverted,
        "poses are flange_T_base (or the camera is carried the other way round)",
    ),
    "transposed": (
        transposed,
        "rotations are transposed: matrices were stored column by column",
    ),
}

"""Rotations that were written one way and read another; poses given the other way round."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from flangeye import part
from flangeye.conventions import CONVENTIONS, EULER_ORDERS
from flangeye.diagnosis import Finding, Findings, Session
from flangeye.mending import inverted, reread, transposed
from flangeye_plugins.doctoring.asis import fit_of, variants
from flangeye_plugins.doctoring.fitting import fit
from flangeye_plugins.doctoring.significance import best_of

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
def convention(session: Session) -> Findings:
    """The rotations fit far better when their numbers are read in another convention."""
    pairs = list(_readings(session))
    poses = np.stack([reread(session.poses, *pair) for pair in pairs])
    evidence = best_of(fit_of(session), fit(variants(session, poses)))
    if evidence.probability < 1:
        read_as, written_as = pairs[evidence.which]
        what = f"the rotations were read as {_name(read_as)}, and fit as {_name(written_as)}"
        mended = session.corrected(poses[evidence.which], read_as=read_as, written_as=written_as)
        yield Finding("pose convention", what, mended.step(), (), *evidence[1:], mended)


def _readings(session: Session) -> Iterator[tuple[str, str]]:
    """Give (as read, as written): every pair of conventions with as many numbers."""
    stated = _stated(session)
    for read_as in [stated] if stated else [*QUATERNIONS, *COMMON]:
        others = QUATERNIONS if read_as in QUATERNIONS else ("vector", *EULER_ORDERS)
        if not stated and read_as not in QUATERNIONS:
            others = COMMON
        yield from ((read_as, other) for other in others if other != read_as)


def _stated(session: Session) -> str | None:
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
def direction(session: Session) -> Findings:
    """The poses are those of the base in the flange, not of the flange in the base."""
    poses = np.stack([inverted(session.poses), transposed(session.poses)])
    evidence = best_of(fit_of(session), fit(variants(session, poses)))
    if evidence.probability == 1:
        return
    what, correction = (
        ("the poses are flange_T_base (or the camera is carried the other way round)", "inverted"),
        ("the rotations are transposed: matrices were stored column by column", "transposed"),
    )[evidence.which]
    mended = session.corrected(poses[evidence.which], **{correction: True})
    yield Finding("pose direction", what, mended.step(), (), *evidence[1:], mended)

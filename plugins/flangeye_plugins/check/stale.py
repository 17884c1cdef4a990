"""Poses that a driver made up: the identity where it had none, or an old one again."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from flangeye import part
from flangeye.doctor.diagnosis import Finding, Findings, RecordedSession
from flangeye.types import Floats, Mask

SAME = 1e-9
"""Numbers that differ by less were not measured twice."""
MOVED = 1e-3
"""A target that has moved further was seen from another pose [m]."""


@part("check.identity")
def identity(session: RecordedSession) -> Findings:
    """A driver without data returned the identity as a robot pose or a marker's pose."""
    for whose, poses in _reported(session):
        robot = np.abs(poses - np.eye(4)).max(axis=(1, 2), initial=0.0) < SAME
        if robot.any():
            what = (
                f"{robot.sum()} of {len(session)} {whose} poses are the identity: the flange "
                "cannot be in the base; the driver had no pose to give"
            )
            yield _left_out(session, robot, "identity matrices", what)
    marker = _is_identity(session)
    if marker.any():
        what = f"{marker.sum()} of {len(session)} markers are at the camera itself, not turned"
        yield _left_out(session, marker, "identity matrices", f"{what}: nothing was detected there")


def _reported(session: RecordedSession) -> Iterator[tuple[str, Floats]]:
    """Give the poses (N, 4, 4) that the controllers reported, and what to call them."""
    if session.uses_poses:
        yield "robot", session.poses
    if session.links is not None:
        yield "link", session.links
    if session.seconds is not None:
        yield "second arm's", session.seconds


def _is_identity(session: RecordedSession) -> Mask:
    at_camera = np.abs(np.nan_to_num(session.centres, nan=1.0)).max(axis=1) < SAME
    turned = np.abs(session.rotations - np.eye(3)).max(axis=(1, 2))
    return np.asarray(at_camera & ~(turned > SAME))


@part("check.repeated")
def repeated(session: RecordedSession) -> Findings:
    """A pose or a detection was repeated although the arm had moved."""
    reported = [poses[:, :3].reshape(len(poses), 12) for _, poses in _reported(session)]
    yield from _repeats(session, np.concatenate(reported, axis=1), session.centres, "robot pose")
    places = np.concatenate([poses[:, :3, 3] for _, poses in _reported(session)], axis=1)
    yield from _repeats(session, session.centres, places, "detection")


def _repeats(
    session: RecordedSession, numbers: Floats, others: Floats, what: str
) -> Iterator[Finding]:
    """Find rows that repeat an earlier one to the last digit although the others moved on."""
    apart = np.abs(numbers[:, None] - numbers[None]).max(axis=2, initial=0.0)
    moved = np.linalg.norm(others[:, None] - others[None], axis=2) > MOVED
    wrong = np.tril((apart < SAME) & moved, k=-1).any(axis=1)
    made_up = any((np.abs(p[wrong] - np.eye(4)) < SAME).all() for _, p in _reported(session))
    if wrong.any() and not made_up:
        told = f"{wrong.sum()} of {len(session)} times the {what} is an earlier one to the last "
        yield _left_out(
            session,
            wrong,
            f"repeated {what}",
            f"{told}digit, although the arm had moved: it is stale",
        )


def _left_out(session: RecordedSession, wrong: NDArray[np.bool_], name: str, what: str) -> Finding:
    names = [each for each, bad in zip(session.ids, wrong, strict=True) if bad]
    if (session.seen & ~wrong).sum() < session.seen.sum() / 2:
        return Finding(name, what, "record again: too little is left", tuple(names))
    corrected_session = session.without(wrong)
    return Finding(
        name, what, corrected_session.step(), tuple(names), corrected_session=corrected_session
    )

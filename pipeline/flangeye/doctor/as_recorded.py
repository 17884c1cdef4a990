"""Who carries camera and target in a session, as the recipe's configuration says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from flangeye import types as t
from flangeye.doctor.diagnosis import RecordedSession
from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.configuration import LINK, Configuration, carriers_of
from flangeye.types import Floats


class State(NamedTuple):
    """What else was recorded of the arms: joints (n,) [rad], and base2_T_flange2 (4, 4) [m]."""

    joints: Floats | None
    second: Floats | None


def in_configuration(
    session: RecordedSession,
    configuration: Configuration,
    arm: Arm | None,
    states: Mapping[str, State],
) -> RecordedSession:
    """Add who carries what, and where the target is in what carries it.

    Args:
        session: The session of one arm beside its camera, as far as is known.
        configuration: Says otherwise.
        arm: The arm's kinematics, where a link carries the camera.
        states: What else was recorded, by the samples' ids.

    Raises:
        StageError: A carrier's pose is missing.
    """
    carried: Literal["target", "camera", "both"] = (
        "both" if configuration.other_base else "camera" if configuration.target == t.BASE
        else "target"
    )  # fmt: skip
    known = configuration.place
    if configuration.other_base and known is None and not np.isfinite(session.rotations).any():
        raise StageError(
            "two arms and a circle whose place is not known: give its place, which for the "
            "flange's own circle is known, or use a marker"
        )
    links = seconds = None
    if LINK in configuration.camera or configuration.other_base:
        bare = [_bare(session, i, states) for i in range(len(session))]
        carriers = carriers_of(configuration, bare, arm)
        links = None if configuration.other_base else carriers.camera
        seconds = carriers.target if configuration.other_base else None
    places = session.places if known is not None else np.full_like(session.places, np.nan)
    return replace(
        session,
        carried=carried,
        links=links,
        seconds=seconds,
        place=np.eye(4) if known is None else known,
        places=places,
    )


def _bare(session: RecordedSession, index: int, states: Mapping[str, State]) -> t.Observation:
    """Return a sample as an observation without a feature: where the controllers had it."""
    name = session.ids[index]
    joints, second = states.get(name, State(None, None))
    nothing = t.CircleFeature(np.zeros(3), None, {}, np.eye(3), None, 0.0)
    return t.Observation(
        name,
        nothing,
        t.by_frame(
            t.Transform(t.BASE, t.FLANGE, session.poses[index]),
            None if second is None else t.Transform(t.BASE2, t.FLANGE2, second),
        ),
        joints,
    )

"""Which of the readings of a marker session that fit alike is meant: on known places."""

from typing import Any, get_args

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from flangeye.estimation.estimate import estimate
from flangeye.estimation.session import session
from flangeye.estimation.session.readings import (
    Axes,
    Pairs,
    Reading,
    estimated,
    likely,
    optical,
    other_axes,
)
from flangeye.types import Floats
from flangeye.types.geometry import invert
from tests.estimation import foreign
from tests.estimation.sessions import robot

MODEL = robot("ur5e")[0]


def sound(kind: str, size: float = 0.1e-3) -> tuple[Pairs, Floats, Floats]:
    """Return a session's poses, and what the arm carries and what stands."""
    s = foreign.session(kind, foreign.UR5E, size, 16, 3)
    ends = (s.camera, s.target) if s.in_hand else (s.target, s.camera)
    return Pairs(s.reported, s.seen, s.in_hand), *ends


def distances(ends: tuple[Floats, Floats]) -> tuple[float, float]:
    near, far = (float(np.linalg.norm(each[:3, 3])) for each in ends)
    return near, far


@pytest.mark.parametrize("kind", ["marker", "hand"])
def test_a_sound_session_is_meant_as_it_is(kind: str) -> None:
    pairs, *ends = sound(kind)
    assert likely(pairs, *distances((ends[0], ends[1])), MODEL) == [Reading()]
    assert other_axes(pairs.marker[:, :3, 3]) is None


@pytest.mark.parametrize("kind", ["marker", "hand"])
@pytest.mark.parametrize(
    ("mistake", "inverse"),
    [
        (Reading(robot_inverted=True, marker_inverted=True), True),
        (Reading(marker_inverted=True, remounted=True), False),
        (Reading(robot_inverted=True, remounted=True), True),
    ],
)
def test_what_fits_alike_is_told_by_places_and_errors(
    kind: str, mistake: Reading, inverse: bool
) -> None:
    pairs, carried, standing = sound(kind)
    ends = (standing, carried) if inverse else (carried, standing)
    assert likely(mistake.of(pairs), *distances(ends), MODEL) == [mistake]


@pytest.mark.parametrize("kind", ["marker", "hand"])
def test_exchanged_tables_are_exchanged_back(kind: str) -> None:
    pairs, carried, standing = sound(kind)
    if pairs.in_hand:  # P C = S M with M the inverse of what is seen
        given = Pairs(invert(pairs.marker), invert(pairs.robot), True)
        back = Reading(exchanged=True, robot_inverted=True, marker_inverted=True)
    else:
        given, back = Pairs(pairs.marker, pairs.robot, False), Reading(exchanged=True)
    found = likely(given, *distances((carried, standing)), MODEL)
    assert back in found and Reading() not in found
    assert np.allclose(back.of(given).robot, pairs.robot)


@pytest.mark.parametrize("name", get_args(Axes))
def test_a_frame_with_other_axes_is_named(name: Axes) -> None:
    places = sound("marker")[0].marker[:, :3, 3]
    assert other_axes(places @ optical(name)) == name


def test_an_estimate_takes_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many small matrices on two threads take three times the processor's time."""
    threads: set[int] = set()

    def watched(*given: Any) -> Any:
        threads.update(each["num_threads"] for each in threadpool_info())
        return estimate(*given)

    monkeypatch.setattr(session, "estimate", watched)
    with threadpool_limits(2):
        assert estimated(sound("marker")[0], MODEL)
    assert threads == {1}

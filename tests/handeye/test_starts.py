"""Where a search begins: of exact measurements, at the answer itself, in every configuration."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.errors import CalibrationRefused
from flangeye.handeye import starts as rooms
from flangeye.handeye.loop import linearise
from flangeye.handeye.measurements import Loop, Measurements, loop_of, measurements_of
from flangeye.handeye.starts import fewest, size_of, start_of
from flangeye.maths.kinematics import Arm
from tests.handeye.cells import CONFIGURATIONS, ISSUE, ROBOT, session

EXACT = ISSUE.scaled(0.0)
FEWEST = {
    "eye-on-base, flange": (3, 3, 3), "eye-on-base, marker": (3, 4, 6),
    "eye-in-hand, marker": (3, 4, 6), "eye-in-hand, base circle": (3, 3, 3),
    "eye-on-arm 1, marker": (3, 4, 6), "eye-on-arm 1, flange": (3, 3, 3),
    "eye-on-arm 2, marker": (3, 4, 6), "eye-on-arm 2, base circle": (3, 3, 3),
    "two arms, marker": (6, None, None), "two arms, flange": (3, 5, 8),
}  # fmt: skip
"""Whole poses, circles and centres that a start needs."""
EACH = [
    (name, feature, count)
    for name, counts in FEWEST.items()
    for feature, count in zip(("pose", "normal", "centre"), counts, strict=True)
    if count is not None
]


def measured(name: str, feature: str, count: int, seed: int = 0) -> tuple[Measurements, Loop]:
    configuration = CONFIGURATIONS[name]
    drawn = session(configuration, np.random.default_rng(seed), count, 0.5, EXACT, feature)
    return measurements_of(drawn.observations, configuration, Arm(ROBOT)), loop_of(configuration)


@pytest.mark.parametrize(("name", "feature", "count"), EACH)
def test_as_few_exact_measurements_as_are_needed_give_the_answer(
    name: str, feature: str, count: int
) -> None:
    s, loop = measured(name, feature, count)
    assert fewest(s, loop) == count
    for seed in (1, 2):
        s, loop = measured(name, feature, count + 2, seed)
        at = start_of(s, loop, np.random.default_rng(0))
        near = 1e-4 if loop.y and loop.z else 1e-6  # two arms are solved by steps
        assert np.abs(linearise(s, loop, at, None).residuals).max() < near


def test_two_arms_and_a_circle_anywhere_have_no_start() -> None:
    s, loop = measured("two arms, marker", "normal", 9)
    with pytest.raises(CalibrationRefused, match="two arms and a circle whose place is not known"):
        start_of(s, loop, np.random.default_rng(0))


@pytest.mark.parametrize("name", [name for name in FEWEST if name != "two arms, marker"])
@pytest.mark.parametrize("size", [0.8, 1.25])
def test_how_much_larger_a_target_is_follows_from_whole_poses(name: str, size: float) -> None:
    """Two of twelve are wrong: they do not count."""
    s, loop = measured(name, "pose", 12)
    seen = s.centres / size
    seen[:2] += 0.1
    found = size_of(replace(s, centres=seen), loop, np.random.default_rng(0))
    assert found == pytest.approx(size, rel=1e-6)


def test_of_what_cannot_be_told_the_size_is_as_it_was_said() -> None:
    s, loop = measured("two arms, marker", "normal", 12)
    assert size_of(s, loop, np.random.default_rng(0)) == 1.0


def test_nothing_is_drawn_where_there_is_a_closed_form() -> None:
    never: Any = None
    s, loop = measured("eye-on-base, marker", "pose", 8)
    assert np.abs(linearise(s, loop, start_of(s, loop, never), None).residuals).max() < 1e-9


@pytest.mark.parametrize(
    ("factor", "told"), [(90.0, 90.0), (0.011, 0.011), (120.0, 1.0), (0.009, 1.0)]
)
def test_no_target_is_a_hundred_times_as_large_as_was_said_or_as_small(
    factor: float, told: float
) -> None:
    s, loop = measured("eye-in-hand, marker", "pose", 10)
    found = size_of(replace(s, centres=s.centres / factor), loop, np.random.default_rng(0))
    assert found == pytest.approx(told, rel=1e-5)


@pytest.mark.parametrize(
    ("errors", "starts", "taken"),
    [
        ([0.9], 1, 0),
        ([1.1, 0.5], 2, 1),
        ([5.0, 7.0, 6.0, 4.0, 0.9], 5, 4),
        ([2.0] + [3.0] * 20, 21, 0),
    ],
)
def test_another_start_is_tried_until_rotations_agree_to_a_degree(
    errors: list[float], starts: int, taken: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twenty more at most, of 200 steps each; the best is taken."""
    left, asked = iter(np.radians(errors)), list[int]()

    def alternate(given: Any, start: Any, rounds: int = 0) -> tuple[int, float]:
        asked.append(rounds)
        return len(asked) - 1, float(next(left))

    monkeypatch.setattr(rooms, "alternate", alternate)
    monkeypatch.setattr(rooms, "random_rotations", lambda rng: None)
    monkeypatch.setattr(rooms, "with_translations", lambda given, best: best)
    s, loop = measured("two arms, marker", "pose", 6)
    some: Any = None
    chosen: Any = rooms._of_two_arms(s, some, 20)
    assert chosen == taken and asked == [0] + [200] * (starts - 1)


def test_a_size_is_told_by_sixty_sets_of_eight_poses_or_of_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = list[int]()

    def never(s: Measurements, loop: Loop, rng: Any, restarts: int) -> Any:
        asked.append(len(s))
        assert restarts == 0
        raise np.linalg.LinAlgError

    monkeypatch.setattr(rooms, "start_of", never)
    for count, of in ((12, 8), (5, 5)):
        s, loop = measured("eye-in-hand, marker", "pose", count)
        assert size_of(s, loop, np.random.default_rng(0)) == 1.0
        assert asked == [of] * 60
        asked.clear()

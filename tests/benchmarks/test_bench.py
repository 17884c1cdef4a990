"""What the table of costs says of a ratio."""

import json

import pytest

from tests.benchmarks.__main__ import KEPT, told
from tests.benchmarks.cases import CASES, GOALS


@pytest.mark.parametrize(
    ("ratio", "kept", "words"),
    [
        (1.0, None, "new"),
        (1.2, 1.0, "1"),
        (1.29, 1.0, "1"),
        (1.5, 1.0, "+50%: slower than it was"),
    ],
)
def test_a_ratio_is_held_against_the_kept_one(ratio: float, kept: float | None, words: str) -> None:
    assert told(ratio, kept) == words


def test_goals_and_kept_figures_are_of_cases_there_are() -> None:
    assert set(GOALS) <= set(CASES)
    assert set(json.loads(KEPT.read_text())) <= set(CASES)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_every_case_can_be_measured(name: str) -> None:
    pair = CASES[name]()
    if pair is None:
        pytest.skip("its recordings are not here")
    for work in pair:
        work.call()

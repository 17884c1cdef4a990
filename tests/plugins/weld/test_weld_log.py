"""The log of a weld while it is made: what is in it when the program is killed, and who wrote it."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest

from flangeye.devices import WeldProfile
from flangeye_plugins.weld.weld_log import Cycle, WeldLog, columns


def cycle(i: int) -> Any:
    every: Any = [float(i)] * len(Cycle._fields)
    return Cycle(*every)


def sight(felt: Any = None) -> Any:
    piece = SimpleNamespace(image="pixels", corner=(3, 4))
    return SimpleNamespace(feeling=felt, piece=piece, time_ns=77)


@pytest.mark.parametrize("beside", [False, True])
def test_no_more_than_twenty_five_cycles_wait_to_be_written(beside: bool) -> None:
    """Whoever goes on with a killed weld loses those: a fifth of a second."""
    written = list[tuple[str, Any, str]]()

    def log(name: str, value: Any) -> None:
        written.append((name, value, threading.current_thread().name))

    with WeldLog(log, beside) as told:
        for i in range(60):
            told.turned(cycle(i))
            assert beside or sum(len(value["time"]) for _, value, _ in written) >= i + 1 - 24
    assert [len(value["time"]) for _, value, _ in written] == [25, 25, 10]
    assert [t for _, value, _ in written for t in value["time"]] == [float(i) for i in range(60)]
    assert {name for name, _, _ in written} == {"cycles"} and len(told.cycles) == 60
    assert {thread for _, _, thread in written} == {"stage log" if beside else "MainThread"}


def test_images_are_numbered_from_when_the_weld_begins_and_kept_where_a_tag_was_felt() -> None:
    written = list[tuple[str, Any]]()
    with WeldLog(lambda name, value: written.append((name, value)), False) as log:
        log.before(sight("touched"))
        assert [log.saw(sight(felt)) for felt in (None, "left", "right")] == [0, 1, 2]
    assert dict[int, Any](log.felt) == {1: "left", 2: "right"} and log.sights == 3
    sights = [value for name, value in written if name == "sight"]
    assert [(each["number"], each["tag"]) for each in sights] == [
        (-1, True), (0, False), (1, True), (2, True),
    ]  # fmt: skip
    assert sights[0]["time_ns"] == 77 and sights[0]["corner"] == (3, 4)
    assert [value for name, value in written if name == "feeling"] == ["left", "right"]
    assert sum(name == "image" for name, _ in written) == 4


def test_cycles_are_kept_column_by_column() -> None:
    table = columns([cycle(1), cycle(2)])
    assert list(table) == list(Cycle._fields) and table["turn"] == [1.0, 2.0]


def test_a_profile_is_logged_with_the_cycle_that_takes_it_in() -> None:
    written = list[Any]()
    with WeldLog(lambda name, value: written.append((name, value)), False) as log:
        log.looked(WeldProfile(1e-4, 5e-5, 7))
        log.turned(cycle(0))
        log.turned(cycle(1))
        log.looked(WeldProfile(2e-4, 5e-5, 8))
    told = [value for name, value in written if name == "profile"]
    assert [each["cycle"] for each in told] == [0, 2] and told[1]["offset"] == 2e-4

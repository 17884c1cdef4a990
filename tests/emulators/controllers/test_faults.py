from typing import Any

import pytest

from flangeye.errors import StageError
from flangeye_emulators.controllers.network import Fault, Kind, Schedule, parse_fault

KINDS = {
    "freeze": Kind(lambda seconds: None, takes_seconds=True),
    "drop": Kind(lambda seconds: None),
}


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("drop", Fault("drop", None, 0.0)),
        ("freeze=300 ms", Fault("freeze", 0.3, 0.0)),
        ("freeze@2 s", Fault("freeze", None, 2.0)),
        ("freeze=3 s@moving", Fault("freeze", 3.0, None)),
    ],
)
def test_what_goes_wrong_and_when_is_read(text: str, fault: Any) -> None:
    assert parse_fault(text, KINDS) == fault


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("melt", "no fault 'melt'; there are freeze, drop"),
        ("drop=3 s", "the fault 'drop' takes no duration"),
        (
            "freeze=3",
            "fault 'freeze=3': '3' has no unit: a duration needs one (ms, s, min, for example "
            "'500 ms')",
        ),
        (
            "drop@soon",
            "fault 'drop@soon': 'soon' is not a duration: write a number and a unit (ms, s, min, "
            "for example '500 ms')",
        ),
    ],
)
def test_what_cannot_go_wrong_is_said(text: str, message: str) -> None:
    with pytest.raises(StageError) as error:
        parse_fault(text, KINDS)
    assert str(error.value) == message


def test_faults_wait_for_their_time() -> None:
    happened: list[tuple[str, float | None]] = []

    def kind(name: str) -> Kind:
        return Kind(lambda seconds: happened.append((name, seconds)))

    kinds = {name: kind(name) for name in "abc"}
    schedule = Schedule(kinds)
    schedule.add(Fault("a", None, 0.0), now=1.0)
    schedule.add(Fault("b", 0.5, 2.0), now=1.0)
    schedule.add(Fault("c", None, None), now=1.0)
    schedule.step(1.0, moving=False)
    assert happened == [("a", None)]
    schedule.step(2.0, moving=True)
    schedule.step(2.9, moving=True)
    assert happened == [("a", None), ("c", None)]
    schedule.step(3.0, moving=False)
    assert happened[2:] == [("b", 0.5)]
    schedule.add(Fault("a", None, 1.0), now=3.0)
    schedule.clear()
    schedule.step(9.0, moving=True)
    assert len(happened) == 3

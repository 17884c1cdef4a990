"""A history's file, its lock, its lines for programs, and its chart, by numbers."""

from __future__ import annotations

import fcntl
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.workflow.doctor.monitor.chart import STATE_COLOURS, figure, sentence, write_chart
from flangeye.workflow.doctor.monitor.drift import DriftTest
from flangeye.workflow.doctor.monitor.history import (
    CheckFinding,
    History,
    MonitorCheck,
    as_json,
    history_beside,
    only_user,
)

NOON = 1_000_000_000 * 10**9  # 2001-09-09 01:46:40


def seen(number: int, covariance: float = 1e-8) -> t.Observation:
    """Return a sighting like no other."""
    centre, normal = np.array([0.1, 0.2, 1.0 + 1e-3 * number]), np.array([0.0, 0.0, -1.0])
    circle = t.CircleFeature(
        centre, normal, {}, covariance * np.eye(3), 1e-8 * np.diag([1.0, 1.0, 0.0]), 0.9
    )
    pose = t.Transform(t.BASE, t.FLANGE, np.eye(4))
    return t.Observation(f"scan-{number}", circle, t.by_frame(pose))


def finding(number: int, **changed: Any) -> CheckFinding:
    told: dict[str, Any] = {
        "check": number, "state": "OK", "shift": 1.23456e-3,
        "motion": (np.radians(3.0), np.radians(4.0), 0.0, 0.7, 0.8, 0.9), "since": None,
        "statistic": 0.98765,
    }  # fmt: skip
    return CheckFinding(**told | changed)


def history(path: Path, *findings: CheckFinding, times: list[int] | None = None) -> History:
    """Return a history with so many checks of one sighting each."""
    made = History(path, "key")
    for number, each in enumerate(findings):
        when = times[number] if times else NOON + number * 3600 * 10**9
        made.add(MonitorCheck(f"source {number}", (seen(number),), when))
        made.findings.append(each)
    return made


def test_a_history_comes_back_with_its_key_and_is_empty_before_its_first_check(
    tmp_path: Path,
) -> None:
    path = tmp_path / "h.jsonl"
    assert History.read(path, "key").checks == []
    moved = finding(1, state="MOVED", since=1, part="scanner", probability=0.75)
    history(path, finding(0), moved).write()
    head, *lines = path.read_bytes().splitlines()
    assert json.loads(head)["calibration"] == "key" and len(lines) == 2
    read = History.read(path, "key")
    assert read.findings == [finding(0), moved]
    assert [c.source for c in read.checks] == ["source 0", "source 1"]
    observed, of = read.sightings()
    assert [o.id for o in observed] == ["scan-0", "scan-1"] and of.tolist() == [0, 1]
    with pytest.raises(StageError, match="is the history of another calibration"):
        History.read(path, "another")


@pytest.mark.parametrize("when", [0, (1 << 63) - 1])
def test_a_check_of_an_unknown_or_a_far_time_that_found_a_step_at_once_is_read(
    tmp_path: Path, when: int
) -> None:
    told = finding(0, state="MOVED", since=0, probability=1.0)
    history(tmp_path / "h.jsonl", told, times=[when]).write()
    read = History.read(tmp_path / "h.jsonl", "key")
    assert read.findings == [told]
    assert read.checks[0].time_ns == when
    assert (finding(0).probability, MonitorCheck("source", ()).time_ns) == (0.0, 0)


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        (finding(1, since=2), "its stored verdict belongs to another check"),
        (finding(0), "its stored verdict belongs to another check"),
        (finding(1, motion=(0.0,) * 5), "motion: "),
        (finding(1, motion=(0.0,) * 7), "motion: "),
    ],
)
def test_a_finding_that_no_check_leaves_behind_is_refused(
    tmp_path: Path, wrong: CheckFinding, why: str
) -> None:
    path = tmp_path / "h.jsonl"
    history(path, finding(0, since=0), wrong).write()
    with pytest.raises(StageError, match=f"h.jsonl: check 1: {why}"):
        History.read(path, "key")


def test_a_time_that_no_clock_has_is_refused(tmp_path: Path) -> None:
    history(tmp_path / "h.jsonl", finding(0), times=[1 << 63]).write()
    with pytest.raises(StageError, match="h.jsonl: check 0: time_ns: "):
        History.read(tmp_path / "h.jsonl", "key")


@pytest.mark.parametrize("covariance", [0.0, -1e-8])
def test_a_covariance_of_nothing_is_refused(tmp_path: Path, covariance: float) -> None:
    path, made = tmp_path / "h.jsonl", History(tmp_path / "h.jsonl", "key")
    made.checks.append(MonitorCheck("source", (seen(0, covariance),), 0))
    made.findings.append(finding(0))
    made.write()
    with pytest.raises(StageError, match="check 0: .*covariance"):
        History.read(path, "key")


def test_a_check_is_one_line_for_programs_in_millimetres_and_degrees(tmp_path: Path) -> None:
    moved = finding(
        1, state="MOVED", since=0, part="scanner", probability=0.87654, set_aside=("scan-7",)
    )
    made = history(tmp_path / "h.jsonl", finding(0), moved)
    assert json.loads(as_json(made, moved, True)) == {
        "check": 1, "time": "2001-09-09T02:46:40+00:00", "source": "source 1", "sightings": 1,
        "set_aside": ["scan-7"], "state": "MOVED", "simulated": True,
        "shift_mm": 1.2346, "turn_deg": 5.0, "since_check": 0, "since": "2001-09-09T01:46:40+00:00", "part": "scanner",
        "probability": 0.877, "statistic": 0.988,
    }  # fmt: skip
    turned = finding(0, motion=(np.radians(1.234567), 0.0, 0.0, 0.0, 0.0, 0.0))
    told = json.loads(as_json(made, turned, False))
    assert told["turn_deg"] == 1.23457
    assert [told[name] for name in ("since_check", "since", "part", "probability")] == 4 * [None]
    unknown = history(tmp_path / "h.jsonl", finding(0), times=[0])
    assert json.loads(as_json(unknown, finding(0), False))["time"] is None


def test_a_check_is_a_sentence() -> None:
    assert sentence(finding(3)) == (
        "the work is off by 1.23 mm at its worst corner, which is within what the calibration "
        "allows."
    )
    moved = finding(3, since=2, part="scanner", probability=0.87654)
    assert sentence(moved) == (
        "the work is off by 1.23 mm at its worst corner, since check 2; most likely scanner (88%)."
    )
    assert sentence(finding(3, since=0)).endswith("corner, since check 0.")


def test_the_history_stands_beside_the_log() -> None:
    assert history_beside(Path("runs/1/run.mcap")) == Path("runs/1/monitor.jsonl")


# --- the lock -------------------------------------------------------------------------------------


class Clock:
    """A clock that goes while it is slept by; after so much time another lets go of the lock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, until: float) -> None:
        self.now, self.slept = 100.0, list[float]()
        self._flock, self._until = fcntl.flock, until
        monkeypatch.setattr(fcntl, "flock", self.flock)
        monkeypatch.setattr("flangeye.workflow.doctor.monitor.history.time", SimpleNamespace(
            monotonic=lambda: self.now, sleep=self.sleep
        ))  # fmt: skip

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds

    def flock(self, file: Any, how: int) -> None:
        assert how == fcntl.LOCK_EX | fcntl.LOCK_NB
        if self.now < self._until:
            raise BlockingIOError
        self._flock(file, how)


@pytest.mark.parametrize(("held", "gets"), [(0.0, True), (59.9, True), (60.2, False)])
def test_another_that_adds_a_check_is_waited_for_a_minute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, held: float, gets: bool
) -> None:
    clock, path = Clock(monkeypatch, 100.0 + held), tmp_path / "new" / "h.jsonl"
    entered = []
    if gets:
        with only_user(path):
            entered.append(True)
        assert (tmp_path / "new" / ".h.jsonl.lock").exists()
    else:
        with pytest.raises(StageError) as error, only_user(path):
            entered.append(True)
        assert str(error.value) == (
            f"{path}: another program has locked it for 60 s; end it, and check again"
        )
    assert bool(entered) is gets and set(clock.slept) <= {0.05}
    assert clock.now - 100.0 == pytest.approx(min(held, 60.0), abs=0.06)


def test_a_lock_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(StageError, match=r"file/.h.jsonl.lock: cannot be written: File exists$"),
        only_user(tmp_path / "file" / "h.jsonl"),
    ):
        pass


# --- the chart ------------------------------------------------------------------------------------


def test_the_chart_has_shifts_above_and_the_step_test_below_with_their_limits(
    tmp_path: Path,
) -> None:
    states = ("OK", "DEGRADED", "MOVED")
    findings = [
        finding(number, state=state, shift=1e-3 * (number + 1), statistic=0.5 * number)
        for number, state in enumerate(states)
    ]
    chart = figure(history(tmp_path / "h.jsonl", *findings), DriftTest(limit=0.8e-3))
    shifts, steps = chart.data
    assert list(shifts.y) == pytest.approx([1.0, 2.0, 3.0]) and list(steps.y) == [0.0, 0.5, 1.0]
    assert [f"{at:%H:%M:%S}" for at in shifts.x] == ["01:46:40", "02:46:40", "03:46:40"]
    assert list(shifts.marker.color) == [STATE_COLOURS[state] for state in states]
    assert list(shifts.text) == list(states)
    assert (shifts.yaxis, steps.yaxis, shifts.xaxis, steps.xaxis) == ("y", "y2", "x", "x2")
    limits = [(line.y0, line.yref, line.line.color) for line in chart.layout.shapes]
    assert [each[0] for each in limits] == pytest.approx([0.8, 0.4, 1.0])
    assert [each[1:] for each in limits] == [
        ("y", STATE_COLOURS["MOVED"]), ("y", STATE_COLOURS["DEGRADED"]), ("y2", STATE_COLOURS["MOVED"])
    ]  # fmt: skip
    layout = chart.layout
    assert (layout.yaxis.title.text, layout.yaxis2.title.text) == (
        "shift of the work, mm", "step test / threshold"
    )  # fmt: skip
    # Two thirds and a third, with a narrow gap, on a page that is as high as a screen.
    assert layout.yaxis.domain == pytest.approx((0.389, 1.0), abs=1e-3)
    assert layout.yaxis2.domain == pytest.approx((0.0, 0.329), abs=1e-3)
    assert (layout.height, layout.margin.t, layout.margin.r) == (560, 20, 20)
    assert (shifts.marker.size, shifts.line.width) == (8, 1)
    assert layout.xaxis.tickvals is None and layout.xaxis2.tickvals is None


@pytest.mark.parametrize("times", [[0, NOON], [NOON, NOON]])
def test_checks_without_a_time_of_their_own_are_placed_by_their_number(
    tmp_path: Path, times: list[int]
) -> None:
    made = history(tmp_path / "h.jsonl", finding(0), finding(1), times=times)
    assert list(figure(made, DriftTest()).data[0].x) == [0, 1]


def test_the_chart_is_a_page_that_says_the_state_of_the_last_check(tmp_path: Path) -> None:
    made = history(tmp_path / "h.jsonl", finding(0), finding(1, state="MOVED", since=1))
    write_chart(made, DriftTest(), tmp_path / "h.html", True)
    assert "<h1>MOVED (simulated)</h1>" in (tmp_path / "h.html").read_text()
    write_chart(made, DriftTest(), tmp_path / "h.html", False)
    page = (tmp_path / "h.html").read_text()
    assert "<h1>MOVED</h1>" in page and "since check 1" in page and "h.jsonl: 2." in page

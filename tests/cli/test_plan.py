"""A dry run's plan for programs: the same as for people."""

import json
import shlex
from pathlib import Path

import pytest

from tests.conftest import Call

DRY = "run ur5e_phoxi-m_loopback --offline --out run --set acquire.live.verification=1"
FEW = ["--set", "acquire.live.poses={grid: {counts: [3, 3, 1]}}"]
HOME = ["--set", "acquire.live.home=[180 deg, -90 deg, 90 deg, -90 deg, -90 deg, 0 deg]"]


def test_the_plan_as_json_is_the_one_for_people(
    command: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = [
        *shlex.split(DRY),
        *HOME,
        *FEW,
        "--set",
        "robot.limits.box.size=[1000 mm, 300 mm, 900 mm]",
    ]
    code, text, err = command(*words)
    assert (code, err) == (0, "")
    _, out, _ = command(*words, "--json")
    plan = json.loads(out)
    assert plan["text"] == text.rstrip("\n")
    stops = [row for row in plan["rows"] if row["id"]]
    assert text.startswith(f"{len(stops)} stops, {plan['seconds']:.0f} s of motion")
    assert plan["seconds"] == pytest.approx(sum(row["seconds"] for row in plan["rows"]))
    for row, line in zip(stops, text.splitlines()[2:], strict=False):
        place = " ".join(f"{1e3 * x:7.1f}" for x in row["place"])
        assert line.startswith(f"{row['id']}  {row['role']:12}  {place}")
        assert row["path"] in line and row["why_not"] is None
    left_out = [row for row in plan["rows"] if row["id"] is None]
    assert left_out and all(row["why_not"] in text for row in left_out)
    assert list(tmp_path.iterdir()) == []


def test_a_simulated_session_shows_its_plan_and_does_not_run(
    command: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, _ = command(*shlex.split("run ur5_phoxi-m_simulated --json"))
    plan = json.loads(out)
    stops = [row for row in plan["rows"] if row["id"]]
    assert code == 0 and plan["text"].startswith(f"{len(stops)} stops of a simulated arm")
    assert [row["role"] for row in stops] == ["verification"] + ["calibration"] * (len(stops) - 1)
    assert any(row["why_not"] == "out of the scanner's view" for row in plan["rows"])
    assert list(tmp_path.iterdir()) == []


def test_an_archive_has_no_plan(command: Call) -> None:
    code, _, err = command(*shlex.split("run ur5_phoxi-m_sample --json"))
    assert (code, err.splitlines()[-1]) == (
        2,
        "error: --json: acquire.archive plans no poses; acquire.live and acquire.simulated do",
    )

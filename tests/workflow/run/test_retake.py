"""Captures that are taken again, or left out: by command, on what a log holds."""

from __future__ import annotations

from pathlib import Path

import pytest

from flangeye.workflow.log.read import read_run
from tests import toy
from tests.conftest import Call


def test_a_capture_is_taken_again_and_the_rest_is_kept(done: Call) -> None:
    toy.acquired.clear()
    code, _, err = done("run", "--resume", "done", "--retake", "003", "--out", "again")
    assert code == 0, err
    log = read_run(Path("again"))
    assert list(log.poses) == ["003", "000", "001", "002", "004", "005"]
    assert log.observations()[0].id == "003"
    assert log.complete
    kept = [e.seconds for e in log.entries if e.capture not in (None, "003")]
    kept += [meta["seconds"] for capture, meta in log.poses.items() if capture != "003"]
    assert len(kept) == 15 and not any(kept)  # what was taken before cost this run nothing


def test_a_capture_is_left_out_and_named_so(done: Call) -> None:
    words = ("--from", "done/run.mcap", "--at", "solve.toy", "--leave-out", "003", "--out", "less")
    code, _, err = done("run", "toy.yaml", *words)
    assert code == 0, err
    found = read_run(Path("less")).result
    assert found is not None
    aside = {o["id"]: o["reason"] for o in found["observations"] if not o["used"]}
    assert aside == {"003": "acquire: left out by --leave-out"}
    assert sum(o["used"] for o in found["observations"]) == 5


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("toy.yaml", "--retake", "003"),
         "--retake goes with --resume RUN, --leave-out with --from RUN.MCAP --at STEP"),
        (("toy.yaml", "--leave-out", "003"),
         "--retake goes with --resume RUN, --leave-out with --from RUN.MCAP --at STEP"),
        (("--resume", "done"),
         "done/run.mcap: this run is complete; there is nothing to resume "
         "(--retake ID takes a capture again)"),
        (("--resume", "done", "--retake", "9"),
         "--retake 9: done/run.mcap has no such capture; it has 000, 001, 002, 003, 004, 005"),
        (("toy.yaml", "--from", "done/run.mcap", "--at", "solve.toy", "--leave-out", "x"),
         "--leave-out x: done/run.mcap has no such capture; it has 000, 001, 002, 003, 004, 005"),
    ],
)  # fmt: skip
def test_what_cannot_be_taken_again_is_one_line(
    done: Call, words: tuple[str, ...], line: str
) -> None:
    assert done("run", *words)[::2] == (2, f"error: {line}\n")

"""The zeros of a cell's arms: found about those before, on the likeliest branch, and told."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.handeye import cell_arms as room
from flangeye.handeye.bent import KINDS, Bent, BentArm
from flangeye.handeye.cell_arms import (
    CorrectedArms,
    _corrected,
    _kinds,
    _seen,
    _told,
    considering_errors,
)
from flangeye.handeye.graph import Solved, problem_of, solve_graph
from flangeye.handeye.likelihood import agreeing
from flangeye.maths.frame_graph import Frame
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from tests.handeye.test_graph import (
    CELLS,
    COVARIANCE,
    HOME,
    N,
    error,
    seen,
    unknown_in,
)

UR5 = Arm(load_model("robots", "ur5"))
OFF = np.array([0.0, 1.5e-3, -2e-3, 1e-3, 2e-3, -1e-3])
"""Zeros [rad]; the first joint's is the base's."""


def a_cell(offsets: Any, names: tuple[str, ...] = ("flange",)) -> tuple[Solved, list[BentArm], Any]:
    """Return two scanners' answer for an arm as reported, the arm, and where all truly is."""
    frames, unknown, pairs = CELLS["two fixed scanners and one arm"]
    joints = HOME + np.random.default_rng(1).uniform(-0.5, 0.5, (N, 6))
    actual = {**frames, "flange": Frame("base", UR5.flange(joints + offsets))}
    given, _ = unknown_in({**frames, "flange": Frame("base", UR5.flange(joints))}, unknown)
    sightings = seen(actual, pairs, np.random.default_rng(0), 0.2)
    found = solve_graph(given, sightings, dict.fromkeys(names, COVARIANCE))
    return found, [BentArm([Bent("flange", UR5, joints, 3e-4, np.zeros(6))])], actual


def test_zeros_are_found_with_the_unknowns_and_mend_these() -> None:
    found, arms, actual = a_cell(OFF)
    corrected = _corrected(found, arms, 10.0)
    (arm,) = corrected.arms
    # The last joint turns the marker about its own axis: hardly told from where the marker is.
    assert arm.offsets[1:5] == pytest.approx(OFF[1:5], abs=4e-4)
    for name in ("left", "right"):
        before, after = (
            np.linalg.norm(error(x.places[name], actual[name].place)[3:])
            for x in (found, corrected.found)
        )
        assert after < 0.5 * before
    assert corrected.found.problem.frames["flange"].place == pytest.approx(
        UR5.flange(arms[0].joints + OFF), abs=3e-3
    )


def test_each_step_is_about_the_zeros_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is left of them is expected to take them back: less offsets in all, and no drift."""
    found, arms, _ = a_cell(OFF)
    expected: list[Any] = []

    def watched(problem: Any, fit: Any) -> Any:
        expected.append(problem.nuisance.mean)
        return agreeing(problem, fit)

    monkeypatch.setattr(room, "agreeing", watched)
    corrected = _corrected(found, arms, 10.0)
    assert len(expected) == 3 and not expected[0].any()
    assert expected[2] * 3e-4 == pytest.approx(-corrected.arms[0].offsets[1:], abs=2e-5)


def test_errors_of_each_kind_move_what_is_seen_as_a_bent_arm_does() -> None:
    found, (arm,), _ = a_cell(0 * OFF)
    problem, fit = found.problem, found.found
    kinds = _kinds(problem, fit, [arm])
    assert len(kinds) == 1 + len(KINDS)
    assert all((kind.prior == 1.0).all() for kind in kinds)
    step = np.array([0.0, 0, 1, 0, 0])
    bent = {
        **problem.frames,
        "flange": replace(problem.frames["flange"], place=arm.moved(step).poses["flange"]),
    }
    before, after = (replace(problem, frames=f).linearised(fit.at).residuals
                     for f in (problem.frames, bent))  # fmt: skip
    assert before - after == pytest.approx(kinds[0].seen @ step, abs=2e-6)


def test_errors_of_two_arms_are_apart() -> None:
    frames, unknown, pairs = CELLS["two arms with a scanner each and one between"]
    given, at = unknown_in(frames, unknown)
    problem = problem_of(given, seen(frames, pairs, np.random.default_rng(0)))
    arms: Any = [SimpleNamespace(poses={name: None}) for name in ("flange", "flange2")]
    twists = [np.ones((N, 6, k)) for k in (2, 3)]
    fit: Any = SimpleNamespace(at=at)
    both = _seen(problem, fit, arms, twists)
    alone = [_seen(problem, fit, [arm], [twist]) for arm, twist in zip(arms, twists, strict=True)]
    assert both.seen == pytest.approx(np.concatenate([x.seen for x in alone], axis=2))


def chosen_by(gains: dict[str, float], branches: list[list[str]], monkeypatch: Any) -> Any:
    """Return the branches that are taken where each explains so much, by itself."""
    monkeypatch.setattr(room, "_gain", lambda found, arms: sum(gains[arm] for arm in arms))
    given: Any = branches
    nothing: Any = None
    return room.likeliest(nothing, given)


def test_each_arm_is_taken_on_the_likeliest_branch(monkeypatch: pytest.MonkeyPatch) -> None:
    gains = {"up": 1.0, "down": 5.0, "left": 3.0, "right": 2.0, "back": 4.0, "only": 0.0}
    branches = [["up", "down"], ["only"], ["left", "right", "back"]]
    assert chosen_by(gains, branches, monkeypatch) == ["down", "only", "back"]
    gains["down"], gains["back"] = 0.5, 1.0
    assert chosen_by(gains, branches, monkeypatch) == ["up", "only", "left"]


def test_offsets_are_told_in_milliradians() -> None:
    arms: Any = [SimpleNamespace(name="left", offsets=np.array([0, 1.25e-3]), joints=np.ones((2, 2))),
                 SimpleNamespace(name="right", offsets=np.array([0, -2e-3]), joints=np.ones((2, 2)))]  # fmt: skip
    assert _told(arms) == (
        "the joints of left are off by (0.00, 1.25) mrad, of right are off by (0.00, -2.00) mrad; "
        "the second answer is for them so corrected"
    )
    nothing: Any = None
    corrections = CorrectedArms(nothing, arms).corrections
    assert corrections["right"].tool_offset.tolist() == [0.0] * 3
    assert corrections["right"].joint_offsets is arms[1].offsets


def test_what_was_considered_before_stays_in_the_covariance() -> None:
    found, arms, _ = a_cell(OFF)
    before, sizes = considering_errors(found, [arms])
    clocks = 1e-6 * np.diag(np.arange(1.0, 19.0))
    after, _ = considering_errors(found.with_joint(found.joint + clocks), [arms])
    assert sizes is not None
    assert after.joint - before.joint == pytest.approx(clocks, abs=1e-12)

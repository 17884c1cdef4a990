"""Arms of a cell that moved while cameras, each with a clock of its own, saw them."""

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye import CalibrationRefused
from flangeye.handeye.cell import calibrate_cell
from flangeye.handeye.cell_clock import _told
from flangeye.handeye.graph import LIMITS
from flangeye.maths.frame_graph import Frame
from flangeye.maths.geometry import invert, rigid, rotation_exp
from flangeye.maths.statistics import chi2_quantile
from flangeye.maths.streams import passed, pose_at
from flangeye.models.cell import Axis, Cell
from flangeye.types import CAMERA, TARGET, Motion, Observation, PoseFeature, Transform
from tests.handeye.cells import errors, moving

TURN, SHIFT = 0.5e-3, 0.1e-3
PLACES = {
    "left": rigid(rotation_exp(np.array([3.0, 0.1, 0.0])), np.array([0.4, 0.6, 1.1])),
    "right": rigid(rotation_exp(np.array([3.0, -0.2, 0.3])), np.array([0.4, -0.7, 1.2])),
    "marker": rigid(rotation_exp(np.array([0.0, 0.1, 0.2])), np.array([0.01, 0.02, 0.05])),
}
# Whatever moves it: no model of an arm is held against its poses here.
CELL = Cell(
    {"arm_base": Frame("base", np.eye(4)), "arm": Frame("arm_base"), "left": Frame("base"),
     "right": Frame("base"), "marker": Frame("arm")},
    {"arm": Axis(np.array([0.0, 0.0, 1.0]), turns=True, travel=(-1.0, 1.0))},
    ("left", "right"), ("marker",),
)  # fmt: skip


def seen(delays: Any, seed: int = 0, recorded: float = 1.0) -> list[Observation]:
    """Return what two cameras saw of a moving marker, by clocks that are so much early [s]."""
    rng, stream = np.random.default_rng(seed), np.arange(0.0, 26.0, 0.01)
    poses, out = moving(stream), []
    for i, when in enumerate(np.sort(rng.uniform(1.0, 25.0, 40))):
        camera = ("left", "right")[i % 2]
        actual = moving(np.array([when + delays[camera]]))[0]
        true = invert(PLACES[camera]) @ actual @ PLACES["marker"]
        noise = rng.standard_normal(6) * np.repeat([TURN, SHIFT], 3)
        pose = rigid(rotation_exp(noise[:3]) @ true[:3, :3], true[:3, 3] + noise[3:])
        feature = PoseFeature(
            Transform(CAMERA, TARGET, pose), np.diag(np.repeat([TURN**2, SHIFT**2], 3))
        )
        motion = passed(stream, poses, when, {"arm": (stream, poses)})
        near = np.abs(motion.times) <= recorded
        arm = {"arm": motion.others["arm"][near]}
        motion = Motion(motion.times[near], motion.poses[near], arm)
        at = {"arm": Transform("arm_base", "arm", pose_at(motion, 0.0, "arm"))}
        out.append(Observation(f"{i:03}", feature, at, None, camera, "marker", motion))
    return out


def solved(delays: Any, seed: int = 0, recorded: float = 1.0) -> tuple[list[float], list[str]]:
    """Return the squared distance of every transform, of six, and what is told of clocks."""
    found = calibrate_cell(seen(delays, seed, recorded), CELL, LIMITS, "solve.cell")
    squares = []
    for estimate in found.transforms.values():
        off = errors(estimate, PLACES[estimate.transform.child])
        squares.append(float(off @ np.linalg.solve(estimate.covariance, off)))
    return squares, [note for note in found.notes if "the arms were at the poses" in note]


@pytest.mark.parametrize("delays", [{"left": 0.0, "right": 0.06}, {"left": -0.04, "right": 0.08}])
def test_each_cameras_delay_is_found_and_every_place_is_right(delays: Any) -> None:
    squares, (note,) = solved(delays)
    told = re.findall(r"([\d.]+) \+- ([\d.]+) ms (after|before) the times that (\w+) gives", note)
    assert [camera for *_, camera in told] == ["left", "right"]
    for delay, sigma, which, camera in told:
        signed = float(delay) * (1 if which == "after" else -1)
        assert signed == pytest.approx(1e3 * delays[camera], abs=4 * float(sigma) + 0.1)
        assert float(sigma) < 2
    assert not note.startswith("left out")
    assert max(squares) < chi2_quantile(0.999, 6)


def test_where_the_clocks_agree_nothing_is_told() -> None:
    squares, notes = solved({"left": 0.0, "right": 0.0}, seed=1)
    assert not notes
    assert max(squares) < chi2_quantile(0.999, 6)


def test_a_delay_beyond_what_was_recorded_is_told_and_left_in_the_covariance() -> None:
    delays = {"left": 0.0, "right": 0.06}
    squares, (note,) = solved(delays, recorded=0.03)
    assert note.startswith("left out, for no pose was recorded so far away: the arms were at the")
    assert max(squares) < chi2_quantile(0.999, 6)


def test_arms_that_stood_still_have_no_clock() -> None:
    still = [replace(o, motion=None) for o in seen({"left": 0.0, "right": 0.0})]
    found = calibrate_cell(still, CELL, LIMITS, "solve.cell")
    assert not [note for note in found.notes if "the arms were" in note]


def test_a_camera_whose_sightings_all_disagree_is_named() -> None:
    told = "where right is: .*; no sighting that agrees with others has right in it"
    with pytest.raises(CalibrationRefused, match=told):
        solved({"left": 0.0, "right": 0.5})


def test_how_late_the_arms_are_is_told_of_each_camera() -> None:
    left: Any = SimpleNamespace(covariance=np.diag([1e-6, 4e-6]))
    assert _told(CELL, np.array([12.34e-3, -4e-3]), left) == (
        "the arms were at the poses 12.3 +- 1.0 ms after the times that left gives, "
        "4.0 +- 2.0 ms before the times that right gives"
    )

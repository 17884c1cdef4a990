"""Arms of a cell that moved while cameras, each with a clock of its own, saw them."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye import CalibrationRefused
from flangeye.maths.streams import passed, pose_at, with_joints
from flangeye.models.cell import Axis, Cell, Frame
from flangeye.types import CAMERA, TARGET, Motion, Observation, PoseFeature, Transform
from flangeye.types.geometry import invert, rigid, rotation_exp
from flangeye_plugins.solve.robust import RobustParams, solve_cell
from tests.estimation.cells import OF_MOST, moving, squares_at

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


def carried_by(axis: Axis) -> Cell:
    """Return the same cell, the arm on a rail or on a positioner."""
    frames = {"axis_base": Frame("base", np.eye(4)), "axis": Frame("axis_base"), **CELL.frames,
              "arm_base": Frame("axis", np.eye(4))}  # fmt: skip
    return replace(CELL, frames=frames, movers={"axis": axis, **CELL.movers})


def sliding(times: Any) -> Any:
    """Return the values of an axis that never stands still, some 0.2 m or rad a second."""
    return 0.3 * np.sin(0.8 * times)


def seen(
    delays: Any, seed: int = 0, recorded: float = 1.0, axis: Axis | None = None
) -> list[Observation]:
    """Return what two cameras saw of a moving marker, by clocks that are so much early [s]."""
    rng, stream = np.random.default_rng(seed), np.arange(0.0, 26.0, 0.01)
    poses, out = moving(stream), []
    for i, when in enumerate(np.sort(rng.uniform(1.0, 25.0, 40))):
        camera = ("left", "right")[i % 2]
        actual = moving(np.array([when + delays[camera]]))[0]
        if axis is not None:
            actual = axis.place(sliding(when + delays[camera])) @ actual
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
        if axis is not None:
            motion = with_joints(motion, when, "axis", (stream, sliding(stream)))
            at["axis"] = Transform("axis_base", "axis", axis.place(sliding(when)))
        out.append(Observation(f"{i:03}", feature, at, None, camera, "marker", motion))
    return out


def solved(
    delays: Any, seed: int = 0, recorded: float = 1.0, axis: Axis | None = None
) -> tuple[list[float], list[str]]:
    """Return the squared distance of every transform, of six, and what is told of clocks."""
    cell = CELL if axis is None else carried_by(axis)
    found = solve_cell(seen(delays, seed, recorded, axis), cell, RobustParams())
    told = [n for n in found.notes if "the arms reached" in n]
    return squares_at(found, PLACES), told


RAIL = Axis(np.array([0.0, 1.0, 0.0]), turns=False, travel=(-1.0, 1.0))
POSITIONER = replace(RAIL, turns=True)


@pytest.mark.parametrize(
    ("delays", "axis"),
    [
        ({"left": 0.0, "right": 0.06}, None),
        ({"left": -0.04, "right": 0.08}, RAIL),
        ({"left": 0.0, "right": 0.06}, POSITIONER),
    ],
)
def test_each_cameras_delay_is_found_and_every_place_is_right(
    delays: Any, axis: Axis | None
) -> None:
    squares, (note,) = solved(delays, axis=axis)
    told = re.findall(r"([\d.]+) \+- ([\d.]+) ms (after|before) the times that (\w+) gives", note)
    assert [camera for *_, camera in told] == ["left", "right"]
    for delay, sigma, which, camera in told:
        signed = float(delay) * (1 if which == "after" else -1)
        assert signed == pytest.approx(1e3 * delays[camera], abs=4 * float(sigma) + 0.1)
        assert float(sigma) < 2
    assert max(squares) < OF_MOST


def test_a_delay_beyond_what_was_recorded_is_refused() -> None:
    """What is linear in a delay is not true so far away: no region would hold."""
    with pytest.raises(CalibrationRefused, match=r"the clock of right seems (5|6)\d\.\d ms off"):
        solved({"left": 0.0, "right": 0.06}, recorded=0.03)


def test_arms_that_stood_still_have_no_clock() -> None:
    still = [replace(o, motion=None) for o in seen({"left": 0.0, "right": 0.0})]
    found = solve_cell(still, CELL, RobustParams())
    assert not [note for note in found.notes if "time offset" in note]


def test_a_camera_whose_sightings_all_disagree_is_named() -> None:
    told = (
        r"fit one calibration to \S+ mm and \S+ deg only, worst where right saw marker; .*"
        r"\(join: clock_offset, if right has another clock\)"
    )
    with pytest.raises(CalibrationRefused, match=told):
        solved({"left": 0.0, "right": 0.5})

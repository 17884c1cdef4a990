"""Arms of a cell that moved while cameras, each with a clock of its own, saw them."""

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from flangeye import CalibrationRefused
from flangeye.handeye import cell_clock as room
from flangeye.handeye.candidates import judged
from flangeye.handeye.cell import calibrate_cell, solve_cell
from flangeye.handeye.cell_clock import _told
from flangeye.handeye.graph import LIMITS, roots_of
from flangeye.maths.frame_graph import Frame
from flangeye.maths.geometry import invert, rigid, rotation_exp
from flangeye.maths.statistics import chi2_quantile
from flangeye.maths.streams import passed, pose_at, with_joints
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
    found = calibrate_cell(seen(delays, seed, recorded, axis), cell, LIMITS, "solve.cell")
    squares = []
    for estimate in found.transforms.values():
        off = errors(estimate, PLACES[estimate.transform.child])
        squares.append(float(off @ np.linalg.solve(estimate.covariance, off)))
    return squares, [note for note in found.notes if "the arms were at the poses" in note]


RAIL = Axis(np.array([0.0, 1.0, 0.0]), turns=False, travel=(-1.0, 1.0))
POSITIONER = replace(RAIL, turns=True)


@pytest.mark.parametrize("axis", [None, RAIL, POSITIONER])
@pytest.mark.parametrize("delays", [{"left": 0.0, "right": 0.06}, {"left": -0.04, "right": 0.08}])
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
    assert not note.startswith("left out")
    assert max(squares) < chi2_quantile(0.999, 6)


@pytest.mark.parametrize("axis", [None, RAIL, POSITIONER])
def test_where_the_clocks_agree_nothing_is_told(axis: Axis | None) -> None:
    squares, notes = solved({"left": 0.0, "right": 0.0}, seed=1, axis=axis)
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
    told = (
        r"agree with one answer to \S+ mm and \S+ deg only, those of marker by right least: .*"
        r"\(join: clock_offset, where the clock of right is another\)"
    )
    with pytest.raises(CalibrationRefused, match=told):
        solved({"left": 0.0, "right": 0.5})


def test_how_late_the_arms_are_is_told_of_each_camera() -> None:
    left: Any = SimpleNamespace(covariance=np.diag([1e-6, 4e-6]))
    assert _told(CELL, np.array([12.34e-3, -4e-3]), left) == (
        "the arms were at the poses 12.3 +- 1.0 ms after the times that left gives, "
        "4.0 +- 2.0 ms before the times that right gives"
    )


def left_over(values: Any, significant: bool = True, error: float = 1e-3) -> Any:
    """Return what is left of two times, of standard deviations of 1 and 2 ms [s]."""
    return SimpleNamespace(
        values=np.array(values), covariance=np.diag([1e-6, 4e-6]), significant=significant,
        followed=np.eye(12, 2), fit=error,
    )  # fmt: skip


class Joint(SimpleNamespace):
    """A solution that tells its covariance alone."""

    def with_joint(self, joint: Any) -> Any:
        return Joint(joint=joint, found=None)


def timed_by(
    left: list[Any], monkeypatch: pytest.MonkeyPatch, reach: float = 1.0, error: float = 2e-3
) -> tuple[Any, list[Any]]:
    """Return the sightings on one clock where such times are left in turn, and the times tried."""
    tried, left_in_turn = list[Any](), iter(left)
    here: Any = Joint(joint=np.zeros((12, 12)), found=None)

    def delayed(observations: Any, cell: Any, before: Any, delays: Any) -> Any:
        tried.append(delays)
        return None if np.abs(delays).max() > reach else room.Timed(tried[:], here)

    monkeypatch.setattr(room, "_delays", lambda *_: next(left_in_turn))
    monkeypatch.setattr(room, "_delayed", delayed)
    monkeypatch.setattr(room, "_judged", lambda _, after, what: judged(error, after, what))
    moving: Any = [SimpleNamespace(motion=SimpleNamespace(others=["flange"]))] * 3
    return room.on_one_clock(moving, CELL, here), tried


def test_times_add_up_until_what_is_left_is_ten_microseconds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    left = [left_over(x) for x in ([8e-3, 0.0], [1e-3, -2e-3], [0.9e-5, -0.9e-5], [9.0, 9.0])]
    timed, tried = timed_by(left, monkeypatch)
    assert np.array(tried) == pytest.approx(np.array([[8e-3, 0.0], [9e-3, -2e-3]]))
    (note,) = timed.notes
    assert note.startswith("the arms were at the poses 9.0 +- 1.0 ms after the times that left")
    assert note.endswith("(held-out error 1.000 mm with it, 2.000 mm without)")
    assert len(timed.observations) == 2
    assert np.diag(timed.found.joint)[:3] == pytest.approx([1e-6, 4e-6, 0.0])
    _, tried = timed_by([left_over([1.1e-5, 0.0])] * 9, monkeypatch)
    assert len(tried) == 6


def test_times_that_do_not_help_are_in_the_covariance_as_far_as_they_may_be_off(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Those that are not significant, those that do not help, and those beyond the recording."""
    first = left_over([3e-3, 4e-3])
    off = np.array([[1 + 9, 12.0], [12.0, 4 + 16]]) * 1e-6
    quiet, tried = timed_by([left_over([3e-3, 4e-3], significant=False)], monkeypatch)
    assert not tried and quiet.notes == ()
    worse, tried = timed_by([first, left_over([0.0, 0.0], error=3e-3)], monkeypatch)
    assert len(tried) == 1 and worse.notes[0].startswith("left out, for it does not help: the arms")
    beyond, tried = timed_by([first], monkeypatch, reach=3.5e-3)
    assert beyond.notes[0].startswith("left out, for no pose was recorded so far away: the arms")
    for timed in (quiet, worse, beyond):
        assert len(timed.observations) == 3
        assert timed.found.joint[:2, :2] == pytest.approx(off)


def test_clocks_are_looked_for_where_every_sighting_says_how_arms_passed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(room, "_delays", lambda *_: pytest.fail("nothing is to be found"))
    moved, still = SimpleNamespace(others=["flange"]), SimpleNamespace(others=[])
    some: Any = None
    for last in (None, still):
        seen_: Any = [SimpleNamespace(motion=moved), SimpleNamespace(motion=last)]
        assert room.on_one_clock(seen_, CELL, some).observations is seen_


def told_of(observations: list[Observation], late: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what is told of clocks by sightings, each late by what is given of it."""
    found = solve_cell(observations, CELL, LIMITS)
    monkeypatch.setattr(room, "_lateness", lambda *_: late)
    return room._delays(room.Timed(observations, found), CELL), found


def test_times_are_told_as_by_least_squares_with_all_unknowns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Their covariance is as wide as residuals say, which they are held against by Fisher's F."""
    rng = np.random.default_rng(0)
    late = rng.normal(size=(40, 6, 2))
    told, found = told_of(seen({"left": 0.0, "right": 0.0}), late, monkeypatch)
    fit = found.found
    roots = roots_of(fit.weights)
    rows = (roots @ fit.linear.jacobian[:, :, :18]).reshape(-1, 18)
    clocks = (roots @ found.problem.measurements.projectors @ late).reshape(-1, 2)
    sides = (roots @ fit.linear.residuals[..., None]).ravel()
    both = np.hstack([rows, clocks])
    values = np.linalg.lstsq(both, sides, rcond=None)[0]
    assert told.values == pytest.approx(values[18:], rel=0.05, abs=1e-6)
    known = np.linalg.inv(both.T @ both)[18:, 18:]
    assert np.sqrt(np.diag(told.covariance)) == pytest.approx(np.sqrt(np.diag(known)), rel=0.05)
    assert not told.significant
    followed = np.linalg.lstsq(rows, clocks, rcond=None)[0]
    assert told.followed == pytest.approx(followed, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize(("delay", "significant"), [(0.02, True), (1e-5, False)])
def test_a_time_is_significant_by_its_deviation(
    delay: float, significant: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    observations = seen({"left": 0.0, "right": delay})
    found = solve_cell(observations, CELL, LIMITS)
    told = room._delays(room.Timed(observations, found), CELL)
    square = told.values @ np.linalg.solve(told.covariance, told.values) / 2
    assert told.significant == significant == (square > stats.f(2, 200).ppf(0.9999))


def test_a_camera_that_nothing_moved_past_has_a_clock_of_which_nothing_is_known(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A second is as good as a thousand: its deviation is."""
    late = np.random.default_rng(0).normal(size=(40, 6, 2)) * [1.0, 0.0]
    told, _ = told_of(seen({"left": 0.0, "right": 0.0}), late, monkeypatch)
    assert np.sqrt(told.covariance[1, 1]) == pytest.approx(1e3)

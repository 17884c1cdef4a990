"""Several cameras, arms, rails and targets at once."""

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye import CalibrationRefused, StageError
from flangeye.handeye import graph as room
from flangeye.handeye.calibration import TYPICAL_ARM
from flangeye.handeye.components import Noise
from flangeye.handeye.estimates import noise_beyond
from flangeye.handeye.graph import Sighting, problem_of, roots_of, solve_graph
from flangeye.handeye.likelihood import agreeing, first_noise, settle, weigh
from flangeye.handeye.loop import LoopProblem
from flangeye.handeye.measurements import loop_of, measurements_of
from flangeye.handeye.moments import between
from flangeye.handeye.nuisance import nuisance_seen
from flangeye.handeye.starts import start_of
from flangeye.handeye.unknowns import Unknowns, weights_of
from flangeye.maths.frame_graph import Frame, chain
from flangeye.maths.geometry import invert, rigid, rotation_exp, rotation_log
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import covariance_inflation
from flangeye.models.loading import load_model
from tests.handeye.cells import CONFIGURATIONS, session

UR5 = Arm(load_model("robots", "ur5"))
HOME = np.radians([0, -90, 90, -90, -90, 0])
TURN, SHIFT = 0.5e-3, 0.1e-3
COVARIANCE = np.diag([TURN**2] * 3 + [SHIFT**2] * 3)


def pose(*numbers):
    return rigid(
        rotation_exp(np.array(numbers[:3], dtype=float)), np.array(numbers[3:], dtype=float)
    )


def arm_poses(count, seed):
    joints = HOME + np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 6))
    return UR5.flange(joints)


def rail_poses(count, seed):
    places = np.tile(np.eye(4), (count, 1, 1))
    places[:, 0, 3] = np.random.default_rng(seed).uniform(-1, 1, count)
    return places


N = 14
CELLS = {
    # name: (frames as they are, those to be found, who sees whom)
    "two fixed scanners and one arm": (
        {
            "flange": Frame("base", arm_poses(N, 1)),
            "left": Frame("base", pose(3, 0.1, 0, 0.4, 0.6, 1.1)),
            "right": Frame("base", pose(3, -0.2, 0.3, 0.4, -0.7, 1.2)),
            "marker": Frame("flange", pose(0, 0.1, 0.2, 0.01, 0.02, 0.05)),
        },
        ["left", "right", "marker"],
        [("left", "marker"), ("right", "marker")],
    ),
    "two arms with a scanner each and one between": (
        {
            "flange": Frame("base", arm_poses(N, 2)),
            "base2": Frame("base", pose(0, 0, 3, 1.2, 0.1, 0)),
            "flange2": Frame("base2", arm_poses(N, 3)),
            "hand": Frame("flange", pose(0, 0, 1.5, 0.06, 0, 0.04)),
            "hand2": Frame("flange2", pose(0.1, 0, -1.5, 0.05, 0.01, 0.04)),
            "between": Frame("base", pose(2.5, 0.4, 0, 0.6, 0.1, 1.3)),
            "plate": Frame("flange", pose(0, 0, 0.3, 0, 0.05, 0.01)),
            "plate2": Frame("flange2", pose(0, 0.1, 0.3, 0.02, 0.05, 0.01)),
        },
        ["base2", "hand", "hand2", "between", "plate", "plate2"],
        [("hand", "plate2"), ("hand2", "plate"), ("between", "plate"), ("between", "plate2")],
    ),
    "an arm on a rail": (
        {
            "carriage": Frame("world", rail_poses(N, 4)),
            "base": Frame("carriage", pose(0, 0, 0.8, 0.1, 0, 0.3)),
            "flange": Frame("base", arm_poses(N, 5)),
            "camera": Frame("world", pose(2.8, 0.2, 0, 0.2, 1.5, 1.4)),
            "marker": Frame("flange", pose(0.2, 0.1, 0.2, 0.01, 0.02, 0.05)),
        },
        ["camera", "marker"],
        [("camera", "marker")],
    ),
    "a scanner in the hand and one on the wall that never see the same thing": (
        {
            "flange": Frame("base", arm_poses(N, 6)),
            "hand": Frame("flange", pose(0, 0, 1.5, 0.06, 0, 0.04)),
            "wall": Frame("base", pose(2.0, 1.2, 0, 0.3, -1.2, 0.9)),
            "table": Frame("base", pose(0, 0, 0.4, 0.5, 0.2, 0)),
            "marker": Frame("flange", pose(0, 0.4, 0.2, 0.05, 0.02, 0.05)),
        },
        ["hand", "wall", "table", "marker"],
        [("hand", "table"), ("wall", "marker")],
    ),
}


def composed(frames, name, t):
    out = np.eye(4)
    for each in chain(frames, name):
        place = frames[each].place
        out = out @ (place[t] if place.ndim == 3 else place)
    return out


def seen(frames, pairs, rng, scale=1.0):
    sightings = []
    for t in range(N):
        for camera, target in pairs:
            true = invert(composed(frames, camera, t)) @ composed(frames, target, t)
            noise = scale * rng.standard_normal(6) * np.repeat([TURN, SHIFT], 3)
            measured = rigid(rotation_exp(noise[:3]) @ true[:3, :3], true[:3, 3] + noise[3:])
            sightings.append(Sighting(t, camera, target, measured, COVARIANCE))
    return sightings


def solved(name, seed=0, scale=1.0):
    frames, unknown, pairs = CELLS[name]
    given = {n: Frame(f.parent) if n in unknown else f for n, f in frames.items()}
    return solve_graph(given, seen(frames, pairs, np.random.default_rng(seed), scale))


def error(found, true):
    turn = rotation_log(found[:3, :3] @ true[:3, :3].T)
    return np.concatenate([turn, found[:3, 3] - true[:3, 3]])


@pytest.mark.parametrize("name", CELLS)
def test_every_unknown_of_a_cell_is_found_with_its_covariance(name: str) -> None:
    frames, unknown, _ = CELLS[name]
    found = solved(name)
    assert list(found.places) == unknown
    for each in unknown:
        off = error(found.places[each], frames[each].place)
        distance = off @ np.linalg.solve(found.covariances[each], off)
        assert distance < 22.5  # 99.9 % of chi-squared with six degrees of freedom
        assert np.linalg.norm(off[3:]) < 2e-3
    assert np.sqrt((found.found.linear.residuals[:, 3:] ** 2).mean()) == pytest.approx(
        SHIFT, rel=0.35
    )


def test_without_noise_it_is_exact() -> None:
    name = "two fixed scanners and one arm"
    found = solved(name, scale=0.0)
    for each in CELLS[name][1]:
        assert np.abs(error(found.places[each], CELLS[name][0][each].place)).max() < 1e-7


def test_what_nothing_ties_is_named() -> None:
    frames, _, _ = CELLS["two fixed scanners and one arm"]
    given = {**frames, "left": Frame("base"), "other": Frame("base"), "marker": Frame("flange")}
    sightings = seen(frames, [("left", "marker")], np.random.default_rng(0))
    told = (
        "do not tell where other is: .*; no sighting that agrees with others has other in it: let"
    )
    with pytest.raises(CalibrationRefused, match=told):
        solve_graph(given, sightings)


def still(places):
    return np.tile(places[:1], (N, 1, 1))


def turned(places, axis, span=0.5):
    return np.array(
        [places[0] @ pose(*(a * np.array(axis)), 0, 0, 0) for a in np.linspace(-span, span, N)]
    )


def moved_only(places):
    out = still(places)
    out[:, :3, 3] += np.random.default_rng(0).uniform(-0.2, 0.2, (N, 3))
    return out


MISSING = {
    # name: (cell, what moves in it, how it moved instead, who stays unknown, what would tell)
    "the second arm stood still": (
        "two arms with a scanner each and one between", "flange2", still,
        "base2 and hand2 and plate2 are", r"turn flange2 about \S+, \S+, \S+ and .* of base2 by 20 deg",
    ),
    "the second arm turned about one axis": (
        "two arms with a scanner each and one between", "flange2", lambda x: turned(x, [0, 0, 1]),
        "base2 and hand2 and plate2 are", r"turn flange2 about \(\S+, \S+, \S+\) of base2 by 20 deg",
    ),
    "the arm moved without turning": (
        "two fixed scanners and one arm", "flange", moved_only,
        "left and right and marker are", r"turn flange about \S+, \S+, \S+ and .* of base by 20 deg",
    ),
    "an arm with two cameras that see no common target stood still": (
        "a scanner in the hand and one on the wall that never see the same thing", "flange", still,
        "hand and wall and table and marker are", r"turn flange about .* of base by 20 deg",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MISSING)
def test_the_motion_that_is_missing_is_named_and_is_enough(name: str) -> None:
    cell, mover, instead, who, cure = MISSING[name]
    frames, unknown, pairs = CELLS[cell]
    lame = {**frames, mover: replace(frames[mover], place=instead(frames[mover].place))}

    def given(frames):
        return {n: Frame(f.parent) if n in unknown else f for n, f in frames.items()}

    with pytest.raises(CalibrationRefused, match=f"where {who}: .*; {cure} or more, and") as told:
        solve_graph(given(lame), seen(lame, pairs, np.random.default_rng(0)))
    assert "no sighting" not in str(told.value)
    assert "no motion" not in str(told.value)
    (text,) = re.findall(rf"turn {mover} about (.*?) of base", str(told.value))
    axes = [np.array(list(map(float, x.strip("()").split(", ")))) for x in text.split(" and ")]
    place = lame[mover].place.copy()
    for i, axis in enumerate((axes * N)[: N // 2]):
        place[i, :3, :3] = rotation_exp(np.radians(20) * axis) @ place[i, :3, :3]
    cured = {**lame, mover: replace(lame[mover], place=place)}
    found = solve_graph(given(cured), seen(cured, pairs, np.random.default_rng(0)))
    assert set(found.places) == set(unknown)


def test_a_rail_that_did_not_move_is_named_with_its_direction() -> None:
    frames, _, pairs = CELLS["an arm on a rail"]
    unknown = ("base", "camera", "marker")
    given = {n: Frame(f.parent) if n in unknown else f for n, f in frames.items()}
    given["carriage"] = replace(given["carriage"], place=still(given["carriage"].place))
    actual = {**frames, "carriage": given["carriage"]}
    along = np.array([0, 0, 0, 1, 0, 0.0])[:, None]
    sightings = seen(actual, pairs, np.random.default_rng(0))
    told = r"move carriage along \(1.00, 0.00, 0.00\) of world by 0.1 m or more"
    with pytest.raises(CalibrationRefused, match=told):
        solve_graph(given, sightings, freedoms={"carriage": along, "flange": np.eye(6)})


def test_a_rail_alone_does_not_tell_where_on_it_the_arm_stands() -> None:
    """A shift of arm and camera together changes nothing that either sees: the rail only slides."""
    frames, _, pairs = CELLS["an arm on a rail"]
    given = {
        **frames,
        **{name: Frame(frames[name].parent) for name in ("base", "camera", "marker")},
    }
    along = {"carriage": np.array([0, 0, 0, 1, 0, 0.0])[:, None], "flange": np.eye(6)}
    told = (
        r"where base and camera are: a common shift hardly changes them; no motion shows where base "
        r"and camera stand: say it of base \(place: in the recipe\)"
    )
    with pytest.raises(CalibrationRefused, match=told):
        solve_graph(given, seen(frames, pairs, np.random.default_rng(0)), freedoms=along)


def test_the_link_between_two_parts_that_is_missing_is_named() -> None:
    """Two arms, each with a camera and a marker on its own table: nothing ties the second's."""
    frames, _, _ = CELLS["two arms with a scanner each and one between"]
    frames = {
        **{name: frames[name] for name in ("flange", "base2", "flange2", "hand", "hand2")},
        "table": Frame("base", pose(0, 0, 0.4, 0.5, 0.2, 0)),
        "table2": Frame("base2", pose(0, 0, 0.4, 0.5, 0.2, 0)),
    }
    unknown = ("base2", "hand", "hand2", "table", "table2")
    given = {n: Frame(f.parent) if n in unknown else f for n, f in frames.items()}
    pairs = [("hand", "table"), ("hand2", "table2")]
    told = (
        "do not tell where base2 is: .* no sighting ties hand2 and table2 to hand and table: let a "
        "camera of the one see a target of the other"
    )
    with pytest.raises(CalibrationRefused, match=told):
        solve_graph(given, seen(frames, pairs, np.random.default_rng(0)))


def test_frames_that_lead_to_two_roots_are_refused() -> None:
    with pytest.raises(StageError, match="stand on base and floor, which nothing connects"):
        solve_graph({"a": Frame("base"), "b": Frame("floor")}, [])
    with pytest.raises(StageError, match="is its own parent"):
        solve_graph({"a": Frame("b"), "b": Frame("a")}, [])


def arm_noise(frames):
    moved = [n for n, f in frames.items() if f.place is not None and f.place.ndim == 3]
    return {name: np.diag([1e-4**2] * 3 + [5e-5**2] * 3) for name in moved}


def test_wrong_sightings_of_every_pair_are_set_aside() -> None:
    name = "a scanner in the hand and one on the wall that never see the same thing"
    frames, unknown, pairs = CELLS[name]
    given = {n: Frame(f.parent) if n in unknown else f for n, f in frames.items()}
    sightings = seen(frames, pairs, np.random.default_rng(3))
    wrong = [1, 8, 15, 20]
    for i in wrong:
        sightings[i] = replace(sightings[i], pose=pose(0.3, 0, 0, 0.1, 0, 0) @ sightings[i].pose)
    found = solve_graph(given, sightings, arm_noise(frames))
    assert set(wrong) <= set(np.flatnonzero(~found.found.inliers))
    assert found.found.inliers.sum() >= len(sightings) - len(wrong) - 1
    for each in unknown:
        assert np.linalg.norm(error(found.places[each], frames[each].place)[3:]) < 1e-3


def test_the_noise_of_what_moves_is_found_from_the_residuals() -> None:
    frames, unknown, pairs = CELLS["two fixed scanners and one arm"]
    rng = np.random.default_rng(4)
    shaken = frames["flange"].place.copy()
    shaken[:, :3, 3] += 5e-4 * rng.standard_normal((N, 3))
    actual = {**frames, "flange": Frame("base", shaken)}
    sightings = seen(actual, pairs, rng)
    given = {n: Frame(f.parent) if n in unknown else f for n, f in frames.items()}
    noise = {"flange": np.diag([1e-6**2] * 3 + [5e-5**2] * 3)}
    found = solve_graph(given, sightings, noise)
    shift, _ = noise_beyond(found.found)
    assert shift == pytest.approx(0.5, rel=0.35)


@pytest.mark.parametrize(("shared", "share"), [(True, (0.8, 1.0)), (False, (0.0, 0.5))])
def test_sightings_of_one_moment_share_the_noise_of_what_moves(shared: bool, share: Any) -> None:
    """As much of it as their residuals say: what both see is known less well by so much."""
    cell: Any = CELLS["two fixed scanners and one arm"]
    frames, unknown, pairs = cell
    given, rng = (
        {n: Frame(f.parent) if n in unknown else f for n, f in frames.items()},
        np.random.default_rng(4),
    )
    sightings = []
    for pair in pairs if not shared else [pairs]:
        shaken = frames["flange"].place.copy()
        shaken[:, :3, 3] += 5e-4 * rng.standard_normal((N, 3))
        actual = {**frames, "flange": Frame("base", shaken)}
        sightings += seen(actual, pair if shared else [pair], rng)
    noise = {"flange": np.diag([1e-6**2] * 3 + [5e-5**2] * 3)}
    found = solve_graph(given, sightings, noise)
    p = found.found.at.of_places
    own = found.found.covariance[:p, :p] * covariance_inflation(found.found.freedom, 6)
    wider = np.diag(found.joint - own) / np.diag(own)
    low, high = share
    assert low < wider[-3:].mean() < high  # the marker's place, which both see
    assert np.linalg.eigvalsh(found.joint)[0] > 0


def test_what_is_shared_is_summed_over_all_two_of_a_moment() -> None:
    moments, each = np.array([0, 1, 0, 2, 1, 0]), np.random.default_rng(0).normal(size=(6, 4, 3))
    expected = sum(
        each[i].T @ each[j]
        for i in range(6)
        for j in range(6)
        if i != j and moments[i] == moments[j]
    )
    assert between(moments, each) == pytest.approx(expected)


def test_circles_on_the_flange_itself_tie_two_scanners() -> None:
    """Centres with normals: the flange's own circle, its place known, its turn not seen."""
    frames, _, _ = CELLS["two fixed scanners and one arm"]
    frames = {**frames, "marker": Frame("flange", np.eye(4))}
    given = {**frames, "left": Frame("base"), "right": Frame("base")}
    circles = []
    pairs = [("left", "marker"), ("right", "marker")]
    for s in seen(frames, pairs, np.random.default_rng(5)):
        normal = s.pose[:3, 2]
        projector = np.eye(6)
        projector[:3, :3] -= np.outer(normal, normal)
        spun = s.pose @ pose(0, 0, 2.0, 0, 0, 0)
        circles.append(replace(s, pose=spun, projector=projector))
    found = solve_graph(given, circles)
    for each in ("left", "right"):
        off = error(found.places[each], frames[each].place)
        assert off @ np.linalg.solve(found.covariances[each], off) < 22.5
        assert np.linalg.norm(off[3:]) < 1e-3


def circled(sightings):
    """Every other one as a circle is seen: spun about its normal, which it does not tell."""
    out = []
    for i, s in enumerate(sightings):
        if i % 2:
            projector = np.eye(6)
            projector[:3, :3] -= np.outer(s.pose[:3, 2], s.pose[:3, 2])
            s = replace(s, pose=s.pose @ pose(0, 0, 2.0, 0, 0, 0), projector=projector)
        out.append(s)
    return out


def moved(frames, name, step):
    """The frames with one turned about its own origin, in its parent, and shifted."""
    place = np.array(frames[name].place)
    place[..., :3, :3] = rotation_exp(step[:3]) @ place[..., :3, :3]
    place[..., :3, 3] += step[3:]
    return {**frames, name: replace(frames[name], place=place)}


CELL: Any = CELLS["two arms with a scanner each and one between"]
WORLD, SEEN = CELL[0], CELL[2]
NOWHERE = Unknowns(np.zeros((0, 4, 4)))


def unknown_in(frames, names):
    """The frames as they are given, and the unknown ones' places."""
    given = {n: Frame(f.parent) if n in names else f for n, f in frames.items()}
    places = [frames[n].place for n in frames if n in names]
    return given, Unknowns(np.array(places).reshape(-1, 4, 4))


def test_what_is_predicted_moves_with_every_frame_as_differences_say() -> None:
    """Of those that are to be found, and of arms; a circle's turn about its normal is none."""
    sightings = circled(seen(WORLD, SEEN, np.random.default_rng(2)))
    for s in sightings[1::2]:
        assert np.trace(s.projector) == pytest.approx(5.0)
    names, step = list(WORLD), 1e-6
    errors, effects = problem_of(WORLD, sightings).effects(NOWHERE, names)
    assert np.abs(errors).max() < 4 * TURN
    for k in range(6 * len(names)):
        by = step * np.eye(6)[k % 6]
        world = moved(WORLD, names[k // 6], by)
        after, _ = problem_of(world, sightings).effects(NOWHERE, [])
        assert (errors - after) / step == pytest.approx(effects[:, :, k], abs=2e-3)


def test_it_is_linear_in_the_unknowns_and_in_what_is_common_to_all() -> None:
    """As those of one camera's loop: in the same order, the tilt's columns left out."""
    sightings = circled(seen(WORLD, SEEN, np.random.default_rng(2)))
    given, at = unknown_in(WORLD, ["hand", "base2", "plate2"])
    common = nuisance_seen(np.random.default_rng(3).normal(size=(len(sightings), 6, 2)), 1.0)
    problem = problem_of(given, sightings, {"flange": COVARIANCE}).beside(common)
    at = replace(at, nuisance=np.array([1e-4, -2e-4]))
    linear = problem.linearised(at)
    basis = problem.free(at)
    assert linear.jacobian.shape == (len(sightings), 6, 22) and basis.shape == (22, 20)
    for step in 1e-6 * basis.T:
        after = problem.linearised(at.moved(step)).residuals
        assert (linear.residuals - after) * 1e6 == pytest.approx(
            linear.jacobian @ step * 1e6, abs=2e-3
        )


def test_what_carries_both_ends_adds_to_the_sightings_covariance() -> None:
    sightings = circled(seen(WORLD, SEEN, np.random.default_rng(2)))
    noise = {"flange": np.diag([1e-4**2] * 3 + [5e-5**2] * 3), "flange2": 4 * COVARIANCE}
    given, at = unknown_in(WORLD, ["hand", "plate2"])
    problem = problem_of(given, sightings, noise)
    linear = problem.linearised(at)
    roots = roots_of(weights_of(problem.measurements, linear, Noise(0.0, 0.0)))
    _, effects = problem.effects(at, list(noise))
    for s, effect, root in zip(sightings, effects, roots, strict=True):
        spread = s.projector @ COVARIANCE @ s.projector
        for covariance, moves in zip(noise.values(), np.split(effect, 2, axis=1), strict=True):
            spread = spread + moves @ covariance @ moves.T
        assert root @ spread @ root.T == pytest.approx(s.projector, abs=1e-4)


def test_a_solution_is_the_least_of_its_errors_with_the_covariance_of_that() -> None:
    """Where the sightings' own covariances are all the noise there is."""
    name = "a scanner in the hand and one on the wall that never see the same thing"
    cell: Any = CELLS[name]
    frames, unknown, pairs = cell
    given, _ = unknown_in(frames, unknown)
    sightings = seen(frames, pairs, np.random.default_rng(4))
    found = solve_graph(given, sightings)
    rows, errors = found.told_by(given, sightings)
    information = np.einsum("nij,nik->jk", rows, rows)
    slope = np.einsum("nij,ni->j", rows, errors)
    assert slope @ np.linalg.solve(information, slope) < 1e-9
    assert found.joint == pytest.approx(np.linalg.inv(information), rel=1e-5)
    for k, each in enumerate(unknown):
        block = found.joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        np.testing.assert_array_equal(found.covariances[each], block)
        np.testing.assert_array_equal(
            found.with_joint(2 * found.joint).covariances[each], 2 * block
        )
    assert found.found.inliers.all()
    begun = solve_graph(given, sightings, start={n: frames[n].place for n in unknown})
    for each in unknown:
        assert begun.places[each] == pytest.approx(found.places[each], abs=1e-7)


def test_what_would_be_seen_again_is_what_is_told_with_it_moved_either_way() -> None:
    """By 20 deg, or by 0.1 m; errors alike in all directions turn with what is seen."""
    names = ["base2", "hand", "hand2", "between", "plate", "plate2"]
    given, at = unknown_in(WORLD, names)
    for kind in (list, circled):
        problem = problem_of(given, kind(seen(WORLD, SEEN, np.random.default_rng(0), 0.0)))
        found = weigh(problem, at, Noise(0.0, 0.0), np.ones(len(problem.measurements)))
        told = room._seen_again(problem, found, None)
        assert len(told) == 12
        for name, twist in (("flange", np.eye(6)[1]), ("flange2", np.eye(6)[3])):
            wanted = np.zeros((36, 36))
            for sign in (1.0, -1.0):
                step = sign * twist * np.repeat([np.radians(20), 0.1], 3)
                world = moved(WORLD, name, step)
                again = kind(seen(world, SEEN, np.random.default_rng(0), 0.0))
                there = problem_of(unknown_in(world, names)[0], again)
                every = np.ones(len(again))
                wanted = wanted + weigh(there, at, Noise(0.0, 0.0), every).information
            scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
            assert told[name, tuple(twist)] / scale == pytest.approx(wanted / scale, abs=2e-4)


@pytest.mark.parametrize(
    ("costs", "descents", "taken"),
    [
        ([5.0, 3.0, 4.0, 3.002, 9.0], 4, 3),  # within a thousandth of the lowest
        ([5.0, 3.0, 4.0, 3.004, 9.0, 2.999], 6, 5),
        ([float(60 - k) for k in range(60)], 60, 59),
        ([float(k) for k in range(1, 61)], 13, 0),  # twelve in turn find nothing lower
        ([0.0, 0.0], 2, 1),
    ],
)
def test_of_many_descents_two_that_agree_on_the_lowest_end_the_search(
    costs: list[float], descents: int, taken: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of sixty at most, each of rotations first."""
    frames, unknown, pairs = CELLS["two fixed scanners and one arm"]
    given, _ = unknown_in(frames, unknown)
    problem, asked = problem_of(given, seen(frames, pairs, np.random.default_rng(4))), list[Any]()

    def descended(problem: Any, start: Any) -> Any:
        asked.append(problem)
        count = len(asked) // 2 - 1
        return SimpleNamespace(at=count, squares=np.full(2 * N, costs[count] / (2 * N)))

    monkeypatch.setattr(room, "_descended", descended)
    found: Any = room._anywhere(problem)
    assert len(asked) == 2 * descents and found == taken
    turned = asked[0].measurements.projectors[0]
    assert turned == pytest.approx(np.diag([1.0, 1, 1, 0, 0, 0]))
    assert asked[1] is problem


def test_a_descent_ends_within_few_steps_from_half_a_radian_away() -> None:
    frames, unknown, pairs = CELLS["two fixed scanners and one arm"]
    given, at = unknown_in(frames, unknown)
    problem = problem_of(given, seen(frames, pairs, np.random.default_rng(4)))
    away = np.random.default_rng(5).normal(0, np.tile([0.3] * 3 + [0.2] * 3, 3))
    found = room._descended(problem, at.moved(np.append(away, [0.0, 0.0])))
    for each, place in zip(unknown, found.at.places, strict=True):
        assert np.abs(error(place, frames[each].place)).max() < 2e-3


def test_a_sighting_counts_less_the_further_it_is_beyond_most_of_its_pair() -> None:
    """One of each pair is far off: the answer is that of the others alone."""
    frames, unknown, pairs = CELLS["two fixed scanners and one arm"]
    given, at = unknown_in(frames, unknown)
    sightings = seen(frames, pairs, np.random.default_rng(4))
    wrong = [replace(s, pose=pose(0.4, 0, 0, 0.1, 0.2, 0) @ s.pose) if i in (3, 8) else s
             for i, s in enumerate(sightings)]  # fmt: skip
    found = room._descended(problem_of(given, wrong), at)
    good = [s for i, s in enumerate(sightings) if i not in (3, 8)]
    alone = room._descended(problem_of(given, good), at)
    for ours, theirs in zip(found.at.places, alone.at.places, strict=True):
        assert np.abs(error(ours, theirs)).max() < 1e-3
    middles = room._middles(problem_of(given, sightings), np.arange(2.0 * N))
    assert middles[:2] == pytest.approx([np.median(np.arange(0, 2 * N, 2)),
                                         np.median(np.arange(1, 2 * N, 2))])  # fmt: skip


def test_one_camera_is_solved_as_its_loop_is() -> None:
    """The same likelihood of the same sightings: a loop A X M = Y B Z is a graph."""
    made = session(CONFIGURATIONS["eye-in-hand, marker"], np.random.default_rng(3), 15)
    loop = loop_of(made.configuration)
    measured = measurements_of(made.observations, made.configuration, None)
    problem = LoopProblem(measurements=measured, loop=loop, arms=TYPICAL_ARM, overstated=False)
    start = start_of(measured, loop, np.random.default_rng(0))
    whole = settle(problem, start, first_noise(problem, start))
    whole = agreeing(replace(problem, in_depth=True), whole)
    frames = {"hand": Frame("base", measured.a), "camera": Frame("hand"), "mark": Frame("base")}
    sightings = [Sighting(i, "camera", "mark", measured.poses[i], measured.covariances[i])
                 for i in range(15)]  # fmt: skip
    found = solve_graph(frames, sightings, {"hand": TYPICAL_ARM.covariance})
    for ours, theirs in ((found.places["camera"], whole.at.x), (found.places["mark"], whole.at.z)):
        assert ours == pytest.approx(theirs, abs=2e-6)
    columns = [*range(6), *range(12, 18)]
    stated = whole.covariance[np.ix_(columns, columns)] * covariance_inflation(whole.freedom, 6)
    assert np.sqrt(np.diag(found.joint)) == pytest.approx(np.sqrt(np.diag(stated)), rel=0.02)

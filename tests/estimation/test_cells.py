"""Several cameras, arms, rails and targets at once."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye import CalibrationRefused
from flangeye.estimation.calibrate import Options, calibrate
from flangeye.maths.kinematics import Arm
from flangeye.models.cell import Axis, Cell, Frame, chain
from flangeye.models.loading import load_model
from flangeye.types import CAMERA, TARGET, HandEye, Observation, PoseFeature, Transform
from flangeye.types.geometry import invert, rigid, rotation_exp
from tests.estimation.cells import OF_MOST, squares_at

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
    out = []
    moved = [n for n, f in frames.items() if f.place is not None and np.ndim(f.place) == 3]
    for t in range(N):
        poses = {n: Transform(frames[n].parent, n, frames[n].place[t]) for n in moved}
        for camera, target in pairs:
            true = invert(composed(frames, camera, t)) @ composed(frames, target, t)
            noise = scale * rng.standard_normal(6) * np.repeat([TURN, SHIFT], 3)
            measured = rigid(rotation_exp(noise[:3]) @ true[:3, :3], true[:3, 3] + noise[3:])
            feature = PoseFeature(Transform(CAMERA, TARGET, measured), COVARIANCE)
            name = f"{t:02d}-{camera}-{target}"
            out.append(Observation(name, feature, poses, None, camera, target))
    return out


MOVERS = {"flange": None, "flange2": None, "carriage": Axis(np.array([1.0, 0, 0]), False, (-1, 1))}


def solve_graph(given: dict[str, Frame], observations: list[Observation]) -> HandEye:
    """Return the answer for frames of which some have no place, no model of any arm known."""
    movers = {n: MOVERS[n] for n in MOVERS if n in given}
    frames = {n: Frame(f.parent) if n in movers else f for n, f in given.items()}
    cameras, targets = (
        tuple(dict.fromkeys(x))
        for x in zip(*((o.camera, o.target) for o in observations), strict=True)
    )
    cell = Cell(frames, movers, cameras, targets)
    return calibrate(observations, cell, None, Options((np.radians(2), 20e-3)), "solve.robust")


def solved(name, seed=0, scale=1.0):
    frames, unknown, pairs = CELLS[name]
    given = {n: Frame(f.parent) if n in unknown else f for n, f in frames.items()}
    return solve_graph(given, seen(frames, pairs, np.random.default_rng(seed), scale))


@pytest.mark.parametrize("name", CELLS)
def test_every_unknown_of_a_cell_is_found_with_its_covariance(name: str) -> None:
    frames, unknown, _ = CELLS[name]
    found = solved(name)
    assert {x.transform.child for x in found.transforms.values()} == {*unknown}
    places = {each: frames[each].place for each in unknown}
    assert max(squares_at(found, places)) < OF_MOST
    for estimate in found.transforms.values():
        off = estimate.transform.translation - np.asarray(places[estimate.transform.child])[:3, 3]
        assert np.linalg.norm(off) < 2e-3


def test_nearly_without_noise_it_is_nearly_exact() -> None:
    name = "two fixed scanners and one arm"
    for estimate in solved(name, scale=1e-3).transforms.values():
        place = CELLS[name][0][estimate.transform.child].place
        assert np.abs(estimate.transform.matrix - place).max() < 1e-5


def test_what_nothing_ties_is_named() -> None:
    frames, _, _ = CELLS["two fixed scanners and one arm"]
    given = {**frames, "left": Frame("base"), "other": Frame("base"), "marker": Frame("flange")}
    sightings = seen(frames, [("left", "marker")], np.random.default_rng(0))
    told = "do not determine where other is: .*; no inlier involves other: let"
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
        "base2 and hand2 and plate2 are",
        r"turn flange2 about \S+, \S+, \S+ and .* of base2 by 20 deg",
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
    place = obeyed(lame[mover].place, str(told.value))
    cured = {**lame, mover: replace(lame[mover], place=place)}
    found = solve_graph(given(cured), seen(cured, pairs, np.random.default_rng(0)))
    assert {x.transform.child for x in found.transforms.values()} == {*unknown}


def obeyed(places: Any, text: str) -> Any:
    """Return the places with half of them turned by 20 degrees about each axis that is named."""
    (named,) = re.findall(r"turn \S+ about (.*?) of base", text)
    axes = [np.array(list(map(float, x.strip("()").split(", ")))) for x in named.split(" and ")]
    out = places.copy()
    for i, axis in enumerate((axes * N)[: N // 2]):
        out[i, :3, :3] = rotation_exp(np.radians(20) * axis) @ out[i, :3, :3]
    return out


def test_a_rail_that_did_not_move_is_named_with_its_direction() -> None:
    frames, _, pairs = CELLS["an arm on a rail"]
    unknown = ("base", "camera", "marker")
    given = {n: Frame(f.parent) if n in unknown else f for n, f in frames.items()}
    given["carriage"] = replace(given["carriage"], place=still(given["carriage"].place))
    actual = {**frames, "carriage": given["carriage"]}
    sightings = seen(actual, pairs, np.random.default_rng(0))
    told = r"move carriage along \(1.00, 0.00, 0.00\) of world by 0.1 m or more"
    with pytest.raises(CalibrationRefused, match=told):
        solve_graph(given, sightings)


def test_a_rail_alone_does_not_tell_where_on_it_the_arm_stands() -> None:
    """A shift of arm and camera together changes nothing that either sees: the rail only slides."""
    frames, _, pairs = CELLS["an arm on a rail"]
    given = {
        **frames,
        **{name: Frame(frames[name].parent) for name in ("base", "camera", "marker")},
    }
    told = (
        r"where base and camera are: a common shift hardly changes them; no motion makes base "
        r"and camera observable: state the place of base in the recipe"
    )
    with pytest.raises(CalibrationRefused, match=told):
        solve_graph(given, seen(frames, pairs, np.random.default_rng(0)))


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
        "do not determine where base2 is: .* no sighting connects hand2 and table2 to hand and table: let a "
        "camera of the one see a target of the other"
    )
    with pytest.raises(CalibrationRefused, match=told):
        solve_graph(given, seen(frames, pairs, np.random.default_rng(0)))


def test_wrong_sightings_of_every_pair_are_set_aside() -> None:
    name = "a scanner in the hand and one on the wall that never see the same thing"
    frames, unknown, pairs = CELLS[name]
    given = {n: Frame(f.parent) if n in unknown else f for n, f in frames.items()}
    sightings, wrong = seen(frames, pairs, np.random.default_rng(3)), {1, 8, 15, 20}
    for i in wrong:
        feature = sightings[i].feature
        off = pose(0.3, 0, 0, 0.1, 0, 0) @ feature.camera_T_target.matrix
        moved = replace(feature, camera_T_target=Transform(CAMERA, TARGET, off))
        sightings[i] = replace(sightings[i], feature=moved)
    found = solve_graph(given, sightings)
    aside = {i for i, pair in enumerate(found.pairs) if not pair.used}
    assert wrong <= aside and len(aside) <= len(wrong) + 1
    assert max(squares_at(found, {n: frames[n].place for n in unknown})) < OF_MOST

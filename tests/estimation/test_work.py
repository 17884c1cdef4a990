"""Where commands are sent, and which sighting tells most: what is predicted at poses not yet seen."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.estimation.answers.work import Work, work_of
from flangeye.estimation.graph import Places, Problem
from flangeye.estimation.plan import most_informative, work_of_frames
from flangeye.types import Box, Floats
from flangeye.types.geometry import invert, rigid, rotation_exp
from tests.estimation import foreign
from tests.estimation.sessions import problem_of, robot

SPREAD = np.diag([4e-6, 1e-6, 9e-6, 1e-8, 4e-8, 9e-8])
"""Noise of a sighting in the target's axes."""
COUNT = 16


def session(kind: str = "marker", count: int = COUNT) -> tuple[Problem, Places]:
    """Return a session's problem, its noise fixed to the targets, and the true places."""
    made = foreign.session(kind, foreign.UR5E, 1e-3, count, 1)
    problem = problem_of(made, kind, made.reported, made.joints, made.seen)
    both = np.kron(np.eye(2), problem.seen.rotations)
    covariances: Floats = np.asarray(both @ SPREAD @ np.swapaxes(both, 1, 2), dtype=np.float64)
    seen = replace(problem.seen, covariances=covariances)
    return replace(problem, seen=seen), {"camera": made.camera, "target": made.target}


def flanges(problem: Problem) -> Floats:
    return np.asarray(problem.frames["flange"].place)[problem.seen.times]


def require_predicted(work: Problem, places: Places) -> None:
    """Fail where sightings or their noise are not those that the places give."""
    target = places["target"] if work.frames["target"].place is None else np.eye(4)
    expected = invert(places["camera"]) @ flanges(work) @ target
    np.testing.assert_allclose(work.seen.poses, expected, atol=1e-12)
    turns = np.kron(np.eye(2), work.seen.rotations)
    own = np.swapaxes(turns, 1, 2) @ work.seen.covariances @ turns
    known = SPREAD if work.frames["target"].place is None else SPREAD * np.diag([1, 1, 0, 1, 1, 1])
    np.testing.assert_allclose(own, np.tile(known, (len(work.seen), 1, 1)), atol=1e-18)


@pytest.mark.parametrize("kind", ["marker", "flange"])
def test_the_work_is_where_the_session_was_and_up_to_a_few_spacings_beyond(kind: str) -> None:
    problem, places = session(kind)
    work = work_of(problem, places)
    np.testing.assert_array_equal(flanges(work.poses), flanges(problem))
    for each in (work.poses, work.around):
        require_predicted(each, places)
    at, around = flanges(problem)[:, :3, 3], flanges(work.around)[:, :3, 3]
    low, high = at.min(axis=0), at.max(axis=0)
    spacing = (high - low) / (COUNT - 1)
    assert (around >= low - 2.5 * spacing - 1e-12).all()
    assert (around <= high + 2.5 * spacing + 1e-12).all()
    assert (around.min(axis=0) < low - 2.2 * spacing).all()
    assert (around.max(axis=0) > high + 2.2 * spacing).all()
    assert len(around) > 200 and work.boxes.shape == (8, len(around))
    np.testing.assert_allclose(work.boxes.sum(axis=1), 1.0)
    within = ((around >= low) & (around <= high)).all(axis=1)
    assert work.boxes[:, within].all()
    # On average a box reaches one spacing beyond the outermost poses, less what is cut off
    beyond = [around[weights != 0].max(axis=0) - high for weights in work.boxes]
    assert 0.4 < np.mean(beyond / spacing) < 1.1
    assert len({int((weights != 0).sum()) for weights in work.boxes}) > 4


def test_weighted_poses_stand_for_all_poses_of_a_box_better_than_as_many_even_ones() -> None:
    problem, places = session()
    turns = flanges(problem)[:, :3, :3]
    middle = flanges(problem)[:, :3, 3].mean(axis=0)
    work = work_of(problem, places, Box(middle, np.array([0.1, 0.06, 0.08])))
    poses, (weights,) = flanges(work.poses), work.boxes
    corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T / np.sqrt(3)
    # Two points of Gauss and Legendre along each edge, with each orientation at each of them
    every = np.array([
        rigid(turn, middle + corner * [0.1, 0.06, 0.08]) for turn in turns for corner in corners
    ])  # fmt: skip

    def bent(at: Floats) -> Floats:
        tip = at[:, :3, :3] @ [0.1, 0.05, 0.2] + at[:, :3, 3] - middle
        bends = tip[:, :1] * tip[:, 1:]
        return np.column_stack([tip, tip**2, bends, 10 * tip**3, 10 * tip[:, 2:] * bends])

    expected = bent(every).mean(axis=0)
    off = np.abs(weights @ bent(poses) - expected)
    even = np.abs(bent(poses).mean(axis=0) - expected)
    assert np.linalg.norm(off) < 0.1 * np.linalg.norm(even)


@pytest.mark.parametrize("count", [4, 5, 8])
def test_no_few_poses_of_a_small_box_stand_for_all_others(count: int) -> None:
    problem, places = session(count=count)
    boxes = work_of(problem, places).boxes
    assert np.minimum(boxes, 0.0).sum(axis=1).min() > -0.5
    within = (boxes != 0).sum(axis=1)
    assert (1 / (boxes**2).sum(axis=1) > within / 8).all()


def test_a_box_that_is_stated_is_filled_evenly_with_the_session_s_orientations() -> None:
    problem, places = session()
    middle = flanges(problem)[:, :3, 3].mean(axis=0)
    box = Box(middle, np.array([0.1, 0.06, 0.08]))
    work = work_of(problem, places, box)
    assert work.poses is work.around
    require_predicted(work.poses, places)
    poses = flanges(work.poses)
    assert len(poses) == 256 and work.boxes.shape == (1, 256)
    off = (poses[:, :3, 3] - middle) / box.size
    np.testing.assert_allclose(off.mean(axis=0), 0.0, atol=0.01)
    np.testing.assert_allclose(off.std(axis=0), 1 / np.sqrt(12), rtol=0.02)
    assert np.abs(off).max() <= 0.5
    turns = flanges(problem)[:, :3, :3]
    which = np.abs(poses[:, None, :3, :3] - turns).max(axis=(2, 3))
    assert which.min(axis=1).max() == 0.0
    assert np.bincount(which.argmin(axis=1), minlength=COUNT).tolist() == [16] * COUNT
    (carrier,) = work.poses.carriers
    assert carrier.joints is not None and carrier.rates is None
    np.testing.assert_allclose(robot("ur5e")[1].flange(carrier.joints), poses, atol=1e-6)


def all_of_session(work: Work, problem: Problem) -> bool:
    same = np.array_equal(flanges(work.poses), flanges(problem))
    return same and work.poses is work.around and work.boxes.shape == (1, COUNT)


def test_where_no_new_pose_can_be_worked_out_the_work_is_the_session() -> None:
    problem, places = session()
    far = Box(np.array([9.0, 0.0, 0.0]), np.full(3, 0.1))
    assert all_of_session(work_of(problem, places, far), problem)
    carrier = problem.carriers[0]
    for carriers in ([], [replace(carrier, link=3)], [replace(carrier, axis=True)],
                     [carrier, carrier]):  # fmt: skip
        work = work_of(replace(problem, carriers=carriers), places, far)
        assert all_of_session(work, problem)
        require_predicted(work.poses, places)


@pytest.mark.parametrize("unknown", [{"joints": None}, {"kinematics": None}])
def test_where_no_joints_are_known_the_work_fills_its_box_all_the_same(unknown: Any) -> None:
    problem, places = session()
    arm = replace(problem.carriers[0], **unknown)
    work = work_of(replace(problem, carriers=[arm]), places)
    known = work_of(problem, places)
    assert work.boxes.shape == (8, 256) and len(flanges(known.around)) <= 256
    require_predicted(work.around, places)
    # The same boxes, where a pose out of reach is not left out
    low, high = (each(flanges(known.around)[:, :3, 3], axis=0) for each in (np.min, np.max))
    assert (flanges(work.around)[:, :3, 3].min(axis=0) <= low + 1e-12).all()
    assert (flanges(work.around)[:, :3, 3].max(axis=0) >= high - 1e-12).all()


def test_the_sighting_that_is_chosen_leaves_least_and_then_counts() -> None:
    rng = np.random.default_rng(0)
    rows, levers = rng.standard_normal((7, 6, 9)), rng.standard_normal((4, 9))
    root = rng.standard_normal((9, 9))
    covariance = root @ root.T

    def after(chosen: list[int]) -> Floats:
        told = np.einsum("mai,maj->ij", rows[chosen], rows[chosen])
        return np.asarray(np.linalg.inv(np.linalg.inv(covariance) + told))

    expected: list[int] = []
    for count in range(1, 8):
        left = [k for k in range(7) if k not in expected]
        expected.append(
            min(left, key=lambda k: np.trace(levers @ after([*expected, k]) @ levers.T))
        )
        chosen, then = most_informative(rows, covariance, levers, count)
        assert chosen.tolist() == expected
        np.testing.assert_allclose(then, after(expected), atol=1e-9)
    assert most_informative(rows, covariance, levers, 20)[0].tolist() == expected


def test_a_camera_has_to_be_right_where_it_saw_targets_and_else_a_frame_about_its_origin() -> None:
    place = rigid(rotation_exp(np.array([0.3, -0.5, 0.8])), np.array([0.4, -0.7, 0.2]))
    found: Any = SimpleNamespace(places={"camera": place, "target": place})
    centres = np.array([[0.1, 0.2, 0.7], [-0.1, 0.0, 0.6]])
    seen: Any = [
        SimpleNamespace(camera="camera", feature=SimpleNamespace(centre=c)) for c in centres
    ]
    cell: Any = None
    work = work_of_frames(found, cell, seen)
    corners = 0.1 * np.array(list(product((-1.0, 1.0), repeat=3)))
    for name, points in (("camera", centres), ("target", corners)):
        expected = points @ place[:3, :3].T + place[:3, 3]
        told = work[name][np.lexsort(work[name].T)]
        np.testing.assert_allclose(told, expected[np.lexsort(expected.T)], atol=1e-12)

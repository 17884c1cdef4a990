"""The two answers: what the arm's errors make of places in the coordinates that it reports.

Against least squares written out at every pose of the work.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from flangeye.estimation.answers.answer import (
    Answer,
    PredictedWork,
    adjoint,
    as_reported,
    as_true,
    commanded,
    expected_error,
)
from flangeye.estimation.answers.corrections import corrected_part, corrections_of
from flangeye.estimation.answers.work import Work, work_of
from flangeye.estimation.effects.arm import COMMON, displacements
from flangeye.estimation.estimate import Estimate
from flangeye.maths.arm_correction import corrected_flange
from flangeye.types import Floats
from flangeye.types.geometry import hat, invert, levers, rigid, rotation_exp, rotation_log
from tests.estimation import foreign
from tests.estimation.sessions import estimated

TURN = 0.002
"""A turn counts like what it does so far away [m]: it decides where the work is in a line."""


@pytest.fixture(scope="module", params=["marker", "hand"])
def session(request: pytest.FixtureRequest) -> tuple[str, Estimate, Work]:
    found = estimated(foreign.session(request.param, foreign.UR5E, 1e-3, 12, 1), request.param)
    return request.param, found, work_of(found.problem, found.places)


def fitted(by: Floats, moved: Floats, weights: Floats, turn: float = TURN) -> Floats:
    """Return (6, K) by which (W, 6, 6) explain (W, 6, K) best, with weights (W,)."""
    own = np.repeat([turn, 1.0], 3)
    left = (np.swapaxes(by, 1, 2) * own**2 * weights[:, None, None]).swapaxes(0, 1).reshape(6, -1)
    rows, right = (each.reshape(-1, each.shape[2]) for each in (by, moved))
    return np.asarray(np.linalg.solve(left @ rows, left @ right))


def world_of(found: Estimate, work: Work, weights: Floats) -> Floats:
    """Return (6, K): by which rigid motion of the base the arm's errors displace it most alike."""
    (carrier,) = work.around.carriers
    at = np.asarray(work.around.frames["flange"].place)[work.around.seen.times, :3, 3]
    twists = displacements(carrier)
    linear = work.around.linearised(found.places)
    back = np.linalg.inv(linear.blocks["flange"])
    columns = []
    for effect, count in zip(found.effects, found.counts, strict=True):
        if effect.kind in twists:
            columns.append(twists[effect.kind])
        elif effect.of_arm:  # the smooth error
            columns.append(back @ effect.block(work.around, linear))
        else:
            columns.append(np.zeros((len(at), 6, count)))
    motions = np.tile(np.eye(6), (len(at), 1, 1))
    motions[:, 3:, :3] = levers(at)[:, :, :3]
    return fitted(motions, np.concatenate(columns, axis=2), weights)


def test_a_place_that_stands_is_where_the_arm_reports_it_on_average(session: Any) -> None:
    kind, found, work = session
    name = "camera" if kind == "marker" else "target"
    i, at = found.problem.unknown.index(name), found.places[name][:3, 3]
    about = np.eye(6)
    about[3:, :3] = -hat(at)
    every = commanded(found, work)
    linear = work.around.linearised(found.places)
    focal = [
        e.block(work.around, linear) if e.of_camera else np.zeros((len(work.around.seen), 6, n))
        for e, n in zip(found.effects, found.counts, strict=True)
    ]
    for told, weights in zip(every, work.boxes, strict=True):
        expected = -about @ world_of(found, work, weights)
        if name == "camera":
            expected += fitted(linear.blocks[name], np.concatenate(focal, axis=2), weights)
        np.testing.assert_allclose(told[6 * i : 6 * i + 6], expected, rtol=1e-6, atol=1e-7)


def test_a_place_on_the_arm_takes_up_what_the_arm_does_beside(session: Any) -> None:
    kind, found, work = session
    names = ("camera", "target") if kind == "marker" else ("target", "camera")
    still, carried = (found.problem.unknown.index(name) for name in names)
    linear = work.around.linearised(found.places)
    whose = "of_camera" if kind == "hand" else ""
    moved, focal = (
        np.concatenate([
            e.block(work.around, linear) if each and getattr(e, each)
            else np.zeros((len(work.around.seen), 6, n))
            for e, n in zip(found.effects, found.counts, strict=True)
        ], axis=2)
        for each in ("of_arm", whose)
    )  # fmt: skip
    at = found.places[names[0]][:3, 3]
    about = np.eye(6)
    about[3:, :3] = -hat(at)
    for told, weights in zip(commanded(found, work), work.boxes, strict=True):
        stands = linear.blocks[names[0]] @ (-about @ world_of(found, work, weights))
        # Eight corners of a cube of 100 mm about the target, moved by a turn of 1 rad
        corners = 0.05 / np.sqrt(3) * np.array(list(product((-1, 1), repeat=3)))
        lever = np.hypot(TURN, np.sqrt((corners[:, :2] ** 2).sum(axis=1).mean()))
        expected = fitted(linear.blocks[names[1]], moved - stands + focal, weights, lever)
        rows = told[6 * carried : 6 * carried + 6]
        np.testing.assert_allclose(rows, expected, rtol=1e-5, atol=1e-6)
        # What the first joint does is a motion of the base, of which nothing is left
        both = linear.blocks[names[0]] @ told[6 * still : 6 * still + 6]
        both = both + linear.blocks[names[1]] @ rows
        np.testing.assert_allclose(both[..., 0], moved[..., 0], atol=1e-6)


def test_an_answer_is_averaged_over_the_boxes_that_may_be_meant(session: Any) -> None:
    _, found, work = session
    posterior, p = found.posterior, found.posterior.model.p
    true = as_true(found)
    np.testing.assert_allclose(true.mean, posterior.mean[:p])
    np.testing.assert_allclose(true.covariance, posterior.covariance[:p, :p], atol=1e-18)
    rows = [np.hstack([np.eye(p), each]) for each in commanded(found, work)]
    means = np.array([each @ posterior.mean for each in rows])
    within = np.mean([each @ posterior.covariance @ each.T for each in rows], axis=0)
    told = as_reported(found, work)
    np.testing.assert_allclose(told.mean, means.mean(axis=0), atol=1e-15)
    np.testing.assert_allclose(told.covariance, within + np.cov(means.T), rtol=1e-6, atol=1e-16)
    assert list(told.shares) == list(
        dict.fromkeys(["noise of single scans and poses", *(e.name for e in found.effects)])
    )
    # The parts are of the likeliest sizes alone: those of all sizes together are about as large
    share = np.trace(sum(told.shares.values())) / np.trace(told.covariance)
    assert 0.5 < share < 1.5


def test_an_answer_elsewhere_is_known_worse_by_how_far_it_is() -> None:
    told = Answer(np.array([1.0, 2.0]), np.diag([4.0, 9.0]), {})
    there = told.at(np.array([2.0, 4.0]))
    assert there.mean.tolist() == [2.0, 4.0]
    assert there.covariance.tolist() == [[5.0, 2.0], [2.0, 13.0]]


def test_a_twist_in_a_frame_is_another_in_its_parent() -> None:
    pose = rigid(rotation_exp(np.array([0.3, -0.5, 0.8])), np.array([0.4, -0.7, 0.2]))
    for i in range(6):
        step = 1e-7 * np.eye(6)[i]
        moved = pose @ rigid(rotation_exp(step[:3]), step[3:]) @ invert(pose)
        told = np.concatenate([rotation_log(moved[:3, :3]), moved[:3, 3]]) / 1e-7
        np.testing.assert_allclose(adjoint(pose)[:, i], told, atol=1e-6)


def test_the_error_to_expect_is_that_of_the_answer_and_of_what_changes_anew() -> None:
    rng = np.random.default_rng(0)
    rows, x = rng.standard_normal((40, 3, 5)), rng.standard_normal(5)
    means = np.array([rows @ x, rows @ x + 1.0])
    squares = np.array([0.5, 0.25])
    there = PredictedWork(rows, means, rng.standard_normal((2, 8, 40, 3)), squares)
    # Of places and effects as they are, what is left is the second's own and what changes anew
    told = expected_error(there, x[:3], x[3:])
    assert told.rms == pytest.approx(np.sqrt((0.5 + 3.25) / 2))
    of_arm = ((rows[..., 3:] @ x[3:]) ** 2).sum(axis=1).mean()
    also = ((rows[..., 3:] @ x[3:] + 1.0) ** 2).sum(axis=1).mean()
    told = expected_error(there, x[:3])
    assert told.rms == pytest.approx(np.sqrt((of_arm + 0.5 + also + 0.25) / 2))


def test_of_twenty_errors_one_is_larger_than_its_quantile_whatever_the_scale_of_the_draws() -> None:
    rows, none = np.zeros((100, 3, 4)), np.zeros(4)
    drawn = np.zeros((1, 8, 100, 3))
    drawn[..., 2] = np.arange(800.0).reshape(8, 100) + 1.0
    exact = (np.arange(1.0, 801.0) ** 2).mean()
    for scale in (1.0, 7.0):
        there = PredictedWork(rows, np.zeros((1, 100, 3)), scale * drawn, np.array([exact]))
        told = expected_error(there, none)
        assert told.p95 == pytest.approx(760.0, abs=1.01)
        assert told.rms == pytest.approx(np.sqrt(exact))


def displaced(found: Estimate, numbers: Floats) -> Floats:
    """Return (N, 3) how far errors of these sizes displace the flange, but those of all poses."""
    problem, each = found.problem, np.split(numbers, np.cumsum(found.counts)[:-1])
    linear = problem.following(problem.carriers[0])
    moved = [
        e.block(problem, linear)[:, 3:] @ part
        for e, part in zip(found.effects, each, strict=True)
        if e.of_arm and e.kind != COMMON
    ]
    return np.asarray(np.sum(moved, axis=0))


def require_taken_off(found: Estimate, kinds: set[str]) -> None:
    """Fail where a correction leaves more of an arm's errors than a rigid motion and a rest."""
    problem, (carrier,) = found.problem, found.problem.carriers
    tool, numbers = np.array([0.0, 0.02, 0.1]), found.posterior.mean[found.posterior.model.p :]
    ((arm, told),) = corrections_of(found, tool).items()
    assert arm == carrier.arm
    poses = np.asarray(problem.frames["flange"].place)
    joints = [None] * len(poses) if carrier.joints is None else carrier.joints
    after = np.array([
        corrected_flange(pose, q, told, carrier.kinematics)
        for pose, q in zip(poses, joints, strict=True)
    ])  # fmt: skip
    moved = after[:, :3, 3] - after[:, :3, :3] @ tool - poses[:, :3, 3]
    taken = displaced(found, corrected_part(found))
    np.testing.assert_allclose(moved, taken, atol=2e-6)
    alone = displaced(
        found,
        np.where(np.repeat([e.kind in kinds for e in found.effects], found.counts), numbers, 0),
    )
    motions = levers(poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)).reshape(-1, 6)

    def rigid_part(moved: Floats) -> Floats:
        return np.asarray(motions @ np.linalg.lstsq(motions, moved.ravel(), rcond=None)[0])

    def bent(moved: Floats) -> float:
        return float(np.linalg.norm(moved.ravel() - rigid_part(moved)))

    every, added = displaced(found, numbers), taken - alone
    assert bent(every - taken) < 0.6 * bent(every - alone)
    assert np.linalg.norm(rigid_part(added)) < 0.3 * bent(added)


def test_a_correction_takes_off_what_bends_the_work_and_leaves_rigid_motions(session: Any) -> None:
    require_taken_off(session[1], {"zeros", "lengths", "twists", "field"})


def test_of_an_arm_whose_joints_are_unknown_a_correction_is_a_field_alone() -> None:
    found = estimated(foreign.session("marker", foreign.UR5E, 1e-3, 12, 1), "marker", told=False)
    require_taken_off(found, {"field"})
    (told,) = corrections_of(found, np.zeros(3)).values()
    assert told.field is not None and told.joint_offsets is None and told.lengths is None

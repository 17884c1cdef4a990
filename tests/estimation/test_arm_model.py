"""An arm's own parameters: found where the poses tell them, with what they leave unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flangeye.estimation.arm_model import (
    LOOSE,
    ArmFit,
    ArmSession,
    _by_poses,
    _jacobian,
    combinations,
    covariance_at_work,
    deviations,
    expected,
    fit_arm,
    flange_of,
    identified,
    most_telling,
    residuals,
    sensitivity,
)
from flangeye.maths.geometry import hat, rigid, rotation_exp, rotation_log
from flangeye.maths.kinematics import Arm
from flangeye.types import Floats
from tests.estimation.cells import ROBOT

ARM = Arm(ROBOT)
N = ARM.n
HOME = np.radians([0, -90, 90, -90, -90, 0])
PRIOR = deviations(N, 3e-3, 0.5e-3, 1e-3)
CAMERA = rigid(rotation_exp([2.0, 0.3, -0.4]), np.array([0.6, -0.1, 1.0]))
SIGMA = 5e-5
NONE = np.zeros((N, 4))


def drawn(
    seed: int, count: int = 30, parameters: Floats = NONE, sigma: float = SIGMA, stated: float = 0.0
) -> ArmSession:
    """Return sightings of a circle on the flange of an arm with such parameters."""
    rng = np.random.default_rng(seed)
    joints = HOME + rng.uniform(-0.6, 0.6, (count, N))
    mounts = np.tile([0.01, -0.02, 0.03], (count, 1))
    noise = np.full(count, stated**2)
    bare = ArmSession(joints, ARM.flange(joints), np.zeros((count, 3)), mounts, noise)
    seen = expected(ARM, bare, parameters) + sigma * rng.standard_normal((count, 3))
    return replace(bare, centres=(seen - CAMERA[:3, 3]) @ CAMERA[:3, :3])


def fitted(session: ArmSession, prior: Floats = PRIOR) -> ArmFit:
    start = rigid(rotation_exp([0.02, -0.01, 0.03]), np.array([5e-3, -5e-3, 5e-3])) @ CAMERA
    return fit_arm(ARM, session, start, prior, (2e-4) ** 2)


def told(information: Floats, prior: Floats = PRIOR) -> ArmFit:
    """Return a fit of which such information is all that matters."""
    return ArmFit(CAMERA, np.zeros_like(prior), np.eye(0), information, np.zeros(3), SIGMA**2)


def test_deviations_are_of_zeros_lengths_and_twists() -> None:
    assert deviations(2, 3.0, 0.5, 1.0).tolist() == [[3.0, 0.5, 0.5, 1.0]] * 2


def test_the_flange_is_as_reported_and_moves_with_a_zero_as_with_its_joint() -> None:
    session = drawn(0, 5)
    assert flange_of(ARM, session, NONE) == pytest.approx(session.poses, abs=1e-12)
    off = replace(session, poses=rigid(np.eye(3), np.array([0.1, 0.0, 0.0])) @ session.poses)
    zeros = np.zeros((N, 4))
    zeros[:, 0] = np.linspace(-0.02, 0.03, N)
    moved = flange_of(ARM, off, zeros)
    assert moved[:, 0, 3] == pytest.approx(ARM.flange(session.joints + zeros[:, 0])[:, 0, 3] + 0.1)
    found = sensitivity(ARM, session, NONE).reshape(5, 3, N, 4)[..., 0]
    jacobian = ARM.jacobian(session.joints)
    lever = (session.poses[:, :3, :3] @ session.mounts[..., None])[..., 0]
    circle = jacobian[:, 3:] - hat(lever) @ jacobian[:, :3]
    assert found == pytest.approx(circle, abs=1e-8)


def test_a_camera_that_is_where_it_is_leaves_no_residuals() -> None:
    rng = np.random.default_rng(3)
    parameters = PRIOR * rng.standard_normal((N, 4))
    session = drawn(0, 6, parameters, sigma=0.0)
    exact = replace(told(np.eye(0)), parameters=parameters)
    assert np.abs(residuals(ARM, session, exact)).max() < 1e-12
    shifted = replace(session, centres=session.centres + CAMERA[:3, :3].T @ [1e-3, 0.0, 0.0])
    assert residuals(ARM, shifted, exact) == pytest.approx(np.tile([1e-3, 0, 0], (6, 1)))


def test_camera_and_parameters_are_off_by_what_is_stated() -> None:
    """Thirty numbers: their squared distance is thirty on the average, to 2.7 of eight draws."""
    squares = []
    for seed in range(8):
        parameters = PRIOR * np.random.default_rng([seed, 1]).standard_normal((N, 4))
        fit = fitted(drawn(seed, 30, parameters))
        motion = CAMERA @ np.linalg.inv(fit.base_T_camera)
        shift = motion[:3, :3] @ fit.about + motion[:3, 3] - fit.about
        off = np.concatenate([rotation_log(motion[:3, :3]), shift,
                              (parameters - fit.parameters).ravel()])  # fmt: skip
        squares.append(off @ np.linalg.solve(fit.covariance, off))
    assert np.mean(squares) == pytest.approx(30, rel=0.25)


def test_what_scatters_beyond_the_centres_own_noise_is_found() -> None:
    found = [fitted(drawn(seed, 20, stated=0.0)).scatter for seed in range(6)]
    assert np.mean(found) == pytest.approx(SIGMA**2, rel=0.15)
    some = [fitted(drawn(seed, 20, stated=0.6 * SIGMA)).scatter for seed in range(6)]
    assert np.mean(some) == pytest.approx(0.64 * SIGMA**2, rel=0.2)
    assert fitted(drawn(0, 20, stated=2 * SIGMA)).scatter == (1e-6) ** 2


def test_what_shall_stay_stays_and_an_arm_is_found_whose_lengths_are_known() -> None:
    prior, parameters = deviations(N, 3e-3, 0.0, 0.0), np.zeros((N, 4))
    parameters[1:-1, 0] = [4e-3, -3e-3, 2e-3, -4e-3]
    fit = fitted(drawn(5, 40, parameters), prior)
    assert not fit.parameters[:, 1:].any()
    kept = np.concatenate([np.ones(6), prior.ravel()]) > 0
    assert not fit.covariance[~kept].any() and (np.diag(fit.covariance)[kept] > 0).all()
    assert fit.parameters[1:-1, 0] == pytest.approx(parameters[1:-1, 0], abs=3e-4)
    assert np.sqrt((residuals(ARM, drawn(6, 40, parameters), fit) ** 2).mean()) < 1.5 * SIGMA


def test_a_zero_that_turns_the_base_widens_the_pose_and_not_the_work() -> None:
    session, free = drawn(7, 30), np.zeros((N, 4))
    alone = fitted(session, free)
    assert covariance_at_work(ARM, session, alone) == pytest.approx(alone.covariance[:6, :6])
    free[0, 0] = 3e-3
    turning = fitted(session, free)
    assert turning.covariance[2, 2] > (2.9e-3) ** 2
    at_work = covariance_at_work(ARM, session, turning)
    scale = np.sqrt(np.diag(alone.covariance)[:6])
    assert at_work / np.outer(scale, scale) == pytest.approx(
        alone.covariance[:6, :6] / np.outer(scale, scale), abs=1e-3
    )


@pytest.mark.parametrize(("size", "known"), [(3.9, False), (4.1, True)])
def test_a_parameter_is_identified_that_poses_tell_to_half_of_what_was_known(
    size: float, known: bool
) -> None:
    prior = PRIOR.copy()
    prior[1, 2] = 0.0
    every = np.concatenate([np.full(6, 1e6), np.full(prior.size, size)])
    found = identified(told(np.diag(every)), prior)
    assert np.array_equal(found, (prior > 0) & known)
    assert combinations(told(np.diag(every)), prior) == known * (prior.size - 1)


@pytest.mark.parametrize(("share", "known"), [(0.45 / LOOSE, True), (0.55 / LOOSE, False)])
def test_a_parameter_is_identified_singly_whatever_the_others_are(
    share: float, known: bool
) -> None:
    """Each other one may be off by a hundred of its deviations."""
    seen = np.zeros(6 + PRIOR.size)
    seen[6], seen[7] = 1.0, share
    fit = told(1e4 * np.outer(seen, seen))
    assert identified(fit, PRIOR).ravel().tolist() == [known] + [False] * (PRIOR.size - 1)
    assert combinations(fit, PRIOR) == 1


def test_a_parameter_that_moves_all_as_the_camera_would_is_not_told_at_all() -> None:
    seen = np.zeros(6 + PRIOR.size)
    seen[2] = seen[6] = 1.0
    fit = told(1e6 * np.outer(seen, seen))
    assert np.diag(_by_poses(fit, PRIOR)) == pytest.approx(np.full(PRIOR.size, LOOSE**2), rel=1e-3)


def test_further_poses_are_those_after_which_the_parameters_are_known_best() -> None:
    """Each against what all candidates would leave, one after the other."""
    fit = replace(fitted(drawn(8, 12)), parameters=NONE)
    candidates = replace(drawn(9, 15, stated=2e-5), mounts=np.zeros((15, 3)))
    at = expected(ARM, candidates, fit.parameters)  # seen where the fit has them
    camera = fit.base_T_camera
    seen = replace(candidates, centres=(at - camera[:3, 3]) @ camera[:3, :3])
    rows = _jacobian(ARM, seen, fit) * np.concatenate([np.ones(6), PRIOR.ravel()])
    each = np.swapaxes(rows, 1, 2) @ rows / (fit.scatter + (2e-5) ** 2)

    chosen, after = most_telling(ARM, candidates, fit, PRIOR, 3)
    information = fit.information
    for best in chosen:
        left = [np.trace(_by_poses(told(information + one), PRIOR)) for one in each]
        assert left[best] == pytest.approx(min(left), rel=1e-6)
        information = information + each[best]
    scale = np.sqrt(np.outer(*[np.diag(information) + 1.0] * 2))
    assert after.information / scale == pytest.approx(information / scale, abs=1e-6)
    two = candidates.where(np.arange(15) < 2)
    assert sorted(most_telling(ARM, two, fit, PRIOR, 3)[0]) == [0, 1]  # none is chosen twice

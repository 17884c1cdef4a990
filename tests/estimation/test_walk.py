"""A camera's drift that accumulates from pose to pose, as that of visual odometry does."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flangeye.estimation.effects.walk import innovations
from flangeye.estimation.session.session import Session, session_of
from flangeye.maths.statistics import chi2_quantile
from flangeye.models.cell import cell_of
from flangeye.models.configuration import Configuration
from flangeye.types import BASE, CAMERA, FLANGE, TARGET, Observation, PoseFeature, Transform, Warn
from tests.estimation import foreign

NOISE = np.diag(np.square([2e-3] * 3 + [0.5e-3] * 3))


def twists(rng: np.random.Generator, count: int, turn: float, shift: float) -> np.ndarray:
    """Return (N, 4, 4) small random motions."""
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, :3, :3] = Rotation.from_rotvec(turn * rng.standard_normal((count, 3))).as_matrix()
    out[:, :3, 3] = shift * rng.standard_normal((count, 3))
    return out


def accumulated(seen: np.ndarray, steps: np.ndarray, in_hand: bool) -> np.ndarray:
    """Return sightings (N, 4, 4) to which each step of the camera adds, in hand by its world."""
    world, out = np.linalg.inv(seen), [seen[0]]
    drifted = [world[0]]
    for k in range(1, len(seen)):
        if in_hand:
            drifted.append(drifted[-1] @ np.linalg.inv(world[k - 1]) @ world[k] @ steps[k])
            out.append(np.linalg.inv(drifted[-1]))
        else:
            steps[k] = steps[k] @ steps[k - 1]
            out.append(steps[k] @ seen[k])
    return np.array(out)


def solved(kind: str, seed: int, turn: float, shift: float) -> tuple[Session, np.ndarray]:
    """Return the estimate from 40 sightings of a drifting camera, and the camera's true place."""
    s = foreign.session(kind, foreign.UR5E, 0.05e-3, 40, seed)
    rng = np.random.default_rng([seed, 5])
    steps = twists(rng, 40, turn, shift)
    steps[0] = np.eye(4)
    seen = accumulated(s.seen, steps, s.in_hand)
    observations = [
        Observation(
            f"{k:02d}",
            PoseFeature(Transform(CAMERA, TARGET, pose), NOISE),
            {FLANGE: Transform(BASE, FLANGE, flange)},
        )
        for k, (pose, flange) in enumerate(zip(seen, s.reported, strict=True))
    ]
    cell = Configuration("eye-in-hand", FLANGE, BASE) if s.in_hand else Configuration()
    return session_of(observations, cell_of(cell, None), None), s.camera


def error(session: Session, camera: np.ndarray) -> tuple[float, float]:
    """Return the error of the camera's place [m], and its square over its covariance and 6."""
    found = session.found
    off = found.problem.moves(found.places, {**found.places, CAMERA: camera})
    own = found.posterior.covariance[:6, :6]
    assert found.problem.unknown[0] == CAMERA
    return float(np.linalg.norm(off[3:6])), float(off[:6] @ np.linalg.solve(own, off[:6])) / 6


@pytest.mark.parametrize("seed", [1, 4])
def test_a_camera_in_hand_whose_world_drifts_is_found(seed):
    """Without the walk it is off by 2 and 3 mm."""
    session, camera = solved("hand", seed, 2e-3, 0.3e-3)
    off, square = error(session, camera)
    assert square < chi2_quantile(0.999, 6) / 6
    assert any(isinstance(note, Warn) and "drift" in note for note in session.notes)
    assert off < 0.7e-3


def test_a_fixed_camera_that_drifts_is_where_it_was_at_first():
    session, camera = solved("marker", 0, 2e-3, 0.3e-3)
    assert any(session.found.problem.walk)
    assert error(session, camera)[1] < chi2_quantile(0.999, 6) / 6


def test_without_the_first_poses_the_drift_is_counted_from_the_next():
    """The target's place was that of the first pose, and nothing else told it."""
    session, camera = solved("hand", 1, 2e-3, 0.3e-3)
    less = session.without(np.arange(3))
    assert not less.found.inliers[:3].any() and less.found.inliers[3:].any()
    assert error(less, camera)[0] < 0.7e-3
    spread = np.sqrt(np.diag(less.found.posterior.covariance)[6:12])
    assert (spread < 5e-3).all()


@pytest.mark.parametrize("kind", ["hand", "marker"])
def test_white_noise_is_no_drift(kind):
    for seed in range(3):
        session, _ = solved(kind, seed, 0.0, 0.0)
        assert not any(session.found.problem.walk)


@pytest.mark.parametrize("kind", ["hand", "marker"])
def test_a_drift_that_has_come_is_predicted_for_good(kind):
    session, _ = solved(kind, 0, 0.0, 0.0)
    problem, model = session.found.problem, session.found.posterior.model
    # Residuals of a drift that came before the third sighting, in the axes where it stands
    turn = np.kron(np.eye(2), problem.seen.rotations) if kind == "hand" else np.eye(6)
    lever = np.tile(np.eye(6), (40, 1, 1))
    if kind == "marker":
        x, y, z = problem.seen.centres.T
        zero = np.zeros(40)
        across = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
        lever[:, 3:, :3] = -np.moveaxis(across, -1, 0)
    came = (lever @ turn @ np.array([1, 2, 3, 4, 5, 6.0])) * (np.arange(40) >= 2)[:, None]
    left = innovations(
        replace(problem, walk=(1.0, 1.0)), replace(model, residuals=came, shares=np.ones(40))
    ).residuals
    assert np.allclose(left[2], came[2]) and np.allclose(np.delete(left, 2, axis=0), 0, atol=1e-9)

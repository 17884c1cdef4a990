"""The loop's derivatives, found by small steps, in every configuration."""

from dataclasses import replace

import numpy as np
import pytest

from flangeye.handeye.components import Noise
from flangeye.handeye.loop import ArmNoise, free_columns, linearise, meaningless_turns
from flangeye.handeye.measurements import Loop, Measurements, loop_of, measurements_of
from flangeye.handeye.unknowns import Unknowns, weights_of
from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.maths.kinematics import Arm
from flangeye.types import Floats
from tests.handeye.cells import CONFIGURATIONS, ISSUE, ROBOT, session

STEP = 1e-6
FEATURES = ("pose", "normal", "centre")
EACH = [(n, f) for n in CONFIGURATIONS for f in FEATURES if (n, f) not in {
    ("two arms, marker", "normal"), ("two arms, marker", "centre")}]  # fmt: skip


def exact(name: str, feature: str) -> tuple[Measurements, Loop, Unknowns]:
    """Return exact measurements, and the unknowns that fit them."""
    configuration = CONFIGURATIONS[name]
    rng = np.random.default_rng(0)
    drawn = session(configuration, rng, 11, 0.5, ISSUE.scaled(0.0), feature)
    s = measurements_of(drawn.observations, configuration, Arm(ROBOT))
    loop = loop_of(configuration)
    places = iter(drawn.truth.values())
    x, y = next(places), next(places) if loop.y else np.eye(4)
    return s, loop, Unknowns.of_loop(x, y, next(places) if loop.z else loop.place)


def slopes(residuals, count: int) -> Floats:
    """Return (N, 6, count) derivatives of residuals, given by a step's direction and size."""
    each = [residuals(STEP * e) - residuals(-STEP * e) for e in np.eye(count)]
    return np.stack(each, axis=2) / (2 * STEP)


@pytest.mark.parametrize(("name", "feature"), EACH)
def test_a_prediction_moves_with_each_unknown_as_is_said(name: str, feature: str) -> None:
    s, loop, at = exact(name, feature)
    linear = linearise(s, loop, at, None)
    found = -s.projectors @ linear.jacobian
    expected = slopes(lambda step: linearise(s, loop, at.moved(step), None).residuals, 20)
    fitted = np.r_[0:6, 6 : 12 if loop.y else 6, 12 : 18 if loop.z else 12, 18:20]
    assert found[..., fitted] == pytest.approx(expected[..., fitted], abs=1e-6)
    others = np.setdiff1d(np.arange(20), fitted)
    assert not found[..., others].any()


@pytest.mark.parametrize(("name", "feature"), EACH)
def test_an_arms_noise_moves_what_is_seen_as_its_motions_would(name: str, feature: str) -> None:
    s, loop, at = exact(name, feature)
    arms = ArmNoise(2e-4, 5e-5)

    def moved(step: Floats) -> Floats:
        """Return residuals with the arms' poses moved in their flanges: the camera's, the target's."""
        a, b = (
            pose @ rigid(rotation_exp(part[:3]), part[3:]) if moves else pose
            for pose, part, moves in (
                (s.a, step[:6], loop.camera_moves), (s.b, step[6:], loop.target_moves),
            )
        )  # fmt: skip
        return linearise(replace(s, a=a, b=b), loop, at, None).residuals

    effect = slopes(moved, 12)
    spread = np.kron(np.eye(2), arms.covariance)
    stated = linearise(s, loop, at, arms).of_arms
    projected = s.projectors @ stated @ s.projectors
    expected = effect @ spread @ effect.transpose(0, 2, 1)
    assert projected == pytest.approx(expected, abs=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize(("name", "feature"), EACH)
def test_what_is_fitted_changes_what_is_seen_and_what_means_nothing_does_not(
    name: str, feature: str
) -> None:
    s, loop, at = exact(name, feature)
    seen = s.projectors @ linearise(s, loop, at, None).jacobian
    nothing = meaningless_turns(s, loop, at)
    basis = free_columns(s, loop, at, None)
    assert np.abs(seen @ nothing).max(initial=0.0) < 1e-9
    assert basis.shape[1] + nothing.shape[1] == 6 + 6 * loop.y + 6 * loop.z
    assert np.linalg.matrix_rank((seen @ basis).reshape(-1, basis.shape[1])) == basis.shape[1]
    tilted = free_columns(s, loop, at, 1e-3).shape[1] - basis.shape[1]
    assert tilted == (2 if feature == "normal" and not loop.z else 0)


@pytest.mark.parametrize("feature", FEATURES)
def test_a_measurement_counts_by_the_inverse_of_all_its_noise(feature: str) -> None:
    s, loop, at = exact("eye-on-base, flange", feature)
    linear = linearise(s, loop, at, ArmNoise(2e-4, 5e-5))
    noise = Noise(pose=1e-8, tilt=1e-7, normal_scale=2.0, centre_scale=3.0, arms=0.5, depth=4e-8)
    weights = weights_of(s, linear, noise)
    scale = np.repeat(np.sqrt([2.0, 3.0]), 3)
    covariance = (s.covariances + 0.5 * linear.of_arms) * np.outer(scale, scale)
    covariance = covariance + np.diag([1e-7] * 3 + [1e-8, 1e-8, 5e-8])
    p = s.projectors
    assert p @ covariance @ p @ weights == pytest.approx(p, abs=1e-2)
    assert weights == pytest.approx(p @ weights @ p, rel=1e-9, abs=1e-3)

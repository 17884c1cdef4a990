"""solve.iterative: Algorithm 1 with its errata mended, its parts, and its closed loop."""

from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from flangeye import CalibrationRefused, StageError
from flangeye.models.targets import Flange
from flangeye.plugin.stage import part
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    CircleFeature,
    Observation,
    Observations,
    PoseError,
    Source,
    Transform,
    Views,
    by_frame,
)
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_plugins.cost import (
    AxesParams,
    TranslationParams,
    WorkRadiusParams,
    cost_axes,
    cost_translation,
    cost_work_radius,
)
from flangeye_plugins.error import error_holdout
from flangeye_plugins.solve.iterative import (
    IterativeParams,
    improve_pool,
    solve_iterative,
    solve_pool,
)

MM = 1e-3
TRUTH = Transform(
    BASE, CAMERA, rigid(rotation_exp(np.array([2.9, 0.4, -0.3])), np.array([0.4, -0.7, 0.9]))
)


def simulate(n: int, sigma: float = 0.3 * MM, seed: int = 0) -> list[Observation]:
    rng = np.random.default_rng(seed)
    observations = []
    for i in range(n):
        tcp = np.array([0.4, -0.5, 0.2]) + rng.uniform(-1, 1, 3) * [0.15, 0.15, 0.1]
        centre = TRUTH.inverse().apply(tcp) + sigma * rng.standard_normal(3)
        circle = CircleFeature(centre, None, {}, np.eye(3) * sigma**2, None, 1.0)
        pose = Transform(BASE, FLANGE, rigid(np.eye(3), tcp))
        observations.append(Observation(f"{i:02d}", circle, by_frame(pose)))
    return observations


def parameters(**given: object) -> IterativeParams:
    """Parameters with error.holdout, as a recipe would choose it."""
    chosen = {"error": error_holdout.bind(), "cost": cost_translation.bind(), "reserve": 6}
    return IterativeParams.model_validate({**chosen, **given})


def run(observations: Observations | list[Observation], params: IterativeParams):
    if not isinstance(observations, Observations):
        observations = Observations(observations, Source("test"))
    return solve_iterative(observations, Views(), None, params)


def worst(base_T_camera: Transform) -> float:
    """Distance from the truth at the work: an oracle, for tests of the search alone."""
    error = base_T_camera.inverse().matrix @ TRUTH.matrix
    return float(np.linalg.norm(error[:3, 3]))


def test_the_cost_never_grows_and_the_pool_keeps_its_size() -> None:
    stream = iter(simulate(40))
    first = [next(stream) for _ in range(4)]
    search = improve_pool(first, stream, worst, 0.0, 100)
    assert len(search.history) == 37
    assert (np.diff(search.history) <= 0).all()
    assert search.history[-1] < search.history[0]
    assert len({o.id for o in search.pool}) == 4
    assert search.cost == worst(solve_pool(search.pool))


def test_k_advances_to_k_max() -> None:
    stream = iter(simulate(40))
    first = [next(stream) for _ in range(4)]
    search = improve_pool(first, stream, worst, 0.0, 7)
    assert len(search.history) == 8
    assert next(stream).id == "11"  # 4 of the pool, 7 tried, nothing more pulled


def test_it_stops_pulling_when_the_cost_is_as_required() -> None:
    pulled = []

    def arm() -> Iterator[Observation]:
        for observation in simulate(60):
            pulled.append(observation.id)
            yield observation

    calibration = run(Observations(arm(), Source("test")), parameters(required="0.5 mm"))
    assert 10 <= len(pulled) < 60
    assert [p.observation.id for p in calibration.pairs] == pulled
    assert calibration.notes[0].endswith("as required")


def test_every_pose_outside_the_pool_says_why() -> None:
    calibration = run(simulate(30), parameters(required="0 mm"))
    used = [p for p in calibration.pairs if p.used]
    unused = [p.reason for p in calibration.pairs if not p.used]
    assert len(used) == 4
    assert len(unused) == 26
    assert unused[:6] == ["kept out of the pool to measure the error"] * 6
    assert all(
        reason.startswith(("replaced in the pool by", "did not improve the pool"))
        for reason in unused[6:]
    )
    assert calibration.notes[0].startswith("cost 0.")
    assert calibration.notes[0].endswith("no more poses before the required 0.000 mm")
    assert calibration.method == "solve.iterative"


def test_a_start_at_infinity_rolls_the_pool_on() -> None:
    observations = simulate(20)
    for i in range(4):  # the first pool in line: no answer, whatever the error
        tcp = np.array([0.3 + 0.05 * i, -0.5, 0.2])
        circle = CircleFeature(TRUTH.inverse().apply(tcp), None, {}, np.eye(3), None, 1.0)
        observations[i] = Observation(
            f"{i:02d}", circle, by_frame(Transform(BASE, FLANGE, rigid(np.eye(3), tcp)))
        )
    stream = iter(observations)
    first = [next(stream) for _ in range(4)]
    search = improve_pool(first, stream, worst, 0.0, 100)
    assert np.isinf(search.history[0])
    assert np.isfinite(search.history[1])
    assert any(r.startswith("replaced in the pool by 04: infinity") for r in search.losers.values())


def test_while_everything_is_infinite_the_oldest_pose_makes_way() -> None:
    stream = iter(simulate(9))
    first = [next(stream) for _ in range(4)]
    search = improve_pool(first, stream, lambda _: float("inf"), 0.0, 100)
    assert [o.id for o in search.pool] == ["05", "06", "07", "08"]


def test_an_error_that_stays_infinite_is_refused() -> None:
    @part("error.never")
    def never(
        base_T_camera: Transform,
        kept: Sequence[Observation],
        views: Views,
        flange: Flange | None,
    ) -> PoseError | None:
        """Measure nothing."""
        return None

    with pytest.raises(CalibrationRefused) as refused:
        run(simulate(12), parameters(error=never.bind(), reserve=0))
    assert str(refused.value) == (
        "no pool of 4 out of 12 poses gives a finite error; check the verification view and the "
        "flange's model, or set error: holdout"
    )


def test_fewer_poses_than_the_pool_are_refused() -> None:
    with pytest.raises(StageError) as refused:
        run(simulate(8), parameters())
    assert str(refused.value) == (
        "10 poses needed, 8 given: add poses, or see why captures were set aside"
    )


def test_without_reserve_error_holdout_says_what_to_set() -> None:
    with pytest.raises(StageError, match="set reserve: 5"):
        run(simulate(12), parameters(reserve=0))


def test_a_larger_pool_is_a_better_answer() -> None:
    def rms(pool: int) -> float:
        errors = [
            worst_at_work(run(simulate(40, seed=seed), parameters(pool=pool, required="0 mm")))
            for seed in range(10)
        ]
        return float(np.sqrt(np.mean(np.square(errors))))

    assert rms(10) < rms(4)


def worst_at_work(calibration) -> float:
    corners = np.array([0.4, -0.5, 0.2]) + 0.1 * np.array([[1, 1, 1], [-1, -1, -1], [1, -1, 0]])
    mapped = calibration.base_T_camera.transform.apply(TRUTH.inverse().apply(corners))
    return float(np.linalg.norm(mapped - corners, axis=1).max())


def pose_error(phi: list[float], tau: list[float], at: list[float]) -> PoseError:
    """Turned by phi and moved by tau at ``at``; the camera looks straight down."""
    rotation = rotation_exp(np.array(phi))
    motion = rigid(rotation, np.array(at) + np.array(tau) - rotation @ np.array(at))
    return PoseError(motion, np.array(at), np.diag([1.0, -1.0, -1.0]))


def test_the_costs_of_a_known_error() -> None:
    error = pose_error([0.01, 0, 0], [3 * MM, -4 * MM, 12 * MM], [0, 0, 0.7])
    assert cost_translation(error, TranslationParams()) == pytest.approx(13 * MM)
    assert cost_axes(error, AxesParams(axes=("x", "y"))) == pytest.approx(5 * MM)
    assert cost_axes(error, AxesParams(axes=("z",))) == pytest.approx(12 * MM)
    radius = WorkRadiusParams.model_validate({"radius": "500 mm"})
    assert cost_work_radius(error, radius) == pytest.approx(np.hypot(13, 5) * MM)


def test_at_the_camera_origin_rotation_counts_times_the_distance() -> None:
    error = pose_error([0.01, 0, 0], [0, 0, 0], [0, 0, 0.7])
    assert cost_translation(error, TranslationParams()) == pytest.approx(0, abs=1e-12)
    assert cost_translation(error, TranslationParams(at="camera")) == pytest.approx(
        7 * MM, rel=1e-3
    )


def test_the_answer_is_bit_identical() -> None:
    first, second = (run(simulate(25), parameters(required="0 mm")) for _ in range(2))
    matrices = [c.base_T_camera.transform.matrix.tobytes() for c in (first, second)]
    assert matrices[0] == matrices[1]

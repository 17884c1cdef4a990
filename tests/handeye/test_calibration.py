"""What a calibration says of the noise it found."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy import stats

from flangeye.errors import CalibrationRefused
from flangeye.handeye import calibration
from flangeye.handeye.calibration import TYPICAL_ARM, _beyond
from flangeye.handeye.candidates import Model
from flangeye.handeye.components import Noise
from flangeye.handeye.consensus import Consensus
from flangeye.handeye.likelihood import first_noise
from flangeye.handeye.loop import ArmNoise, LoopProblem
from flangeye.handeye.target_size import EstimatedFactor
from flangeye.maths.statistics import covariance_inflation
from tests.handeye.cells import CONFIGURATIONS, Session, fitted, given, session, two_numbers

HAND = "eye-in-hand, marker"


@pytest.mark.parametrize(
    ("are_poses", "normals", "told"),
    [
        (True, False, ["noise beyond the features' own: 5.000 mm and 0.500 deg per axis"]),
        (False, True, ["noise beyond the centres' own: 5.000 mm per axis",
                       "noise beyond the normals' own: 0.500 deg per axis"]),
        (False, False, ["noise beyond the centres' own: 5.000 mm per axis"]),
    ],
)  # fmt: skip
def test_noise_beyond_the_features_own_is_the_arms_and_what_else_there_is(
    are_poses: bool, normals: bool, told: list[str]
) -> None:
    """Their variances add up: the arms' by their share, and of that in depth a third an axis."""
    turn, shift = 2 * np.radians(0.3) ** 2, 2 * 3e-3**2
    of_arm = np.diag([0.5 * turn, turn, 1.5 * turn, 0.8 * shift, 1.3 * shift, 0.9 * shift])
    noise = Noise(pose=3.5**2 * 1e-6, tilt=np.radians(0.4) ** 2, arms=0.5, depth=3 * 3.75e-6)
    found: Any = SimpleNamespace(
        linear=SimpleNamespace(of_arms=np.tile(of_arm, (4, 1, 1))), noise=noise
    )
    measurements = SimpleNamespace(are_poses=are_poses, has_normal=np.full(4, normals))
    problem: Any = SimpleNamespace(measurements=measurements, arms=None)
    assert _beyond(found, problem) == told


def test_noise_that_is_stated_is_all_there_is_from_the_start() -> None:
    stated: Any = SimpleNamespace(stated=True)
    nowhere: Any = None
    assert first_noise(stated, nowhere) == Noise(pose=0.0, tilt=0.0)


def modelled(name: str = HAND, n: int = 9, **more: Any) -> Model:
    problem = given(name, "pose", n, **{"stated": False, **more})
    return Model(Consensus(problem, fitted(problem)))


def test_what_differs_from_pose_to_pose_is_the_arms_and_what_was_found_beyond(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In depth a third an axis; of few degrees of freedom, and understated, the more unknown."""
    monkeypatch.setattr(calibration, "understated", lambda _: 1.5)
    found = modelled().found
    of_arms = np.tile(np.diag([9.0, 9.0, 9.0, 1e-8, 2e-8, 6e-8]), (9, 1, 1))
    noise = Noise(pose=4e-8, tilt=9.0, centre_scale=0.8, arms=0.5, depth=6e-8)
    found = replace(found, noise=noise, linear=replace(found.linear, of_arms=of_arms), freedom=10.0)
    told = calibration._scatter(found)
    assert told.arm == pytest.approx(0.5 * 3e-8 + 4e-8 + 2e-8) and told.feature_scale == 0.8
    assert told.widening == pytest.approx(1.5 * covariance_inflation(10.0, 3))
    assert calibration._scatter(replace(found, freedom=np.inf)).widening == 1.5


def test_poses_set_aside_are_told_with_their_distance_turn_and_sigma() -> None:
    fit = modelled("eye-on-base, marker")
    found = fit.found
    residuals = np.zeros((9, 6))
    residuals[2] = [np.radians(0.3), 0, np.radians(0.4), 3e-3, 0, 4e-3]
    found = replace(
        found, inliers=np.arange(9) != 2, squares=np.full(9, 49.0),
        linear=replace(found.linear, residuals=residuals),
    )  # fmt: skip
    fit = replace(fit, consensus=replace(fit.consensus, found=found))
    cell: Any = SimpleNamespace(observations=list("abcdefghi"))
    pairs = calibration._pairs(fit, fit, cell)
    assert pairs[2].reason == "residual 5.0 mm and 0.5 deg, 7 sigma" and not pairs[2].used
    assert [p.reason for p in pairs if p.used] == [None] * 8
    np.testing.assert_allclose(pairs[2].residual, fit.residuals()[2])
    s = fit.problem.measurements
    circles = replace(fit.problem, measurements=replace(s, freedoms=np.full(9, 5.0)))
    fit = replace(fit, consensus=replace(fit.consensus, problem=circles))
    assert calibration._pairs(fit, fit, cell)[2].reason == "residual 5.0 mm, 7 sigma"


def test_the_time_between_clocks_is_told_with_which_was_first() -> None:
    cell: Any = SimpleNamespace(delay=12e-3, flange=True)
    told = "the flange was at the poses {} ms {} the times they are paired by"
    assert calibration._clock_told(cell, 3e-3, 0.5e-3) == told.format("15.0 +- 0.5", "after")
    assert calibration._clock_told(cell, -20e-3, 1e-3) == told.format("8.0 +- 1.0", "before")
    by_link: Any = SimpleNamespace(delay=12e-3, flange=None)
    assert calibration._clock_told(by_link, 0.0, 1e-3).startswith("the arm was at the poses 12.0")
    cell.delay = None
    assert calibration._clock_told(cell, -2e-3, 1e-3) == told.format("2.0 +- 1.0", "before")
    fit = modelled(nuisance=replace(two_numbers(9), mean=np.zeros(2)))
    at, sigma = calibration._delay_of(fit)
    assert at == fit.found.at.nuisance[0]
    assert sigma == pytest.approx(np.sqrt(np.diag(np.linalg.inv(fit.found.information))[-2]))


def test_more_noise_in_depth_is_looked_for_of_whole_poses_whose_noise_is_not_stated() -> None:
    fit = modelled()
    assert calibration._with_depth(fit).problem.in_depth
    stated = modelled(stated=True)
    assert calibration._with_depth(stated) is stated
    circles = given("eye-on-base, flange", "normal", 9, stated=False)
    of_circles = Model(Consensus(circles, fitted(circles)))
    assert calibration._with_depth(of_circles) is of_circles


def test_what_no_pose_tells_is_set_so_that_the_camera_has_none_of_it() -> None:
    """And the covariance is of the rest, as a fit has it that keeps to it."""
    fit = modelled()
    weak = np.zeros((20, 1))
    weak[[3, 4, 15]] = np.array([[0.6], [0.5], [0.4]])
    weak /= np.linalg.norm(weak)
    moved = calibration._without(fit, weak)
    along = weak[3:6, 0]
    assert along @ moved.found.at.x[:3, 3] == pytest.approx(0.0, abs=1e-12)
    step = (moved.found.at.x[:3, 3] - fit.found.at.x[:3, 3]) @ along / (along @ along)
    assert moved.found.at.z[:3, 3] - fit.found.at.z[:3, 3] == pytest.approx(step * weak[15:18, 0])
    rest = np.linalg.svd(fit.found.basis - weak @ (weak.T @ fit.found.basis))[0][:, :11]
    information = rest[:18].T @ _whole(fit) @ rest[:18]
    expected = rest @ np.linalg.inv(information) @ rest.T
    assert moved.found.covariance == pytest.approx(expected, rel=1e-5, abs=1e-16)


def _whole(fit: Model) -> Any:
    basis = fit.found.basis[:18]
    return basis @ fit.found.information @ basis.T


class Stating:
    """What is stated of a fit by arms of which this or that is known."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.fit, self.options = modelled(), SimpleNamespace(joint_zeros=True)
        self.own, self.zeros = calibration._covariance(self.fit), 1e-6 * np.eye(18)
        self.worse = calibration._inflation(self.fit) * self.own
        self.sizes = SimpleNamespace(expected=np.array([7.0, 1.0]))
        monkeypatch.setattr(calibration, "unknown_zeros", lambda model, flange: self.zeros)
        monkeypatch.setattr(
            calibration, "with_arm_errors", lambda model, arms, by: (by * self.own, self.sizes)
        )

    def __call__(
        self, kinematics: Any, joints: Any = 1, default: bool = True, weak: int = 0, robot: Any = 1
    ) -> Any:
        """Return the covariance and the notes; what is stated of scatter has zeros at most."""
        flange = SimpleNamespace(kinematics=kinematics, deviation=2e-4, some_joints=joints)
        kind, options = SimpleNamespace(is_default=default), self.options
        cell: Any = SimpleNamespace(flange=flange, arms=[[flange]], robot=robot, configuration=kind)
        stated = calibration._stated(self.fit, cell, cast(Any, options), np.zeros((20, weak)))
        considered = joints and kinematics and default and options.joint_zeros
        of_scatter = self.own + self.zeros if considered else self.own
        np.testing.assert_array_equal(stated.of_scatter, of_scatter)
        return stated.covariance, *stated.notes


def test_whether_the_arms_errors_are_in_the_covariance_is_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told = Stating(monkeypatch)
    for robot, arm, where in ((1, "second arm", "second_robot"), (None, "arm", "robot")):
        covariance, unknown = told(None, robot=robot)
        assert unknown == (
            f"what the {arm} does wrong alike at all poses is not in the covariance, for its "
            f"kinematics are not known: name them in the recipe ({where}: model, or urdf)"
        )
        np.testing.assert_array_equal(covariance, told.own)
    for default in (True, False):
        covariance, missed = told(1, None, default)
        assert missed == (
            "unknown joint zeros (0.2 mrad each) not considered: the arm's model misses these poses"
        )
        np.testing.assert_array_equal(covariance, told.own)
    covariance, sized = told(1, default=False)
    assert "joint zeros of about 1.4 mrad, and encoders" in sized
    np.testing.assert_array_equal(covariance, told.worse)
    (covariance,) = told(1, default=False, weak=1)
    np.testing.assert_array_equal(covariance, told.own)


def test_what_no_pose_tells_leaves_a_flange_seen_from_the_base_the_zeros_of_its_file(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told = Stating(monkeypatch)
    covariance, known = told(1, weak=1)
    assert known == (
        "unknown joint zeros (0.2 mrad each) are in the covariance: they move all poses alike, "
        "which held-out errors do not show"
    )
    np.testing.assert_array_equal(covariance, told.own + told.zeros)
    covariance, sized = told(1)
    assert "joint zeros of about 1.4 mrad, and encoders" in sized
    np.testing.assert_array_equal(covariance, told.worse)


def test_nothing_is_said_of_arms_where_they_are_ignored_or_there_are_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told = Stating(monkeypatch)
    none: Any = SimpleNamespace(arms=[], flange=None)
    options: Any = told.options
    assert calibration._stated(told.fit, none, options, np.zeros((20, 0))).notes == ()
    options.joint_zeros = False
    for kinematics in (None, 1):
        (covariance,) = told(kinematics)
        np.testing.assert_array_equal(covariance, told.own)


def test_what_is_stated_of_noise_goes_into_the_problem() -> None:
    """Standard deviations as variances; a typical arm where nothing is said of it."""
    made = session(CONFIGURATIONS[HAND], np.random.default_rng(0), 5)
    circles = session(
        CONFIGURATIONS["eye-on-base, flange"], np.random.default_rng(0), 5, feature="normal"
    )
    options: Any = SimpleNamespace(
        normals=True, normal_bias=1e-3, robot_noise=None, pose_noise=None
    )

    def problem(of: Session) -> LoopProblem:
        cell: Any = SimpleNamespace(
            observations=of.observations, configuration=of.configuration, arm=None
        )
        return calibration._problem(cell, options)

    assert problem(made).arms == TYPICAL_ARM and problem(made).tilt == 1e-3
    assert problem(made).pose_noise is None and not problem(made).stated
    assert problem(circles).arms is None
    options.pose_noise, options.robot_noise = 3e-4, ArmNoise(1e-4, 2e-4)
    assert problem(made).pose_noise == pytest.approx(9e-8)
    assert problem(made).stated and problem(circles).arms == ArmNoise(1e-4, 2e-4)
    assert problem(circles).measurements.have_normals
    options.normals = False
    assert not problem(circles).measurements.have_normals


@pytest.mark.parametrize(
    ("name", "numbers"),
    [("eye-on-base, flange", 6), (HAND, 12), ("two arms, flange", 12), ("two arms, marker", 18)],
)
def test_a_covariance_is_wider_by_what_its_noise_is_not_known(name: str, numbers: int) -> None:
    fit = modelled(name)
    fit = replace(fit, consensus=replace(fit.consensus, found=replace(fit.found, freedom=9.0)))
    wider = covariance_inflation(9.0, numbers)
    assert calibration._inflation(fit) == pytest.approx(wider)
    assert calibration._covariance(fit) == pytest.approx(wider * fit.found.covariance[:18, :18])


def test_errors_that_all_features_share_are_part_of_the_model() -> None:
    """Of features with fewer such errors the others do nothing; moves of weak ones do neither."""
    made = session(CONFIGURATIONS[HAND], np.random.default_rng(3), 9)
    rng = np.random.default_rng(4)
    shared = [1e-4 * rng.normal(size=(6, 2 if i % 2 else 1)) for i in range(9)]
    observations = [
        replace(o, feature=replace(o.feature, shared=s))
        for o, s in zip(made.observations, shared, strict=True)
    ]
    fit, weak = modelled(), np.ones((20, 1))
    cell: Any = SimpleNamespace(observations=observations)
    moved, wider = calibration._with_shared(fit, cell, weak)
    seen = moved.problem.nuisance.seen
    for each, own in zip(seen, shared, strict=True):
        assert each[:, : own.shape[1]] == pytest.approx(own)
        assert not each[:, own.shape[1] :].any()
    assert moved.problem.nuisance.prior.tolist() == [1.0, 1.0]
    assert wider.tolist() == [[1.0]] * 20 + [[0.0]] * 2
    none: Any = SimpleNamespace(observations=made.observations)
    assert calibration._with_shared(fit, none, weak) == (fit, weak)


def sized_by(
    told: list[tuple[float, float]], monkeypatch: pytest.MonkeyPatch
) -> tuple[list[float], Callable[[float], tuple[Any, Model]]]:
    """Return the factors by which a cell is resized, and what finds its size by what is told."""
    factors, left = list[float](), iter(told)
    fit = modelled()

    class Resized(SimpleNamespace):
        def resized(self, factor: float) -> Any:
            factors.append(factor)
            return self

    def factor(*_: Any) -> Any:
        share, sigma = next(left)
        return EstimatedFactor(share, sigma, np.inf)

    monkeypatch.setattr(calibration, "estimated_factor", factor)
    monkeypatch.setattr(calibration, "_agreed", lambda *_: fit)
    cell: Any = Resized()
    some: Any = None
    return factors, lambda size: calibration._with_size(cell, fit, some, size)


def test_a_size_is_found_by_steps_until_one_changes_it_by_a_millionth(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    factors, find = sized_by([(0.1, 2e-3), (-0.01, 2e-3), (0.9e-6, 1e-3), (9.0, 1e-3)], monkeypatch)
    (note,) = find(0.5)[1].notes
    assert factors == pytest.approx([1.1, 0.99, 1.0], abs=1e-5)
    size = 0.5 * 1.1 * 0.99
    assert note.startswith(f"by the arm's own motion the target is {size:.5f} +- 0.00054 times as")
    factors, find = sized_by([(1.1e-6, 1e-6)] * 20, monkeypatch)
    (note,) = find(1.0)[1].notes
    assert len(factors) == 10 and "is 1.0000110 +- 0.0000010 times as large" in note


@pytest.mark.parametrize(
    ("share", "sigma", "told"),
    [(0.0, 0.101, "10.1%"), (0.0, 0.099, None), (-0.91, 0.01, "1.0%"), (-0.89, 0.01, None),
     (9.1, 0.02, "2.0%"), (8.9, 0.02, None)],
)  # fmt: skip
def test_a_size_that_is_not_told_to_a_tenth_or_beyond_ten_times_is_refused(
    share: float, sigma: float, told: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, find = sized_by([(share, sigma), *[(0.0, sigma)] * 2], monkeypatch)
    if told is None:
        assert len(find(1.0)[1].notes) == 1
        return
    with pytest.raises(CalibrationRefused, match=f"the target's size is told to {told} only"):
        find(1.0)


def test_what_was_found_is_noted_and_what_no_pose_tells_is_counted() -> None:
    fit = modelled()
    plain: Any = SimpleNamespace(
        observations=list("abcdefghi"), configuration=SimpleNamespace(is_default=True)
    )
    for count, said in ((1, "1 translation along"), (2, "2 translations along")):
        notes = calibration._noise_notes(fit, plain, np.zeros((20, count)))
        assert notes[-1].startswith(f"not observable from these poses, and set to zero: {said}")
    (alone,) = calibration._noise_notes(fit, plain, np.zeros((20, 0)))
    assert alone.startswith("noise beyond the features' own")
    assert calibration._noise_notes(modelled(stated=True), plain, np.zeros((20, 0))) == ()


class Clocked(SimpleNamespace):
    """A cell whose arm was recorded for so long [s]."""

    def unknown_delay(self) -> Any:
        return "delay"

    def delayed(self, by: float) -> Any:
        total = (self.delay or 0.0) + by
        return None if abs(total) > self.reach else replaced(self, delay=total)


def replaced(of: Any, **new: Any) -> Any:
    return Clocked(**vars(of) | new)


def on_one_clock(
    told: list[tuple[float, float]], monkeypatch: pytest.MonkeyPatch, helps: bool = True
) -> tuple[Any, Any, Model]:
    """Return cell and model that are taken, and the model without, where such delays are told."""
    fit, left = modelled(), iter(told)
    fit = replace(fit, consensus=replace(fit.consensus, found=replace(fit.found, freedom=20.0)))
    monkeypatch.setattr(calibration, "replace", replaced)
    monkeypatch.setattr(calibration, "with_nuisance", lambda *_: modelled_as(fit))
    monkeypatch.setattr(calibration, "_agreed", lambda *_: modelled_as(fit))
    monkeypatch.setattr(calibration, "_delay_of", lambda _: next(left))
    monkeypatch.setattr(
        calibration, "better", lambda m, other, what: (other if helps else m).noted(what)
    )
    options: Any = None
    cell: Any = Clocked(delay=None, flange=True, reach=0.05, clock_deviation=0.0)
    return *calibration._with_clock(cell, fit, options), fit


def modelled_as(fit: Model) -> Model:
    return Model(Consensus(fit.problem, replace(fit.found)))


def test_a_delay_counts_beyond_what_chance_gives_once_in_ten_thousand(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One that does not is left in the covariance, as large as it may be."""
    limit = np.sqrt(stats.f(1, 20).ppf(0.9999)) * 1e-3
    cell, model, fit = on_one_clock([(0.99 * limit, 1e-3)], monkeypatch)
    assert model is fit and cell.delay is None
    assert cell.clock_deviation == pytest.approx(np.hypot(0.99 * limit, 1e-3))
    cell, model, _ = on_one_clock([(1.01 * limit, 1e-3), (0.0, 1e-3)], monkeypatch)
    assert cell.delay == pytest.approx(1.01 * limit) and cell.clock_deviation == 0.0
    assert model.notes[0].startswith("the flange was at the poses ")


def test_a_delay_is_found_by_steps_and_taken_where_it_helps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    steps = [(0.02, 1e-3), (-0.003, 1e-3), (0.9e-5, 2e-3), (9.0, 1e-3)]
    cell, model, _ = on_one_clock(steps, monkeypatch)
    assert cell.delay == pytest.approx(0.017)
    assert model.notes == (
        "the flange was at the poses 17.0 +- 2.0 ms after the times they are paired by",
    )
    cell, _, _ = on_one_clock([(0.004, 1e-4)] * 20, monkeypatch)
    assert cell.delay == pytest.approx(6 * 0.004)
    cell, model, fit = on_one_clock(steps, monkeypatch, helps=False)
    assert cell.delay is None and model.found is fit.found
    assert cell.clock_deviation == pytest.approx(np.hypot(0.02, 1e-3))
    cell, model, _ = on_one_clock([(0.04, 1e-3), (0.02, 1e-3)], monkeypatch)
    assert cell.delay is None and model.notes[0].startswith("left out: the flange was at the poses")
    assert "60.0 +- 1.0 ms after" in model.notes[0]

"""What most measurements agree on: what is left out of them, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.errors import CalibrationRefused, StageError
from flangeye.handeye import consensus
from flangeye.handeye.consensus import (
    _cost,
    _distances,
    _require_agreement,
    _require_half,
    _require_majority,
    _require_right_handed,
    find_consensus,
    plausible,
    spread,
    targets_of,
)
from flangeye.handeye.inliers import gate
from flangeye.handeye.likelihood import Solution, first_noise
from flangeye.handeye.loop import LoopProblem, linearise
from flangeye.handeye.unknowns import Unknowns
from flangeye.maths.geometry import hat, rotation_exp, rotation_log
from flangeye.maths.statistics import chi2_quantile
from flangeye.types import Floats, HandEye, Observation
from flangeye_plugins.solve.robust import RobustParams, solve_poses
from tests.handeye import cells
from tests.handeye.cells import CONFIGURATIONS, ISSUE, ROBOT, errors, fitted, session, with_wrong

FLANGE = CONFIGURATIONS["eye-on-base, flange"]
MADE = session(FLANGE, np.random.default_rng(5), n=20, feature="normal")
TURNED = "the measured normals stand {} deg from the robot's flange axis"


def solved(observations: list[Observation]) -> HandEye:
    return solve_poses(observations, RobustParams(), ROBOT, FLANGE)


def with_normals(turned: Callable[[int, Floats], Floats]) -> list[Observation]:
    """Return the session, each normal turned."""
    out = []
    for i, o in enumerate(MADE.observations):
        feature: Any = o.feature
        normal = turned(i, feature.normal)
        size = np.trace(feature.normal_covariance) / 2
        across = -size * hat(normal) @ hat(normal)
        out.append(replace(o, feature=replace(feature, normal=normal, normal_covariance=across)))
    return out


def tilted(normal: Floats, degrees: float) -> Floats:
    """Return a normal turned about an axis across it."""
    across = np.cross(normal, [1.0, 0.0, 0.0])
    axis = across / np.linalg.norm(across)
    return np.asarray(rotation_exp(np.radians(degrees) * axis) @ normal)


def off(found: HandEye) -> float:
    """Return how far the camera is from the truth, in squared standard deviations."""
    error = errors(found.camera, MADE.truth["base_T_camera"])
    return float(error @ np.linalg.solve(found.camera.covariance, error))


def test_normals_that_disagree_are_left_out_and_their_centres_are_not() -> None:
    bad = with_normals(lambda i, n: tilted(n, 6.0) if i in (3, 11) else n)
    found = solved(bad)
    assert "normals left out, for they disagree with the others: 2" in found.notes
    assert all(pair.used for pair in found.pairs)
    assert off(found) < 20.0
    assert not [n for n in solved(MADE.observations).notes if "left out, for they" in n]


def test_normals_that_all_point_inwards_are_left_out() -> None:
    found = solved(with_normals(lambda i, n: -n))
    (note,) = [n for n in found.notes if n.startswith(TURNED.format(180))]
    assert "so they are left out: check the orientation of the poses" in note
    assert off(found) < 20.0


@pytest.mark.parametrize(("degrees", "refused"), [(9.0, False), (12.0, True), (90.0, True)])
def test_normals_that_all_stand_elsewhere_are_a_mistake_of_the_poses(
    degrees: float, refused: bool
) -> None:
    turned = with_normals(lambda i, n: tilted(n, degrees))
    if not refused:
        assert not [n for n in solved(turned).notes if "flange axis" in n]
        return
    with pytest.raises(CalibrationRefused, match=TURNED.format(round(degrees))):
        solved(turned)


def test_half_of_the_poses_have_to_agree_and_three_of_them_at_least() -> None:
    for agreeing, given in ((3, 6), (3, 3), (5, 10)):
        _require_half(np.arange(given) < agreeing, 1e-3)
    for agreeing, given in ((2, 4), (3, 7), (4, 10)):
        told = f"only {agreeing} of {given} poses agree with one camera pose \\(to 1.50 mm per axis"
        with pytest.raises(CalibrationRefused, match=told):
            _require_half(np.arange(given) < agreeing, 1.5e-3)


def test_noise_is_less_than_a_fifth_of_the_poses_extent() -> None:
    """Corners of a box of 0.2 m, so far from its middle as its half diagonal is long."""
    corners = 0.1 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    places, extent = corners + [0.4, -0.2, 0.7], 0.1 * np.sqrt(3)
    _require_agreement(places, 0.199 * extent)
    with pytest.raises(CalibrationRefused, match=r"to 34.8 mm per axis only, and lie 173 mm from"):
        _require_agreement(places, 0.201 * extent)


HAND = "eye-in-hand, marker"
EXACT = ISSUE.scaled(0.0)


def exactly(name: str = HAND, feature: str = "pose", n: int = 8) -> tuple[LoopProblem, Solution]:
    """Return a problem of exact measurements, and its answer."""
    problem = cells.given(name, feature, n, EXACT, stated=False)
    return problem, fitted(problem)


def off_by(found: Solution, turn: float, shift: float) -> Solution:
    """Return the answer with all residuals of so many radians and metres."""
    axes = np.random.default_rng(4).normal(size=(2, len(found.inliers), 3))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    left = np.concatenate([turn * axes[0], shift * axes[1]], axis=1)
    return replace(found, linear=replace(found.linear, residuals=left))


def test_how_well_poses_agree_is_the_root_mean_square_of_those_that_do() -> None:
    found = off_by(exactly()[1], 0.02, 3e-3)
    assert spread(found) == pytest.approx((3e-3, 0.02))
    left = found.linear.residuals * np.where(np.arange(8) < 5, 1.0, 9.0)[:, None]
    of_five = replace(found, linear=replace(found.linear, residuals=left), inliers=np.arange(8) < 5)
    assert spread(of_five) == pytest.approx((3e-3, 0.02))
    assert spread(replace(found, inliers=np.zeros(8, dtype=bool))) == (np.inf, np.inf)


@pytest.mark.parametrize("size", [0.5, 20.0])
def test_scans_of_other_poses_agree_no_better_than_a_share_of_the_poses_extent(size: float) -> None:
    """2 cm and 5 deg, or two fifths of how far places and turns differ."""
    problem, found = exactly()
    rng, s = np.random.default_rng(0), problem.measurements
    turns = rotation_exp(np.radians(size) * rng.normal(size=(8, 3))) @ s.rotations[0]
    problem = replace(problem, measurements=replace(s, centres=size * s.centres, rotations=turns))
    extent = np.sqrt(problem.measurements.centres.var(axis=0).sum())
    turned = np.sqrt(rotation_log(turns @ turns[0].T).var(axis=0).sum())
    limits = max(np.radians(5.0), 0.4 * turned), max(0.02, 0.4 * extent)
    for k, share in ((0, 0.99), (0, 1.01), (1, 0.99), (1, 1.01)):
        sizes = [0.5 * limits[0], 0.5 * limits[1]]
        sizes[k] = share * limits[k]
        assert plausible(problem.measurements, off_by(found, *sizes)) == (share < 1)


def test_a_start_that_is_off_is_that_far_off_and_speaks_for_as_much_noise() -> None:
    """A turn of the camera in the hand turns all that it sees; a degree weighs like 5 mm."""
    problem, found = exactly()
    shifted = found.at.moved(np.append(np.zeros(3), [1e-3, -2e-3, 2e-3, *np.zeros(14)]))
    assert _distances(problem, shifted) == pytest.approx(np.full(8, 9e-6), rel=1e-6)
    turned = found.at.moved(np.append([2e-3, -1e-3, 2e-3], np.zeros(17)))
    moved = linearise(problem.measurements, problem.loop, turned, None).residuals[:, 3:]
    expected = (0.3 * 3e-3) ** 2 + (moved**2).sum(axis=1)
    assert _distances(problem, turned) == pytest.approx(expected, rel=1e-6)
    median = chi2_quantile(0.5, 3)
    noise = first_noise(problem, turned)
    assert noise.tilt == pytest.approx(9e-6 / median, rel=1e-6)
    assert noise.pose == pytest.approx(np.median((moved**2).sum(axis=1)) / median)
    stated = first_noise(replace(problem, stated=True), turned)
    assert (stated.pose, stated.tilt) == (0.0, 0.0)


def test_of_two_answers_the_better_half_counts_and_the_others_as_far_as_they_agree() -> None:
    problem, found = exactly()
    own = problem.measurements.covariances[0]
    known = np.diag(own) + 1e-8 + 1e-14
    left = np.zeros((8, 6))
    left[:, 3] = np.sqrt(known[3]) * np.array([1.0, 2, 3, 4, 5, 6, 7, 100])
    off = replace(
        found, linear=replace(found.linear, residuals=left, of_arms=0 * found.linear.of_arms)
    )
    np.testing.assert_allclose(problem.measurements.covariances, np.tile(own, (8, 1, 1)))
    limit = chi2_quantile(gate(8), 6)
    squares = np.array([1.0, 4, 9, 16, 25, 36, 49, 10000])
    assert _cost(problem, off) == pytest.approx(
        squares[:5].sum() + np.minimum(squares / limit, 1).sum()
    )


def test_small_sets_are_tried_where_not_all_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seven of ten have to, and be plausible; then the cheaper answer is taken."""
    problem, found = exactly(n=10)
    costs = {0.6: 5.0, 0.7: 1.0, 0.8: 3.0}
    monkeypatch.setattr(consensus, "_cost", lambda _, s: costs[round(float(s.inliers.mean()), 1)])
    monkeypatch.setattr(consensus, "plausible", lambda *_: True)

    def agreeing(count: int) -> Solution:
        return replace(found, inliers=np.arange(10) < count)

    for first, others, wanted in ((7, 8, 7), (6, 8, 8), (6, 7, 7), (6, None, 6), (None, 8, 8)):
        one, more = (None if n is None else agreeing(n) for n in (first, others))
        monkeypatch.setattr(consensus, "_from_all", lambda *_, one=one: one)
        monkeypatch.setattr(consensus, "_from_subsets", lambda *_, more=more: more)
        assert find_consensus(problem, 1.0).found.inliers.sum() == wanted
    monkeypatch.setattr(consensus, "_from_all", lambda *_: None)
    monkeypatch.setattr(consensus, "_from_subsets", lambda *_: None)
    with pytest.raises(CalibrationRefused, match="no closed form gives a start for these poses"):
        find_consensus(problem, 1.0)


def test_the_set_that_explains_the_better_half_is_begun_with() -> None:
    """Four of eleven are wrong: a fit to all begins nowhere, one to four good ones at the answer."""
    problem, found = exactly(n=11)
    spoilt, wrong = with_wrong(problem, 4)
    again = consensus._from_subsets(spoilt, np.random.default_rng(0))
    assert again is not None and (again.inliers == ~wrong).all()
    assert again.at.x == pytest.approx(found.at.x, abs=1e-6)


def test_a_mirror_that_leaves_a_tenth_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, found = exactly()
    rng = np.random.default_rng(0)
    ours = np.array([1.0, 4.0, 100.0, 4.0, 2.0]) * 1e-4
    monkeypatch.setattr(consensus, "plausible", lambda *_: False)
    monkeypatch.setattr(consensus, "_from_all", lambda *_: found)
    for share in (0.0099, 0.0101):

        def distances(of: LoopProblem, _: Unknowns, share: float = share) -> Floats:
            return ours if of is problem else share * ours

        monkeypatch.setattr(consensus, "_distances", distances)
        if share > 0.01:
            _require_right_handed(problem, found, rng)
            continue
        with pytest.raises(StageError, match=r"only when mirrored \(2.0 mm instead of 20.0 mm\)"):
            _require_right_handed(problem, found, rng)
    monkeypatch.setattr(consensus, "_from_all", lambda *_: None)
    _require_right_handed(problem, found, rng)


def test_a_majority_has_to_agree_and_well(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, found = exactly()
    for agree, of, enough in (
        (3, 5, True),
        (3, 6, True),
        (3, 7, False),
        (2, 4, False),
        (2, 3, False),
    ):
        one = replace(off_by(found, 1e-3, 1e-3), inliers=np.arange(8)[:of] < agree)
        one = replace(one, linear=one.linear.where(np.arange(8) < of))
        if enough:
            _require_majority(problem, one)
            continue
        with pytest.raises(
            CalibrationRefused, match=f"only {agree} of {of} poses agree with one an"
        ):
            _require_majority(problem, one)
    bad = off_by(found, np.radians(80.0), 0.345)
    with pytest.raises(CalibrationRefused, match="one answer to 345.0 mm and 80.0 deg only: check"):
        _require_majority(problem, bad)


@pytest.mark.parametrize("feature", ["normal", "centre"])
def test_points_begin_at_the_answer_with_the_noise_of_their_normals(feature: str) -> None:
    problem, found = exactly("eye-on-base, flange", feature)
    places, axes = targets_of(problem)
    s, x = problem.measurements, found.at.x
    assert s.centres @ x[:3, :3].T + x[:3, 3] == pytest.approx(places, abs=1e-9)
    some, sigma = np.arange(8) != 5, 2e-4
    begun = consensus._start(problem, (places, axes), some, sigma)
    assert begun.at.x == pytest.approx(x, abs=1e-9) and (begun.inliers == some).all()
    own = np.trace(s.covariances[:, :3, :3], axis1=1, axis2=2)[some].mean() / 2
    assert begun.noise.pose == pytest.approx(4e-8)
    assert begun.noise.tilt == pytest.approx(own + 4e-6)
    known = consensus._start(replace(problem, pose_noise=9e-8), (places, axes), some, sigma)
    assert known.noise.pose == 9e-8
    stated = consensus._start(replace(problem, stated=True), (places, axes), some, sigma)
    assert (stated.noise.pose, stated.noise.tilt) == (0.0, 0.0)
    # Normals count by their noise beside the centres': those of a frame 5 deg off, a little.
    if feature == "normal":
        assert s.rotations[:, :, 2] @ x[:3, :3].T == pytest.approx(axes, abs=1e-9)
        tilt = rotation_exp(np.array([0.0, 0.0, 1e-3]))
        off = consensus._start(problem, (places, axes @ tilt.T), some, sigma)
        lever = places[some] - places[some].mean(axis=0)
        turns = rotation_log((off.at.x[:3, :3] @ x[:3, :3].T)[None])[0]
        of_places = ((lever**2).sum() * np.eye(3) - lever.T @ lever) / 4e-8
        of_axes = (7 * np.eye(3) - axes[some].T @ axes[some]) / (own + 4e-6)
        wanted = np.linalg.solve(of_places + of_axes, of_axes @ [0, 0, 1e-3])
        assert turns == pytest.approx(wanted, rel=1e-2, abs=1e-7)


def test_the_noise_that_a_rotation_is_refused_with_is_the_centres_and_the_arms(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, found = exactly("eye-on-base, flange", "normal")
    rows = 1e-4 * np.random.default_rng(2).normal(size=(8, 6, 7))
    s = replace(problem.measurements, covariances=rows @ rows.transpose(0, 2, 1))
    problem = replace(problem, measurements=s)
    places, axes = targets_of(problem)
    seen: list[Any] = []
    monkeypatch.setattr(consensus, "require_observable", lambda *told: seen.append(told))
    noise = replace(found.noise, pose=4e-8, centre_scale=0.5)
    some = np.arange(8) > 2
    consensus._require_rotation(
        problem, replace(found, noise=noise, inliers=some), places, axes, 0.1
    )
    ((tcps, used, information, told, limit),) = seen
    own = np.trace(problem.measurements.covariances[3:, 3:, 3:], axis1=1, axis2=2).mean() / 3
    assert told == pytest.approx(np.sqrt(0.5 * own + 4e-8)) and limit == 0.1
    np.testing.assert_array_equal(tcps, places[3:])
    np.testing.assert_array_equal(used, axes[3:])
    assert information is found.information


def test_small_sets_are_sixty_of_one_more_than_a_start_needs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """That counts of which the middle one is nearest; sets without an answer are passed over."""
    problem, found = exactly(n=9)
    asked, medians = list[int](), iter([np.nan, 5.0, 3.0, 4.0, *[6.0] * 60])

    def begun(s: Any, loop: Any, rng: Any, restarts: int) -> Unknowns:
        asked.append(len(s))
        if len(asked) == 1:
            raise CalibrationRefused("nothing")
        if len(asked) == 2:
            raise np.linalg.LinAlgError
        return replace(found.at, tilt=np.array([len(asked), 0.0]))

    monkeypatch.setattr(consensus, "start_of", begun)
    monkeypatch.setattr(
        consensus, "_distances", lambda *_: np.array([0.0, 0.0, next(medians), 9, 9])
    )
    monkeypatch.setattr(consensus, "settle", lambda problem, start, noise: (start, noise))
    taken: Any = consensus._from_subsets(problem, np.random.default_rng(0))
    start, noise = taken
    assert asked == [4] * 60 and start.tilt[0] == 5
    assert noise == first_noise(problem, start)
    asked.clear()
    three = problem.where(np.arange(9) < 3)
    monkeypatch.setattr(consensus, "_distances", lambda *_: np.full(3, np.inf))
    assert consensus._from_subsets(three, np.random.default_rng(0)) is None
    assert asked == [3] * 60


def test_normals_that_disagree_alone_are_left_out_of_those_whose_centres_agree(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, found = exactly("eye-on-base, flange", "normal")
    every = consensus._without_bad_normals(problem, replace(found, inliers=np.ones(8, dtype=bool)))
    assert every[0] is problem and every[2] == 0
    some = replace(found, inliers=np.arange(8) >= 3)
    again = replace(found, inliers=np.arange(8) >= 1)
    monkeypatch.setattr(consensus, "agreeing", lambda *_: again)
    without, fit, dropped = consensus._without_bad_normals(problem, some)
    assert without.measurements.has_normal.tolist() == [False] * 3 + [True] * 5
    assert fit is again and dropped == 2

"""``verify.touch``, ``verify.stitch``, ``verify.sphere``: what each shows, and what it cannot."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.types.geometry import rigid, rotation_exp, rotation_from_rpy, rpy_from_rotation
from flangeye.units import SI
from flangeye_plugins.verify.drift import DriftParams
from flangeye_plugins.verify.holdout import HoldoutParams
from flangeye_plugins.verify.sphere import BallBar, SphereCheckParams, verify_sphere
from flangeye_plugins.verify.stitch import StitchParams, verify_stitch
from flangeye_plugins.verify.touch import TouchedPoint, TouchParams, verify_touch
from tests.plugins.bounds import check_bound

TRUTH = rigid(rotation_from_rpy(np.pi - 0.2, 0.1, 0.5), np.array([0.5, -0.1, 1.1]))
CENTRE = np.array([0.45, 0.0, 0.4])
TIP = np.array([0.01, -0.02, 0.15])


def poses(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [
        rigid(rotation_from_rpy(*rng.uniform(-0.3, 0.3, 3)), CENTRE + rng.uniform(-0.15, 0.15, 3))
        for _ in range(count)
    ]


def calibration(turn=(0, 0, 0), shift=(0, 0, 0), scale: float = 1.0) -> t.HandEye:
    """A calibration that is off by a motion about the work; a scanner of another scale."""
    turned = rotation_exp(np.array(turn, float))
    move = rigid(turned, CENTRE - turned @ CENTRE + np.array(shift, float))
    camera = t.Transform(t.BASE, t.CAMERA, move @ TRUTH)
    estimate = t.TransformEstimate(camera, 1e-10 * np.eye(6), CENTRE)
    pairs = []
    for i, pose in enumerate(poses(12)):
        seen = scale * (np.linalg.inv(TRUTH) @ pose)[:3, 3]
        circle = t.CircleFeature(seen, None, {}, 1e-9 * np.eye(3), None, 1.0)
        flange = t.by_frame(t.Transform(t.BASE, t.FLANGE, pose))
        pairs.append(t.Pair(t.Observation(f"{i}", circle, flange), np.zeros(3)))
    return t.HandEye(estimate, tuple(pairs), "test")


def touches(count: int = 4) -> TouchParams:
    """Points on the work, touched exactly."""
    made = []
    for pose in poses(count):
        point = pose[:3, :3] @ TIP + pose[:3, 3]
        seen = np.linalg.inv(TRUTH) @ np.append(point, 1.0)
        rpy = [f"{a} rad" for a in rpy_from_rotation(pose[:3, :3])]
        made.append(TouchedPoint(seen=_m(seen[:3]), position=_m(pose[:3, 3]), rpy=tuple(rpy)))
    return TouchParams(tip=_m(TIP), touches=tuple(made))


def _m(values) -> tuple[str, ...]:
    return tuple(f"{v:.12f} m" for v in values)


def views(count: int = 4) -> t.Views:
    rng, out = np.random.default_rng(1), t.Views()
    for i, pose in enumerate(poses(count)):
        radius, angle = 0.03 * np.sqrt(rng.uniform(0, 1, 20000)), rng.uniform(0, 2 * np.pi, 20000)
        disc = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(20000)])
        move = np.linalg.inv(TRUTH) @ pose
        cloud = t.PointCloud(t.CAMERA, (disc @ move[:3, :3].T + move[:3, 3]).astype(np.float32))
        flange = t.FlangeCloud(cloud, move[:3, 3], move[:3, 2])
        out.append(t.VerificationView(f"{i}", flange, t.Transform(t.BASE, t.FLANGE, pose)))
    return out


def test_touch_finds_a_shift_of_the_matrix() -> None:
    right, wrong = (
        verify_touch(calibration(shift=s), touches()) for s in [(0, 0, 0), (2e-3, 0, 0)]
    )
    assert right.passed and right.figures["max"] < 1e-8 and right.figures["explained"] == 1.0
    assert not wrong.passed
    assert wrong.figures["x"] == pytest.approx(2e-3, abs=1e-8)
    assert wrong.figures["explained"] == 0.0
    assert "4 touched points are 2.00 mm off at most, above the limit of 1 mm" in wrong.reason


def test_stitch_finds_a_turn_of_the_matrix_and_draws_it() -> None:
    pictures: dict[str, Any] = {}
    right, wrong = (
        verify_stitch(calibration(turn=a), views(), StitchParams(), stage_log=pictures.__setitem__)
        for a in [(0, 0, 0), (0.05, 0, 0)]
    )
    assert right.passed and right.figures["spread"] < 1e-6
    assert not wrong.passed and wrong.figures["slide"] > 5e-4
    assert pictures["spread"].pixels.shape == (288, 288, 3)


def test_stitch_cannot_see_what_all_views_share() -> None:
    still = t.Views(replace(v, base_T_flange=v.base_T_flange) for v in views(1) * 3)
    found = verify_stitch(calibration(shift=(5e-3, 0, 0)), still, StitchParams())
    assert found.passed  # three views of one pose: the shift is common to them


def test_sphere_finds_a_scale_and_cannot_see_the_matrix() -> None:
    shifted = verify_sphere(calibration(shift=(5e-3, 0, 0)), SphereCheckParams())
    assert shifted.passed and shifted.figures["max"] < 1e-9
    stretched = verify_sphere(calibration(scale=1.01), SphereCheckParams())
    assert not stretched.passed
    assert stretched.figures["scale"] == pytest.approx(0.01, rel=1e-6)


def test_two_balls_at_a_known_distance_show_the_scanners_scale_alone() -> None:
    rng, noise = np.random.default_rng(2), 0.02e-3
    bars, scale = [], 1.0004
    for _ in range(20):
        first = rng.uniform(-0.2, 0.2, 3) + [0, 0, 0.8]
        way = rng.normal(size=3)
        second = first + 0.2 * way / np.linalg.norm(way)
        seen = [_m(scale * ball + rng.normal(0, noise, 3)) for ball in (first, second)]
        bars.append({"first": seen[0], "second": seen[1], "length": "200 mm"})
    drawn: dict[str, Any] = {}
    # The arm is of another scale, which must not matter.
    found = verify_sphere(
        calibration(scale=1.05), SphereCheckParams(bars=bars), stage_log=drawn.__setitem__
    )
    assert found.passed and found.figures["pairs"] == 20
    assert found.figures["scale"] == pytest.approx(
        scale - 1, abs=3 * noise * 2**0.5 / 0.2 / 20**0.5
    )
    assert drawn["comparison"]["series"][""][0][0] == pytest.approx(200.0)


def test_touch_draws_what_was_predicted_less_what_was_touched() -> None:
    drawn: dict[str, Any] = {}
    verify_touch(calibration(shift=(2e-3, 0, 0)), touches(3), stage_log=drawn.__setitem__)
    series = drawn["comparison"]["series"]
    assert [x for x, _ in series["along x"]] == [1, 2, 3]
    assert [y for _, y in series["along x"]] == pytest.approx([2.0] * 3, abs=1e-5)
    assert [y for _, y in series["along z"]] == pytest.approx([0.0] * 3, abs=1e-5)


def test_what_cannot_be_checked_is_one_line() -> None:
    with pytest.raises(StageError, match="1 verification views, two are needed"):
        verify_stitch(calibration(), views(1), StitchParams())
    with pytest.raises(
        StageError, match="0 pairs of poses are 900 mm or more apart, 10 are needed"
    ):
        verify_sphere(calibration(), SphereCheckParams(shortest="900 mm"))


def test_touchs_figures_are_those_of_the_errors() -> None:
    """Four points, of which one was touched 3 mm too low and another 1 mm too far along y."""
    made = list(touches().touches)
    for k, axis, by in ((1, 2, -3e-3), (2, 1, 1e-3)):
        place = [float(x) for x in made[k].position]
        place[axis] += by
        made[k] = made[k].model_copy(update={"position": tuple(place)})
    asked = touches().model_copy(update={"touches": tuple(made)})
    found = verify_touch(calibration(), asked)
    assert found.errors == pytest.approx(
        {"touch 1": 0.0, "touch 2": 3e-3, "touch 3": 1e-3, "touch 4": 0.0}, abs=1e-8
    )
    assert found.figures == pytest.approx(
        {"points": 4, "rms": np.sqrt(10e-6 / 4), "max": 3e-3, "x": 0.0, "y": -0.25e-3,
         "z": 0.75e-3, "explained": 0.5}, abs=1e-8,
    )  # fmt: skip


def test_the_limit_of_a_touch_is_within_it() -> None:
    off = {"seen": ("0 m", "0 m", "1 m"), "position": ("0 m", "0 m", "1 m"), "rpy": ("0 deg",) * 3}
    estimate = t.TransformEstimate(
        t.Transform(t.BASE, t.CAMERA, np.eye(4)), 1e-12 * np.eye(6), np.zeros(3)
    )
    found = [
        verify_touch(
            t.HandEye(estimate, (), "test"),
            TouchParams(tip=("0 m", "0.25 m", "0 m"), touches=(off,), max_error=limit),
        )
        for limit in ("0.25 m", "0.2499 m")
    ]
    assert [each.passed for each in found] == [True, False]


@pytest.mark.parametrize(("sigmas", "explained"), [(2.79, 1.0), (2.80, 0.0)])
def test_what_jogging_and_covariance_allow_is_explained(sigmas: float, explained: float) -> None:
    """The 95 % point of chi squared with three degrees of freedom is 2.795 squared."""
    shift = sigmas * np.sqrt(2e-4**2 + 1e-10)
    found = verify_touch(calibration(shift=(0, shift, 0)), touches(1))
    assert found.figures["explained"] == explained


def test_stitchs_figures_are_those_of_the_views() -> None:
    """Two views of one pose, of which one lies 0.3 mm higher and 0.4 mm aside."""
    (first,) = views(1)
    pose = first.base_T_flange.matrix
    moved = pose @ rigid(np.eye(3), np.array([4e-4, 0.0, 3e-4]))
    second = replace(first, id="1", base_T_flange=t.Transform(t.BASE, t.FLANGE, moved))
    found = verify_stitch(calibration(), t.Views([first, second]), StitchParams())
    assert found.passed and found.figures["views"] == 2
    assert found.errors == pytest.approx({"0": 2e-4, "1": 2e-4}, abs=2e-6)
    assert found.figures["slide"] == pytest.approx(2e-4, abs=2e-6)
    for name in ("spread", "p95", "max"):
        assert found.figures[name] == pytest.approx(3e-4 / np.sqrt(2), abs=2e-6)
    assert found.reason == (
        "2 views spread by 0.212 mm rms in height and 0.200 mm in the plane, within 0.5 mm"
    )


def test_spheres_figures_are_those_of_the_distances() -> None:
    errors = np.array([1e-4, -3e-4, 2e-4, 1e-4])
    bars = [
        {"first": _m((0.0, 0.0, 0.8)), "second": _m((0.2 + e, 0.0, 0.8)), "length": "200 mm"}
        for e in errors
    ]
    drawn: dict[str, Any] = {}
    limit = {"bars": bars, "max_error": "0.2 mm"}
    found = verify_sphere(
        calibration(), SphereCheckParams.model_validate(limit), stage_log=drawn.__setitem__
    )
    assert found.figures == pytest.approx(
        {"pairs": 4, "rms": np.sqrt(np.mean(errors**2)), "mean": 0.25e-4, "p95": 2.85e-4,
         "max": 3e-4, "scale": 1.25e-4}, abs=1e-12,
    )  # fmt: skip
    assert not found.passed
    assert found.reason == (
        "95 % of 4 distances agree to 0.285 mm, above the limit of 0.2 mm; scale +125 ppm"
    )
    series = np.array(drawn["comparison"]["series"][""])
    assert series == pytest.approx(np.column_stack([np.full(4, 200.0), 1e3 * errors]))


@pytest.mark.parametrize(("limit", "passed"), [("125 mm", True), ("124.999 mm", False)])
def test_the_limit_of_a_distance_is_within_it(limit: str, passed: bool) -> None:
    bar = {"first": ("0 m", "0 m", "1 m"), "second": ("0.5 m", "0 m", "1 m"), "length": "375 mm"}
    params = SphereCheckParams.model_validate({"bars": [bar], "max_error": limit})
    assert verify_sphere(calibration(), params).passed is passed


def test_distances_are_those_of_the_ball_and_not_of_the_flange() -> None:
    exact, ball = calibration(), np.array([0.02, -0.05, 0.3])
    pairs = []
    for pair in exact.pairs:
        pose = pair.observation.base_T_flange
        seen = np.linalg.inv(TRUTH) @ pose.matrix @ np.append(ball, 1.0)
        feature = replace(pair.observation.circle, centre=seen[:3], centre_in_flange=ball)
        pairs.append(replace(pair, observation=replace(pair.observation, feature=feature)))
    found = verify_sphere(replace(exact, pairs=tuple(pairs)), SphereCheckParams())
    assert found.figures["max"] < 1e-12
    assert found.figures["pairs"] > 40


def test_pairs_of_poses_are_counted_once_if_they_are_far_enough_apart() -> None:
    places = np.array([np.linalg.inv(TRUTH) @ pose for pose in poses(12)])[:, :3, 3]
    gaps = np.linalg.norm(places[:, None] - places, axis=2)[np.triu_indices(12, 1)]
    shortest = float(np.median(gaps))
    found = verify_sphere(calibration(), SphereCheckParams(shortest=SI(shortest)))
    assert found.figures["pairs"] == (gaps >= shortest).sum() == 33
    aside = calibration()
    pairs = (replace(aside.pairs[0], used=False), *aside.pairs[1:])
    assert verify_sphere(replace(aside, pairs=pairs), SphereCheckParams()).figures["pairs"] <= 55


@pytest.mark.parametrize(
    ("model", "given", "name", "refused", "taken"),
    [
        (StitchParams, {}, "max_spread", "0 mm", "1 um"),
        (SphereCheckParams, {}, "max_error", "0 mm", "1 um"),
        (SphereCheckParams, {}, "shortest", "0 mm", "1 um"),
        (BallBar, {"first": _m(CENTRE), "second": _m(TIP)}, "length", "0 mm", "1 um"),
        (TouchParams, {"tip": _m(TIP)}, "touches", [], touches(1).touches),
        (TouchParams, {"tip": _m(TIP), "touches": touches(1).touches}, "max_error", "0 mm", "1 um"),
        (HoldoutParams, {}, "folds", 1, 2),
        (HoldoutParams, {}, "max_rms", "0 mm", "1 um"),
        (DriftParams, {"reference": "a.mcap"}, "limit", "0 mm", "1 um"),
    ],
)  # fmt: skip
def test_a_parameter_has_its_bounds(
    model: Any, given: dict[str, Any], name: str, refused: Any, taken: Any
) -> None:
    check_bound(model, name, refused, taken, given)

"""What a scanner's own smooth distortion does to a calibration."""

from dataclasses import replace
from math import factorial

import numpy as np
import pytest

from flangeye.handeye import calibration
from flangeye.handeye.distortion import _Field, distortion_of, edges_of
from flangeye.handeye.measurements import Measurements, by_depth, measurements_of
from flangeye.handeye.nuisance import no_nuisance
from flangeye.maths.geometry import basis_of_plane, hat, rotation_exp
from flangeye.maths.statistics import chi2_quantile
from flangeye.models.configuration import DEFAULT
from flangeye.types import CAMERA, TARGET, CircleFeature, Observation, PoseFeature, Transform
from flangeye_plugins.solve.robust import RobustParams, solve_poses
from tests.benchmarks.distortion import (
    CONFIGURATIONS,
    ROBOT,
    SCANNER,
    compared,
    judged,
    session,
)

ARM_1 = "eye-on-arm 1, flange"
CENTRE = np.array([[0.0, 0.0, 0.6]])
"""Somewhere in the view [m]."""


def over_the_view(count: int = 400) -> Measurements:
    """Circles that face the scanner, all over its volume."""
    rng, slopes = np.random.default_rng(0), np.tan(np.array(SCANNER.field_of_view) / 2)
    near, far = SCANNER.range
    depth = rng.uniform(near, far, count)
    centres = np.column_stack([rng.uniform(-1, 1, (count, 2)) * slopes * depth[:, None], depth])
    _, (one, *_) = session(ARM_1, 0)
    assert isinstance(one.feature, CircleFeature)
    seen = [
        replace(one, id=str(i), feature=replace(one.feature, centre=centre))
        for i, centre in enumerate(centres)
    ]
    return measurements_of(seen, DEFAULT, None)


def test_a_distortion_is_as_large_as_the_scanners_file_has_it_and_no_rigid_motion() -> None:
    measurements = over_the_view()
    every = distortion_of(SCANNER, measurements, np.ones(len(measurements), bool))
    shifts = every.seen[:, 3:]
    assert (every.prior == 1.0).all()
    rms = np.sqrt((shifts**2).sum(axis=(1, 2)).mean())
    assert rms == pytest.approx(SCANNER.calibration_error, rel=0.15)
    # Its mean is that of the rigid motion that it does not have.
    assert np.sqrt((shifts.mean(axis=0) ** 2).sum()) < 0.25 * SCANNER.calibration_error


def test_a_turn_is_the_slope_of_the_shift() -> None:
    """Two circles side by side: what one is lower than the other by is how it is turned."""
    measurements = over_the_view(40)
    every = np.ones(80, bool)
    step = 1e-3 * measurements.rotations[:, :, 0]
    both = [replace(measurements, centres=measurements.centres + s * step) for s in (1, -1)]
    joined = Measurements(
        *(np.concatenate([getattr(b, n) for b in both]) for n in Measurements.__dataclass_fields__)
    )
    moves = distortion_of(SCANNER, joined, every).seen
    normals, along = measurements.rotations[:, :, 2], measurements.rotations[:, :, 1]
    rise = np.einsum("ni,nik->nk", normals, (moves[:40] - moves[40:])[:, 3:]) / 2e-3
    turned = np.einsum("ni,nik->nk", along, (moves[:40] + moves[40:])[:, :3]) / 2
    assert np.abs(turned + rise).max() < 0.1 * np.abs(rise).max()


def test_what_was_found_in_pixels_has_none() -> None:
    _, (one, *_) = session(ARM_1, 0)
    marker = PoseFeature(Transform(CAMERA, TARGET, np.eye(4)), np.eye(6))
    assert by_depth(one.feature)
    assert by_depth(marker)
    assert not by_depth(replace(marker, corners=np.zeros((4, 4))))


def test_the_covariance_has_it_and_the_answer_stays() -> None:
    planned, seen = session(ARM_1, 1)
    configuration = planned.configuration

    def solved(observations: list[Observation], **params: str):
        given = RobustParams.model_validate(params)
        return solve_poses(observations, given, ROBOT, configuration, scanner=SCANNER)

    found, ignoring = solved(seen), solved(seen, scanner_distortion="ignore")
    assert np.array_equal(found.camera.transform.matrix, ignoring.camera.transform.matrix)
    added = found.camera.covariance - ignoring.camera.covariance
    assert np.linalg.eigvalsh(added).min() > -1e-15
    assert np.trace(added[3:, 3:]) > (0.03e-3) ** 2
    assert found.notes[-1] == (
        "the scanner's smooth distortion (0.1 mm rms over its volume, by its file) is in the "
        "covariance: it is the same at every pose, which held-out errors do not show"
    )
    assert not any("distortion" in note for note in ignoring.notes)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_stated_regions_hold_the_truth(name: str) -> None:
    squares = np.array([judged(name, seed)[0] for seed in range(40)])
    assert (squares <= chi2_quantile(0.95, 6)).mean() >= 0.9
    assert squares.mean() / 6 > 0.4  # and are no wider than that


def rounded(seed: int) -> float:
    """Return the squared distance of the truth where edges are rounded as rendered ones are.

    There a face that is tilted by one has its centre 0.7 mm away from the camera, in any session.
    """
    planned, seen = session("eye-in-hand, circle-anywhere", seed, 0.0)
    moved = []
    for o in seen:
        assert isinstance(o.feature, CircleFeature)
        assert o.feature.normal is not None
        to_camera = -o.feature.centre / np.linalg.norm(o.feature.centre)
        along = to_camera - (to_camera @ o.feature.normal) * o.feature.normal
        own = o.feature.covariance + 0.07e-3**2 * np.eye(3)  # as fit.rim states it
        feature = replace(o.feature, centre=o.feature.centre - 0.7e-3 * along, covariance=own)
        moved.append(replace(o, feature=feature))
    found = solve_poses(moved, RobustParams(), ROBOT, planned.configuration, scanner=SCANNER)
    return compared(found.camera, planned.truth.camera.matrix, CENTRE)[0]


def test_edges_that_are_rounded_where_a_wall_is_in_view_are_in_the_region(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told = [rounded(seed) for seed in range(6)]
    monkeypatch.setattr(calibration, "edges_of", lambda s, seen: no_nuisance(len(s)))
    ignored = [rounded(seed) for seed in range(6)]
    assert all(a < b for a, b in zip(told, ignored, strict=True))
    assert np.mean(told) < 8.0  # six are expected


def test_circles_that_all_face_the_camera_say_nothing_of_their_edges() -> None:
    s = over_the_view(20)
    rays = -s.centres / np.linalg.norm(s.centres, axis=1)[:, None]
    turns = np.array([basis_of_plane(ray).T for ray in rays])
    assert len(edges_of(replace(s, rotations=turns), np.ones(20, bool))) == 0
    assert len(edges_of(s, np.zeros(20, bool))) == 0


def test_a_field_is_as_large_as_said_over_the_view_and_has_no_rigid_part() -> None:
    """Exactly so on the grid over which it is made: seven points an axis, from edge to edge."""
    near, far = SCANNER.range
    slopes = np.tan(np.array(SCANNER.field_of_view) / 2)
    steps = np.linspace(-1.0, 1.0, 7)
    points = np.array([
        [x * slopes[0], y * slopes[1], 1.0] * np.full(3, (near + far) / 2 + z * (far - near) / 2)
        for x in steps for y in steps for z in steps
    ])  # fmt: skip
    moved = _Field(SCANNER)._at(points)
    assert moved.shape == (343, 3, 3 * 20)  # along the ray and across; powers to the third
    assert np.sqrt((moved**2).sum(axis=(1, 2)).mean()) == pytest.approx(SCANNER.calibration_error)
    assert np.abs(moved.sum(axis=0)).max() < 1e-12
    assert np.abs(np.cross(points[:, :, None], moved, axis=1).sum(axis=0)).max() < 1e-12


def test_a_field_goes_along_rays_and_less_across_by_the_baseline() -> None:
    near, far = SCANNER.range
    middle, half = (near + far) / 2, (far - near) / 2
    slopes = np.tan(np.array(SCANNER.field_of_view) / 2)
    view = np.array([[0.0, 0.0, 0.0], [0.5, -0.4, 0.3], [-0.2, 0.9, -0.7]])
    points = np.column_stack([view[:, :2] * slopes, np.ones(3)]) * (middle + half * view[:, 2:])
    raw = _Field(SCANNER)._raw(points).reshape(3, 3, 20, 3)
    bells = np.exp(-0.5 * (view**2).sum(axis=1))
    ratio = min(SCANNER.baseline / middle / np.sqrt(2), 1.0)
    for i, (x, y, z) in enumerate(view):
        functions = [
            x**a * y**b * z**c / np.sqrt(factorial(a) * factorial(b) * factorial(c))
            for a in range(4) for b in range(4 - a) for c in range(4 - a - b)
        ]  # fmt: skip
        ways = np.column_stack([points[i] / points[i, 2], [ratio, 0, 0], [0, ratio, 0]])
        assert raw[i] == pytest.approx(bells[i] * np.einsum("k,aw->akw", functions, ways))
    near_base = SCANNER.model_copy(update={"baseline": 0.1 * middle})
    ways = _Field(near_base)._raw(points[:1]).reshape(3, 20, 3)[:, 0]
    assert ways == pytest.approx(
        np.column_stack([[0, 0, 1.0], *(0.1 / np.sqrt(2) * np.eye(3)[:2])])
    )


def test_a_target_turns_and_moves_with_what_it_lies_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a field that turns as a body does, a turn about each axis, any target turns likewise."""
    monkeypatch.setattr(_Field, "_at", lambda _, points: -hat(points))
    s = over_the_view(5)
    moves = _Field(SCANNER).moves(s)
    assert moves[:, :3] == pytest.approx(np.tile(np.eye(3), (5, 1, 1)), abs=1e-9)
    np.testing.assert_array_equal(moves[:, 3:], -hat(s.centres))


def test_ways_that_move_a_twentieth_of_the_largest_are_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A turn counts as what it does 0.3 m away."""
    ways = np.zeros((3, 6, 4))
    ways[0, 3, 0], ways[1, 4, 1], ways[1, 0, 2], ways[0, 1, 3] = (
        1.0,
        0.049,
        0.051 / 0.3,
        0.049 / 0.3,
    )
    monkeypatch.setattr(_Field, "moves", lambda *_: ways)
    found = distortion_of(SCANNER, over_the_view(3), np.array([True, True, False]))
    assert found.prior.tolist() == [1.0, 1.0]
    assert np.abs(found.seen).sum(axis=(0, 1)) == pytest.approx([1.0, 0.17])
    assert not found.camera.any() and not found.target.any() and not found.sized.any()
    blind = distortion_of(SCANNER, over_the_view(3), np.array([False, True, False]))
    assert np.abs(blind.seen).sum(axis=(0, 1)) == pytest.approx([0.17, 0.049])


@pytest.mark.parametrize(("tilt", "told"), [(0.5, True), (1.1e-3, True), (0.9e-3, False)])
def test_edges_move_a_centre_by_its_noise_in_the_face_over_the_tilt(
    tilt: float, told: bool
) -> None:
    s = over_the_view(6)
    rays = -s.centres / np.linalg.norm(s.centres, axis=1)[:, None]
    axes = np.array([basis_of_plane(ray)[0] for ray in rays])
    turns = rotation_exp(tilt * axes) @ np.array([basis_of_plane(ray).T for ray in rays])
    normals = turns[:, :, 2]
    covariances = s.covariances.copy()
    covariances[:, 3:, 3:] = 4e-8 * np.eye(3) + 5e-8 * normals[:, :, None] * normals[:, None]
    seen = np.arange(6) < 4
    found = edges_of(replace(s, rotations=turns, covariances=covariances), seen)
    if not told:
        assert len(found) == 0
        return
    assert found.prior == pytest.approx([np.sqrt(8e-8) / np.sin(tilt)])
    along = rays - np.cos(tilt) * normals
    assert found.seen[:4, 3:, 0] == pytest.approx(along[:4], abs=1e-12)
    assert not found.seen[4:].any() and not found.seen[:, :3].any() and not found.camera.any()

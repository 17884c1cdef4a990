"""What a scanner's own smooth distortion does to a calibration."""

from dataclasses import replace

import numpy as np
import pytest

from flangeye.handeye import calibration
from flangeye.handeye.distortion import distortion_of, edges_of
from flangeye.handeye.measurements import Measurements, by_depth, measurements_of
from flangeye.handeye.nuisance import no_nuisance
from flangeye.maths.geometry import basis_of_plane
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
    assert edges_of(replace(s, rotations=turns), np.ones(20, bool)).prior == 0.0
    assert edges_of(s, np.zeros(20, bool)).prior == 0.0

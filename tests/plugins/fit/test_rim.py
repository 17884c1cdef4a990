from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye.models.loading import load_model
from flangeye.models.targets import wrist_circle_of
from flangeye.types import CAMERA, CircleFeature, FlangeCloud, PointCloud, Rejected
from flangeye.types.geometry import basis_of_plane, rotation_exp
from flangeye.units import SI
from flangeye_plugins.fit.rim import RimParams, fit_rim
from tests.plugins.bounds import check_bound
from tests.plugins.fit.scenes import CENTRE, NORMAL, face, flange, placed
from tests.plugins.fixed import fixed

UR5 = flange()
assert UR5.bore is not None
BORE = UR5.bore


def fitted(cloud, model=UR5, **params) -> CircleFeature:
    circle = fit_rim(cloud, model, fixed(RimParams, **params))
    assert isinstance(circle, CircleFeature), circle
    return circle


def in_face(vector):
    """Return the parts of a vector in the face and along its normal."""
    along = vector @ NORMAL
    return np.linalg.norm(vector - along * NORMAL), abs(along)


def test_a_whole_face_is_found_to_a_hundredth_of_a_millimetre() -> None:
    circle = fitted(placed(face(UR5)))
    across, along = in_face(circle.centre - CENTRE)
    assert across < 0.03e-3
    assert along < 0.01e-3
    assert circle.normal @ NORMAL > 1 - 1e-7
    assert circle.radii["rim"] == pytest.approx(UR5.rim, abs=0.3e-3)
    assert circle.radii["bore"] == pytest.approx(UR5.bore, abs=0.3e-3)
    assert circle.arc_coverage > 0.95


@pytest.mark.parametrize(("arc", "limit"), [(1.5 * np.pi, 0.08e-3), (np.pi, 0.15e-3)])
def test_a_part_of_the_rim_is_enough(arc: Any, limit: float) -> None:
    circle = fitted(placed(face(UR5, arc=arc)))
    across, _ = in_face(circle.centre - CENTRE)
    assert across < limit
    assert circle.arc_coverage == pytest.approx(arc / (2 * np.pi), abs=0.07)


def test_stray_points_do_not_move_it() -> None:
    clean, dirty = fitted(placed(face(UR5))), fitted(placed(face(UR5, stray=800)))
    assert np.linalg.norm(clean.centre - dirty.centre) < 0.05e-3


def test_the_radius_may_differ_from_the_nominal() -> None:
    assert UR5.bore is not None
    worn = UR5.model_copy(update={"rim": UR5.rim - 0.5e-3, "bore": UR5.bore + 0.5e-3})
    circle = fitted(placed(face(worn)))
    across, _ = in_face(circle.centre - CENTRE)
    assert across < 0.03e-3
    assert circle.radii["rim"] == pytest.approx(worn.rim, abs=0.2e-3)


def test_the_covariance_is_flat_and_of_the_right_size() -> None:
    errors, sigmas = [], []
    for seed in range(12):
        circle = fitted(placed(face(UR5, arc=1.6 * np.pi, seed=seed)), edge_bias=SI(1e-5))
        errors.append(in_face(circle.centre - CENTRE)[0])
        sigmas.append(np.sqrt(np.trace(circle.covariance) - NORMAL @ circle.covariance @ NORMAL))
    ratio = np.sqrt(np.mean(np.square(errors))) / np.mean(sigmas)
    assert 0.1 < ratio < 1.6


@settings(max_examples=15)
@given(st.tuples(*[st.floats(-1, 1)] * 3), st.tuples(*[st.floats(-0.1, 0.1)] * 3))
def test_the_fit_moves_with_the_cloud(turn: Any, shift: Any) -> None:
    cloud = placed(face(UR5, arc=1.7 * np.pi, pitch=0.6e-3))
    rotation = rotation_exp(0.5 * np.array(turn))
    moved = FlangeCloud(
        PointCloud(CAMERA, (cloud.cloud.xyz @ rotation.T + shift).astype(np.float32)),
        rotation @ cloud.centre + shift,
        rotation @ cloud.normal,
    )
    first, second = fitted(cloud), fitted(moved)
    assert np.linalg.norm(rotation @ first.centre + shift - second.centre) < 0.03e-3


def test_the_order_of_points_does_not_matter_and_nothing_is_random() -> None:
    cloud = placed(face(UR5))
    shuffled = np.random.default_rng(1).permutation(cloud.cloud.xyz)
    again = FlangeCloud(PointCloud(CAMERA, shuffled), cloud.centre, cloud.normal)
    assert np.array_equal(fitted(cloud).centre, fitted(cloud).centre)
    assert np.linalg.norm(fitted(cloud).centre - fitted(again).centre) < 1e-7


def test_a_wrist_circle_has_no_bore() -> None:
    model = wrist_circle_of(load_model("robots", "ur10e").flange, 0.09)
    disc = face(model, pitch=1e-3)
    plate = disc[np.hypot(*disc[:, :2].T) > 0.034]
    circle = fitted(placed(plate), model)
    lifted = CENTRE + model.details.thickness * NORMAL
    assert np.linalg.norm(circle.centre - lifted) < 0.2e-3
    assert set(circle.radii) == {"rim"}


@pytest.mark.parametrize(
    ("cloud", "words"),
    [
        (
            placed(face(UR5, arc=0.3 * np.pi)),
            "of the rim lies within 0.3 mm of a circle, at least 30% is needed",
        ),
        (placed(1.06 * face(UR5)), "rim radius 32.21 mm, expected 30.50 mm within 1.5 mm"),
        (placed(face(UR5)[:40]), "39 points on the face, at least 100 are needed"),
        (placed(face(UR5)[:2]), "fewer than 3 of 2 points lie on a common plane"),
    ],
)
def test_what_is_no_flange_is_set_aside_with_numbers(cloud: Any, words: str) -> None:
    rejected = fit_rim(cloud, UR5, RimParams())
    assert isinstance(rejected, Rejected)
    assert words in rejected.reason


def stated(**params: SI) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariances of a centre and its normal in the face's axes, normal last."""
    axes = basis_of_plane(NORMAL)
    none = {"scanner_error": SI(0), "edge_bias": SI(0), "flatness": SI(0)}
    circle = fitted(placed(face(UR5, pitch=0.6e-3)), **(none | params))
    assert circle.normal_covariance is not None
    return axes @ circle.covariance @ axes.T, axes @ circle.normal_covariance @ axes.T


@pytest.mark.parametrize(
    ("params", "centre", "normal"),
    [
        ({"scanner_error": SI(1e-4)}, [1e-8, 1e-8, 1e-8], [0, 0, 0]),
        ({"edge_bias": SI(1e-4)}, [1e-8, 1e-8, 0], [0, 0, 0]),
        # Anywhere in a band: its width over root 12, and for slopes half the radius as lever.
        ({"flatness": SI(1e-4)}, [0, 0, 1e-8 / 12], [1e-8 / 12 / (UR5.rim / 2) ** 2] * 2 + [0]),
    ],
)
def test_what_no_scatter_shows_is_added_where_it_belongs(
    params: dict[str, SI], centre: list[float], normal: list[float]
) -> None:
    (plain, slopes), (more, tilted) = stated(), stated(**params)
    assert np.diag(more - plain) == pytest.approx(centre, rel=1e-3, abs=1e-12)
    assert np.diag(tilted - slopes) == pytest.approx(normal, rel=1e-3, abs=1e-11)


def test_the_normal_is_known_as_well_as_its_scatter_says() -> None:
    tilts, sigmas = [], []
    for seed in range(25):
        circle = fitted(placed(face(UR5, pitch=1e-3, noise=1e-4, seed=seed)), flatness=SI(0))
        tilts.append(circle.normal - NORMAL)
        assert circle.normal_covariance is not None
        sigmas.append(np.trace(circle.normal_covariance))
    assert np.sqrt(np.mean(sigmas)) == pytest.approx(
        np.sqrt(np.mean(np.square(tilts)) * 3), rel=0.4
    )


def test_the_normal_is_known_as_well_whatever_lies_off_the_face() -> None:
    clean, dirty = (fitted(placed(face(UR5, stray=stray)), flatness=SI(0)) for stray in (0, 800))
    assert clean.normal_covariance is not None and dirty.normal_covariance is not None
    assert np.trace(dirty.normal_covariance) < 2 * np.trace(clean.normal_covariance)


@pytest.mark.parametrize("arc", [2 * np.pi, np.pi])
def test_edges_that_are_bent_back_do_not_move_the_plane(arc: float) -> None:
    points = face(UR5, arc=arc)
    reach = np.hypot(points[:, 0], points[:, 1])
    edge = (reach > UR5.rim - 0.8e-3) | (reach < BORE + 0.8e-3)
    points[edge, 2] -= 1e-4
    _, along = in_face(fitted(placed(points)).centre - CENTRE)
    assert along < (3e-6 if arc > np.pi else 6e-6)


def test_a_plate_before_a_wrist_circle_is_not_in_its_plane() -> None:
    model = wrist_circle_of(load_model("robots", "ur10e").flange, 0.09)
    disc = face(model, pitch=1e-3)
    disc[np.hypot(*disc[:, :2].T) < 0.0315, 2] += model.details.thickness
    circle = fitted(placed(disc), model)
    lifted = CENTRE + model.details.thickness * NORMAL
    assert np.linalg.norm(circle.centre - lifted) < 0.2e-3


def test_points_well_before_or_behind_the_face_are_no_edge() -> None:
    """A collar about the rim, half a millimetre before or behind the face: no part of it."""
    rng = np.random.default_rng(0)
    angle, reach = rng.uniform(0, 2 * np.pi, 4000), UR5.rim + rng.uniform(0, 1e-3, 4000)
    for height in (-5e-4, 5e-4):
        collar = np.stack([reach * np.cos(angle), reach * np.sin(angle), 0 * angle + height], 1)
        circle = fitted(placed(np.concatenate([face(UR5), collar])))
        assert circle.radii["rim"] == pytest.approx(UR5.rim, abs=0.15e-3)


@pytest.mark.parametrize(
    ("name", "refused", "taken"),
    [
        ("inlier", "0 mm", "1 um"), ("radius_tolerance", "0 mm", "1 um"),
        ("scanner_error", "-1 um", "0 mm"),
    ],
)  # fmt: skip
def test_a_parameter_has_its_bounds(name: str, refused: Any, taken: Any) -> None:
    check_bound(RimParams, name, refused, taken)

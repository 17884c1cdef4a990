from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye.maths.geometry import rotation_exp
from flangeye.models.loading import load_model
from flangeye.models.targets import wrist_circle_of
from flangeye.types import CAMERA, CircleFeature, FlangeCloud, PointCloud, Rejected
from flangeye_plugins.fit.rim import RimParams, fit_rim
from tests.plugins.fit.scenes import CENTRE, NORMAL, face, flange, placed

UR5 = flange()


def fitted(cloud, model=UR5, **params) -> CircleFeature:
    circle = fit_rim(cloud, model, RimParams(**params))
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
        circle = fitted(placed(face(UR5, arc=1.6 * np.pi, seed=seed)), edge_bias="0.01 mm")
        errors.append(in_face(circle.centre - CENTRE)[0])
        sigmas.append(np.sqrt(np.trace(circle.covariance) - NORMAL @ circle.covariance @ NORMAL))
    ratio = np.sqrt(np.mean(np.square(errors))) / np.mean(sigmas)
    assert 0.1 < ratio < 1.6


@settings(max_examples=15, deadline=None)
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
        (placed(1.15 * face(UR5)), "rim radius"),
        (placed(face(UR5)[:40]), "points"),
    ],
)
def test_what_is_no_flange_is_set_aside_with_numbers(cloud: Any, words: str) -> None:
    rejected = fit_rim(cloud, UR5, RimParams())
    assert isinstance(rejected, Rejected)
    assert words in rejected.reason

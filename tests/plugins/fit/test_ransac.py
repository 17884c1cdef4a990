import numpy as np

from flangeye.types import CircleFeature, Seed
from flangeye_plugins.fit.ransac import RansacCircleParams, fit_ransac_circle
from tests.plugins.fit.scenes import CENTRE, face, flange, placed

UR5 = flange()


def fitted(cloud, seed=0, **params):
    asked = {n: {"Flange": UR5, "Seed": Seed(seed)}.get(getattr(need, "__name__", ""))
             for n, need in fit_ransac_circle.needs.items() if n != "cloud"}  # fmt: skip
    return fit_ransac_circle(cloud, **asked, params=RansacCircleParams(**params))


def test_the_papers_fit_is_good_to_half_a_millimetre() -> None:
    circle = fitted(placed(face(UR5)))
    assert isinstance(circle, CircleFeature)
    assert np.linalg.norm(circle.centre - CENTRE) < 1.5e-3


def test_it_is_the_same_for_the_same_seed() -> None:
    cloud = placed(face(UR5))
    assert np.array_equal(fitted(cloud, 3).centre, fitted(cloud, 3).centre)
    assert not np.array_equal(fitted(cloud, 3).centre, fitted(cloud, 4).centre)


def test_the_radius_is_within_its_tolerance() -> None:
    circle = fitted(placed(face(UR5)))
    (radius,) = circle.radii.values()
    assert 0.0295 <= radius <= 0.0315

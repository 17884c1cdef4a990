"""Rim and bore along the edges of flat points: exact ones, arcs, and what is beside them."""

import numpy as np
import pytest

from flangeye_plugins.fit.rim import _sectors_for, find_rings

CENTRE = np.array([0.003, -0.002])
NOMINAL = np.array([0.03, 0.016])
SCALE = 1.5e-4


def disc(radii=NOMINAL, pitch=8e-4):
    """Return points on rim and bore, ten a centimetre, and a grid of them between."""
    ticks = np.arange(-0.05, 0.05, pitch)
    inside = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    reach = np.hypot(*inside.T)
    inside = inside[(reach < radii[0] - 2 * pitch) & (reach > radii[-1] + 2 * pitch)]
    return np.concatenate([circle(r) for r in radii] + [CENTRE + inside])


def circle(radius, count=720):
    angle = np.linspace(-np.pi, np.pi, count, endpoint=False)
    return CENTRE + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def beyond(points, angle):
    """Return the points whose direction from the centre is above an angle [rad]."""
    offsets = points - CENTRE
    return points[np.arctan2(offsets[:, 1], offsets[:, 0]) > angle]


@pytest.mark.parametrize("pitch", [8e-4, 1.2e-4])
def test_exact_edges_give_the_exact_circles(pitch: float) -> None:
    """Few points, and so many that a sample of them is looked at first."""
    radii = NOMINAL * [0.97, 1.04]  # worn, and the bore with a chamfer
    rings = find_rings(disc(radii, pitch), NOMINAL, CENTRE + 2e-3, SCALE)
    assert rings.circles.centre == pytest.approx(CENTRE, abs=1e-8)
    assert rings.circles.radii == pytest.approx(radii, abs=1e-8)
    assert rings.coverage(1e-6).tolist() == [1.0, 1.0]
    assert np.abs(rings.residuals).max() < 1e-7


def test_a_rim_alone_is_found_too() -> None:
    rings = find_rings(disc(NOMINAL[:1]), NOMINAL[:1], CENTRE + 2e-3, SCALE)
    assert rings.circles.centre == pytest.approx(CENTRE, abs=1e-8)
    assert rings.circles.radii == pytest.approx(NOMINAL[:1], abs=1e-8)
    assert rings.coverage(1e-6).tolist() == [1.0]


def test_what_lies_beside_the_face_or_is_left_of_it_is_no_edge() -> None:
    """Half of rim and bore are missing; there the face ends inside, and beyond is some clutter."""
    half = beyond(disc(), 0.0)
    inner, clutter = circle(0.77 * 0.03), circle(1.13 * 0.03)[::3]
    left = [points[points[:, 1] < CENTRE[1]] for points in (inner, clutter)]
    rings = find_rings(np.concatenate([half, *left]), NOMINAL, CENTRE, SCALE)
    assert rings.circles.centre == pytest.approx(CENTRE, abs=1e-6)
    assert rings.circles.radii == pytest.approx(NOMINAL, abs=1e-6)
    assert rings.coverage(1e-4) == pytest.approx([0.5, 0.5], abs=0.02)


def test_the_stated_covariance_is_that_of_the_centres() -> None:
    rng = np.random.default_rng(0)
    found, stated = [], []
    for _ in range(80):
        points = disc() + 0.0
        offsets = points - CENTRE
        out = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
        arc = beyond(points + 5e-5 * rng.standard_normal((len(points), 1)) * out, -0.5)
        rings = find_rings(arc, NOMINAL, CENTRE, SCALE)
        found.append([*rings.circles.centre, *rings.circles.radii])
        stated.append(rings.covariance())
    scatter, mean = np.std(found, axis=0), np.sqrt(np.diag(np.mean(stated, axis=0)))
    assert mean == pytest.approx(scatter, rel=0.35)


@pytest.mark.parametrize("bore", [0.016, 0.0])
def test_a_sector_is_two_points_wide_at_its_ring(bore: float) -> None:
    ticks = np.arange(-0.0305, 0.031, 1e-3)
    flat = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    reach = np.hypot(*flat.T)
    flat = flat[(reach < 0.03) & (reach >= bore)]
    radii = np.array([0.03, bore][: 1 + bool(bore)])
    found = find_rings(flat, radii, np.zeros(2), SCALE)
    assert found.bins == pytest.approx(np.pi * radii / 1e-3, abs=1.5)


def test_a_ring_has_from_24_to_360_sectors() -> None:
    assert _sectors_for(np.zeros((3, 2)), NOMINAL).tolist() == [24, 24]
    assert _sectors_for(np.zeros((1_000_000, 2)), NOMINAL).tolist() == [360, 360]

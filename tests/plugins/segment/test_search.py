"""A flat part of a coarse view as a disc: how wide it may be and which points are its own."""

import numpy as np
import pytest

from flangeye.maths.planes import Plane
from flangeye_plugins.segment.discs import Disc, DiscLimits, PlanarPiece
from flangeye_plugins.segment.flange import _compared, _disc, _piece
from flangeye_plugins.segment.grid import Grid
from tests.plugins.segment.test_choice import BORE, UR5

ANGLE, DEPTH = 2e-3, 0.5
LIMITS = DiscLimits(incidence=np.radians(55), coverage=0.3, crease=0.8e-3)
TICKS = 1e-3 * np.arange(-50, 51)
FACING = np.array([0.0, 0.0, -1.0])


def view(inner: float, outer: float, collar: float = 0.0, behind: float = 0.0) -> Grid:
    """Return a view of a ring with neighbours 1 mm apart, and of a collar about it behind it."""
    x, y = np.meshgrid(TICKS, TICKS)
    reach = np.hypot(x, y)
    z = np.select([reach < inner, reach <= outer, reach <= collar], [np.nan, 0.0, behind], np.nan)
    return Grid(np.stack([x, y, DEPTH + z], axis=-1).astype(np.float32), ANGLE, None)


def compared(of: Grid) -> Disc:
    at = np.array([0.0, 0.0, DEPTH])
    disc = Disc(Plane(at, FACING, 1e-5), (50, 50), at, 2 * UR5.rim, 0.0, None, 0)
    (found,) = _compared([disc], of, UR5, LIMITS)
    return found


def test_a_face_is_the_flanges_by_the_points_in_its_plane_alone() -> None:
    """A collar 1 mm behind it does not make it larger."""
    for of in (view(BORE, UR5.rim), view(BORE, UR5.rim, 1.2 * UR5.rim, 1e-3)):
        found = compared(of)
        assert found.flaw is None and found.seen > 0.95
        assert found.centre == pytest.approx([0, 0, DEPTH], abs=0.5e-3)


def test_an_edge_may_be_off_by_a_millimetre_and_the_distance_of_neighbours() -> None:
    assert compared(view(BORE, UR5.rim - 1e-3)).flaw is None
    assert "rather than a rim of 61.0 mm" in str(compared(view(BORE, UR5.rim - 4e-3)).flaw)


@pytest.mark.parametrize(("spare", "fits"), [(3.5, True), (4.5, False)])
def test_a_part_may_be_wider_by_four_times_the_distance_of_neighbours(
    spare: float, fits: bool
) -> None:
    half = UR5.outer + spare * ANGLE * DEPTH / 2
    points = np.array([0, 0, DEPTH]) + np.outer([-half, 0, half], [1.0, 0, 0])
    at = 101 * 40 + np.array([10, 20, 30])
    found = _disc(
        PlanarPiece(Plane(points[1], FACING), points.astype(np.float32), at), view(0, 1), UR5
    )
    assert (found.flaw is None) is fits
    assert found.cell == (40, 20)


def test_a_pieces_patches_are_half_a_rims_radius_wide() -> None:
    wall = view(0.0, 1.0)
    piece = _piece(wall, np.arange(101 * 101), UR5)
    side = round(0.5 * UR5.rim / 1e-3)
    patch = piece.patches(np.arange(101 * 101))
    assert len(np.unique(patch)) == np.ceil(101 / side) ** 2
    assert np.bincount(patch).max() == side**2
    assert np.array_equal(piece.points, wall.xyz.reshape(-1, 3))

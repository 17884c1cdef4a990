"""Smooth pieces of surface: what ends them, and what does not."""

from typing import Any

import numpy as np
import pytest

from flangeye_plugins.segment import flange as surfaces
from flangeye_plugins.segment.flange import (
    NOISE_GATE,
    _averaged,
    connected_pieces,
    smooth_surface,
)
from flangeye_plugins.segment.grid import Grid

ANGLE = 4e-3
BEND = 0.8e-3


def view(depth) -> Grid:
    """Return a grid of such depths [m]."""
    rows, columns = depth.shape
    u, v = np.meshgrid(ANGLE * np.arange(columns), ANGLE * np.arange(rows))
    return Grid(np.stack([u * depth, v * depth, depth], axis=-1).astype(np.float32), ANGLE, None)


def slope(rows=60, columns=80, down=0.2e-3, across=1e-3):
    return 0.7 + down * np.arange(rows)[:, None] + across * np.arange(columns)


@pytest.mark.parametrize("sigma", [2e-5, 1e-4])
def test_a_plane_is_smooth_however_tilted_and_its_noise_is_told(sigma: float) -> None:
    depth = slope() + sigma * np.random.default_rng(0).standard_normal((60, 80))
    smooth, noise = smooth_surface(view(depth), BEND)
    assert smooth.mean() > 0.999
    assert noise == pytest.approx(sigma, rel=0.05)


def test_noise_along_rows_or_columns_counts_as_it_is() -> None:
    stripes = slope() + 1e-4 * np.random.default_rng(0).standard_normal(80)
    for depth in (stripes, stripes.T):
        assert smooth_surface(view(depth), BEND)[1] == pytest.approx(1e-4, rel=0.25)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_step_ends_a_surface_within_two_points(axis: int) -> None:
    depth = slope(across=0.1e-3)
    np.moveaxis(depth, axis, 0)[30:] += 4e-3
    smooth = np.moveaxis(smooth_surface(view(depth), BEND)[0], axis, 0)
    assert not smooth[28:32].any()
    assert smooth[:28].all() and smooth[32:].all()


@pytest.mark.parametrize(("change", "ends"), [(0.30e-3, False), (0.5e-3, True), (0.9e-3, True)])
def test_a_crease_ends_a_surface_where_depth_bends_by_more_than_is_allowed(
    change: float, ends: bool
) -> None:
    """From one point to the next, or over two: 0.5 mm a point are 1 mm over two."""
    depth = slope(across=0.0)
    depth[:, 40:] += change * np.arange(1, 41)
    smooth = smooth_surface(view(depth), BEND)[0]
    assert smooth[:, 39].any() != ends
    assert smooth[:, :38].all() and smooth[:, 42:].all()


def test_a_crease_beside_the_border_of_the_view_ends_a_surface() -> None:
    depth = slope(across=0.0)
    depth[:, 1:] += 0.9e-3 * np.arange(79)
    smooth = smooth_surface(view(depth), BEND)[0]
    assert not smooth[:, 1].any()
    assert smooth[:, 4:].all()


@pytest.mark.parametrize(("step", "ends"), [(5.3e-3, False), (5.8e-3, True)])
def test_beside_a_missing_point_a_step_steeper_than_sixty_degrees_ends_a_surface(
    step: float, ends: bool
) -> None:
    """60 degrees: 1.7 x 4e-3 x 0.7 m = 4.76 mm from one point to the next, and the crease."""
    depth = slope(across=0.0, down=0.0)
    depth[20, 30] += step  # its neighbours to one side are missing along both axes
    depth[20, 31:33] = depth[21:23, 30] = np.nan
    smooth, _ = smooth_surface(view(depth), BEND)
    assert smooth[20, 30] != ends
    assert not smooth[20, 31] and not smooth[21, 30]


def test_noise_beyond_the_crease_is_averaged_first() -> None:
    depth = slope(200, 200) + 4e-4 * np.random.default_rng(0).standard_normal((200, 200))
    smooth, noise = smooth_surface(view(depth), BEND)
    assert noise == pytest.approx(4e-4, rel=0.05)
    assert smooth.mean() > 0.97


def test_an_average_is_that_of_the_neighbours_that_are_there() -> None:
    depth = slope(9, 12).astype(np.float32)
    depth[4, 5] = depth[:2, 9] = depth[2, 9:] = np.nan
    depth[0, 10] = depth[1, 10:] = np.nan  # the last corner stands alone
    found = _averaged(depth)
    assert np.array_equal(np.isnan(found), np.isnan(depth))
    for row, column in ((0, 0), (8, 11), (2, 2), (4, 6), (3, 5), (0, 11)):
        near = depth[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        assert found[row, column] == pytest.approx(np.nanmean(near), rel=1e-6)


def test_pieces_share_a_side_and_come_largest_first() -> None:
    rows = [
        "..........",
        ".###...##.",
        ".###...##.",
        "....##....",  # only corners join it to the first
        "....##....",
        ".......###",
    ]
    mask = np.array([[c == "#" for c in row] for row in rows])
    pieces = [piece.tolist() for piece in connected_pieces(mask, 4)]
    at = [(1, 1, 2, 3), (1, 7, 2, 2), (3, 4, 2, 2)]
    assert pieces == [
        [10 * (top + r) + left + c for r in range(height) for c in range(width)]
        for top, left, height, width in at
    ]
    assert [len(piece) for piece in connected_pieces(mask, 3)] == [6, 4, 4, 3]


@pytest.mark.parametrize(("share", "averages"), [(0.98, False), (1.02, True)])
def test_depth_is_averaged_where_noise_bends_it_as_a_crease_would(
    share: float, averages: bool, monkeypatch: Any
) -> None:
    """A second difference has six times the variance of what it is taken of."""
    depth = slope() + 1e-4 * np.random.default_rng(0).standard_normal((60, 80))
    noise = smooth_surface(view(depth), 1.0)[1]
    asked: list[Any] = []

    def averaged(of: Any) -> Any:
        asked.append(of)
        return of

    monkeypatch.setattr(surfaces, "_averaged", averaged)
    smooth_surface(view(depth), NOISE_GATE * np.sqrt(6) * noise / share)
    assert bool(asked) is averages

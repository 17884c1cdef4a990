"""verify.stitch: how far the heights of one place differ between views."""

import numpy as np
import pytest

from flangeye_plugins.verify.stitch import CELLS, _heights, _picture, _spread


def sheet(height: float, where: slice = slice(None)) -> np.ndarray:
    """Return points (N, 3) all over the square of 2 m around the centre, or over some columns."""
    across = (np.arange(CELLS) + 0.5) * 2 / CELLS - 1
    x, y = np.meshgrid(across[where], across)
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    return np.repeat(points, 4, axis=0)


def test_a_cell_has_the_mean_height_of_its_points_if_they_are_enough() -> None:
    tilted = sheet(0.0)
    tilted[:, 2] = tilted[:, 0] + 10 * tilted[:, 1] + np.tile([-0.3, 0.1, 0.1, 0.1], CELLS**2)
    found = _heights(tilted, 1.0, 4)
    across = (np.arange(CELLS) + 0.5) * 2 / CELLS - 1
    assert found == pytest.approx(across[None, :] + 10 * across[:, None])
    assert np.isnan(_heights(tilted, 1.0, 5)).all()
    smaller = tilted * [0.25, 0.25, 1.0]  # the map is as wide as the flange
    assert np.array_equal(_heights(smaller, 0.25, 4), found)


@pytest.mark.parametrize("heights", [(0.0, 2e-3), (0.0, 1e-3, 5e-3), (1.0, 1.0, 1.0)])
def test_the_spread_is_the_standard_deviation_between_views(heights: tuple[float, ...]) -> None:
    found = _spread([sheet(height) for height in heights], 2)
    seen = found[np.isfinite(found)]
    assert len(seen) > 0.5 * CELLS**2
    assert seen == pytest.approx(np.std(heights, ddof=1), abs=1e-12)


def test_a_place_that_one_view_alone_saw_has_no_spread() -> None:
    half = CELLS // 2
    found = _spread([sheet(0.0), sheet(1e-3), sheet(3e-3, slice(half))], 2)
    middle = found[CELLS // 2]
    assert np.nanmin(middle[:half]) == pytest.approx(np.std([0, 1e-3, 3e-3], ddof=1))
    assert np.nanmax(middle[half:]) == pytest.approx(np.std([0, 1e-3], ddof=1))
    lone = _spread([sheet(0.0), sheet(1e-3, slice(half))], 2)[CELLS // 2]
    assert np.isnan(lone[half + 1 :]).all()


def test_the_picture_goes_from_blue_to_red_and_is_white_where_nothing_was_seen() -> None:
    spread = np.array([[0.0, 1e-3], [0.5e-3, np.nan], [2e-3, 1e-3]])
    pixels = _picture(spread, 1e-3).pixels[::6, ::6]
    expected = [[[0, 76, 255], [255, 0, 0]], [[127, 38, 127], [255, 255, 255]], [[255, 0, 0]] * 2]
    assert pixels.tolist() == expected

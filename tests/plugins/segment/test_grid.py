"""The coarse view: which points it keeps, how far apart they are, and where a place is in it."""

import numpy as np
import pytest

from flangeye.maths.planes import Plane
from flangeye_plugins.segment import grid
from flangeye_plugins.segment.discs import Disc, crop, in_box
from flangeye_plugins.segment.grid import Grid, _drawn, _lots, coarse_view, project, range_image
from flangeye_plugins.segment.grid import thin_out as thinned


def image(rows=200, columns=320, down=1e-3, across=1e-3, depth=0.8) -> np.ndarray:
    """Return the scan of a wall whose neighbours are so far apart in the view [tangents]."""
    u = (np.arange(columns) - columns / 2) * across
    v = (np.arange(rows) - rows / 2) * down
    rays = np.stack([*np.meshgrid(u, v), np.ones((rows, columns))], axis=-1)
    return (depth * rays).astype(np.float32)


@pytest.mark.parametrize(
    ("down", "across", "strides"),
    [(1e-3, 1e-3, (5, 5)), (2e-3, 1e-3, (2, 5)), (1e-3, 2.4e-3, (5, 2)), (8e-3, 9e-3, (1, 1))],
)
def test_lines_are_left_out_until_neighbours_are_as_far_apart_as_wanted(
    down: float, across: float, strides: tuple[int, int]
) -> None:
    scan = image(down=down, across=across)
    view = thinned(scan, 0.8 * 5.1e-3)
    assert view.strides == strides
    assert np.array_equal(view.xyz, scan[:: strides[0], :: strides[1]])
    assert view.angle == pytest.approx(np.sqrt(strides[0] * down * strides[1] * across), rel=1e-3)


def test_missing_points_do_not_change_how_dense_a_scan_is() -> None:
    scan = image()
    scan[np.random.default_rng(0).random(scan.shape[:2]) < 0.4] = np.nan
    assert thinned(scan, 0.8 * 5.1e-3).strides == (5, 5)


def test_an_organised_scan_without_neighbours_is_seen_as_points() -> None:
    scan = image()
    scattered = np.full_like(scan, np.nan)
    scattered[::4, ::4] = scan[::4, ::4]
    view = coarse_view(scattered, 4e-3)
    assert view is not None and view.strides is None
    assert coarse_view(np.full_like(scan, np.nan), 4e-3) is None
    whole = coarse_view(scan, 4e-3)
    assert whole is not None and whole.strides == (4, 4)


def test_a_cell_holds_the_mean_of_its_points() -> None:
    rng = np.random.default_rng(0)
    rays = rng.uniform(-0.5, 0.5, (4000, 2))
    rays[:2] = [[-0.5, -0.5], [0.49, 0.29]]  # the corners of the view
    rays[:, 1] = np.clip(rays[:, 1], -0.5, 0.29)
    depth = rng.uniform(0.5, 1.5, 4000)
    points = (depth[:, None] * np.column_stack([rays, np.ones(4000)])).astype(np.float32)
    view = project(points, 0.1)
    assert view.xyz.shape == (8, 10, 3) and view.strides is None and view.angle == 0.1
    column, row = ((points[:, k] / points[:, 2] + 0.5) / 0.1 for k in (0, 1))
    for r, c in ((0, 0), (3, 7), (7, 9)):
        members = points[(row.astype(int) == r) & (column.astype(int) == c)]
        assert view.xyz[r, c] == pytest.approx(members.mean(axis=0), abs=2e-3)


def test_cells_without_points_are_missing_and_what_no_scanner_sees_is_left_out() -> None:
    points = np.array([[0, 0, 1], [0.5, 0.3, 1], [9, 0, 1], [0, -9, 1]], dtype=np.float32)
    view = project(points, 0.1)
    assert view.xyz.shape == (4, 6, 3)
    assert np.isfinite(view.xyz[..., 2]).sum() == 2
    assert view.xyz[0, 0].tolist() == [0, 0, 1]
    none = project(points[2:], 0.1).xyz
    assert none.shape == (1, 1, 3) and np.isnan(none).all()


@pytest.mark.parametrize("rows", [300, 60])
@pytest.mark.parametrize(("pitch", "dense"), [(4e-3, True), (5e-4, False)])
def test_loose_points_fill_cells_as_wide_as_wanted_or_as_they_can(
    pitch: float, dense: bool, rows: int
) -> None:
    scan = image(rows, 320).reshape(-1, 3)
    scan = np.random.default_rng(0).permutation(scan)
    view = range_image(scan, pitch)
    assert view is not None
    assert view.angle == pytest.approx(pitch / 0.8 if dense else 1.6e-3, rel=0.05)
    inside = view.xyz[1:-1, 1:-1, 2]
    assert np.isfinite(inside).mean() > 0.95
    assert np.nanmax(np.abs(inside - 0.8)) < 1e-6


def test_of_a_dense_scan_some_four_points_a_cell_are_looked_at(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looked_at: list[int] = []

    def counted(points: np.ndarray, angle: float) -> Grid:
        looked_at.append(len(points))
        return project(points, angle)

    monkeypatch.setattr(grid, "project", counted)
    scan = image(300, 320).reshape(-1, 3)
    for pitch, cells in ((16e-3, 16 * 15), (8e-3, 32 * 30)):
        range_image(scan, pitch)
        assert looked_at.pop() == pytest.approx(4 * cells, rel=0.35)


def test_points_behind_the_scanner_and_missing_ones_are_not_seen() -> None:
    scan = image().reshape(-1, 3)
    behind, torn = -scan, scan.copy()
    torn[:, 1] = np.nan
    view = range_image(np.concatenate([behind, torn, scan]), 4e-3)
    alone = range_image(scan, 4e-3)
    assert view is not None and alone is not None
    assert np.nanmin(view.xyz[..., 2]) == pytest.approx(0.8)
    assert view.angle == pytest.approx(alone.angle, rel=0.05)
    assert range_image(behind, 4e-3) is None


def test_points_that_are_all_at_one_place_are_seen_there() -> None:
    place = np.array([[0.1, 0.2, 0.8]], dtype=np.float32)
    behind = np.tile(-place, (60_000, 1))
    for points in (np.concatenate([behind, place]), np.tile(place, (60_000, 1)), place):
        view = range_image(points, 4e-3)
        assert view is not None and view.xyz == pytest.approx(place[None])
    organised = np.broadcast_to(place, (64, 80, 3))
    assert thinned(organised, 4e-3).strides == (1, 1)


def test_the_one_point_before_the_scanner_is_seen_though_it_is_not_drawn() -> None:
    place = np.array([[0.1, 0.2, 0.8]], dtype=np.float32)
    points = np.concatenate([np.tile(-place, (200_000, 1)), place])
    assert len(_drawn(place, _lots(place), 50_000 / len(points))) == 0
    view = range_image(points, 4e-3)
    assert view is not None and view.xyz == pytest.approx(place[None])


@pytest.mark.parametrize("share", [0.1, 0.4, 0.6])
def test_a_share_is_drawn_evenly_whatever_the_order(share: float) -> None:
    scan = image(256, 256)
    points = scan.reshape(-1, 3)
    drawn = _drawn(points, _lots(points), share)
    assert len(drawn) == pytest.approx(share * len(points), rel=0.03)
    shuffled = np.random.default_rng(0).permutation(points)
    again = _drawn(shuffled, _lots(shuffled), share)
    assert {tuple(p) for p in again.tolist()} == {tuple(p) for p in drawn.tolist()}
    for k in (0, 1):  # no line of the scanner has much more or less than its share
        _, counts = np.unique(drawn[:, k], return_counts=True)
        assert counts.std() < 2.5 * np.sqrt(256 * share * (1 - share))
    assert _drawn(points, _lots(points), 0.9) is points


@pytest.mark.parametrize("organised", [True, False])
def test_a_window_holds_all_that_is_near_a_place_and_little_else(organised: bool) -> None:
    scan, reach = image(400, 500), 0.03
    tilt = 1 / (1 - scan[..., :1] / 1.6)  # a wall turned by 27 degrees
    scan = (scan * tilt).astype(np.float32)
    view = thinned(scan, 4e-3) if organised else project(scan.reshape(-1, 3), 5e-3)
    for cell in ((20, 30), (50, 70), (5, 4)):
        centre = view.xyz[cell].astype(float)
        window = view.about(cell, centre, reach)
        whole = view.xyz.reshape(-1, 3)
        assert len(in_box(window, centre, reach)) == len(in_box(whole, centre, reach)) > 50
        assert len(window) < 5 * (2 * reach / (view.angle * centre[2]) + 4) ** 2
        full = view.about(cell, centre, reach, scan)
        assert len(in_box(full, centre, reach)) == len(in_box(scan.reshape(-1, 3), centre, reach))
        assert (len(full) < 0.3 * scan[..., 0].size) == organised


def test_what_is_nearer_to_the_scanner_takes_up_more_of_the_window() -> None:
    view = Grid(np.zeros((400, 400, 3), np.float32), 1e-3, None)

    def width(depth, reach):
        return np.sqrt(len(view.about((200, 200), np.array([0, 0, depth]), reach)))

    # SPARE times the reach over the nearest depth, two to spare, to both sides.
    assert width(1.0, 0.05) == pytest.approx(2 * (np.ceil(1.5 * 0.05 / 0.95e-3) + 2))
    assert width(1.0, 0.08) == pytest.approx(2 * (np.ceil(1.5 * 0.08 / 0.92e-3) + 2))
    assert width(0.1, 0.03) == 400  # all of it


def test_a_cut_out_disc_has_the_points_near_its_plane_and_circle() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.06, 0.06, (30000, 3)).astype(np.float32) + np.array(
        [0, 0, 0.5], np.float32
    )
    points[::7] = np.nan
    normal = np.array([0.6, 0.0, -0.8])
    centre = np.array([0.002, -0.004, 0.5])
    view = Grid(points.reshape(100, 300, 3), 1e-3, None)
    offsets = points - centre
    height = offsets @ normal
    across = np.sqrt((offsets**2).sum(axis=1) - height**2)
    for sigma, thick in ((1e-4, 2e-3), (1e-3, 4e-3)):
        disc = Disc(Plane(centre, normal, sigma), (50, 150), centre, 0.06, 1.0, None, 4)
        found = crop(points, view, disc, radius=0.03, margin=2e-3)
        expected = points[(np.abs(height) < thick) & (across < 0.032)]
        assert len(expected) > 100
        assert np.array_equal(found, expected)

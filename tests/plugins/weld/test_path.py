"""A seam by arc length: places between its points, slopes, curvature and feet."""

from __future__ import annotations

import numpy as np
import pytest

from flangeye_plugins.weld.path import Path
from tests.plugins.weld.bench import circle, straight

CORNER = Path(np.array([[0.0, 0.0, 0.0], [0.03, 0.04, 0.002], [0.03, 0.08, 0.002]]))
"""50 mm that climb by 2, then 40 mm that do not."""


def test_a_path_is_resampled_every_half_millimetre_of_its_length_in_the_plane() -> None:
    assert CORNER.length == pytest.approx(0.09) and len(CORNER.points) == 181
    assert CORNER.step == pytest.approx(0.5e-3)
    short = Path(np.array([[0.0, 0, 0], [4e-4, 0, 0]]))
    assert len(short.points) == 3 and short.step == pytest.approx(2e-4)


@pytest.mark.parametrize(("s", "point", "height"), [(0.025, (0.015, 0.02), 1e-3), (0.07, (0.03, 0.06), 2e-3),
                                                    (0.02513, (0.015078, 0.020104), 1.0052e-3)])  # fmt: skip
def test_places_lie_between_the_points(s: float, point: tuple[float, float], height: float) -> None:
    place = CORNER.at(s)
    assert place.point == pytest.approx(point) and place.height == pytest.approx(height)
    ahead = np.array([0.6, 0.8]) if s < 0.05 else np.array([0.0, 1.0])
    assert place.tangent == pytest.approx(ahead)
    assert place.normal == pytest.approx([-ahead[1], ahead[0]])


def test_beyond_its_ends_it_goes_on_straight_and_level() -> None:
    before, after = CORNER.at(-0.01), CORNER.at(0.1)
    assert before.point == pytest.approx([-0.006, -0.008]) and before.height == 0.0
    assert after.point == pytest.approx([0.03, 0.09]) and after.height == pytest.approx(2e-3)
    arc = np.array([-0.01, 0.0, 0.033, 0.0502, 0.09, 0.1])
    points, tangents = CORNER.evaluate(arc)
    for s, point, tangent in zip(arc.tolist(), points, tangents, strict=True):
        place = CORNER.at(s)
        assert point == pytest.approx([*place.point, place.height])
        assert tangent == pytest.approx(place.tangent)
    assert CORNER.climb(0.025) == pytest.approx(0.04) and CORNER.climb(0.07) == pytest.approx(0.0)
    assert CORNER.climb(-1e-9) == CORNER.climb(0.0901) == 0.0
    assert CORNER.climb(0.0) == pytest.approx(0.04)


@pytest.mark.parametrize("radius", [0.05, -0.08])
def test_curvature_is_one_over_the_radius_to_the_left_positive(radius: float) -> None:
    path = Path(circle(radius, 1.5))
    for s in (0.0, 0.02, path.length):
        assert path.bend(s) == pytest.approx(1 / radius, rel=0.02)
    assert path.bend(-1e-6) == path.bend(path.length + 1e-6) == 0.0
    assert path.sharpest(0.01, 0.02) == pytest.approx(1 / abs(radius), rel=0.02)
    assert path.sharpest(path.length + 0.01, path.length + 0.02) == 0.0


def test_a_corner_is_curved_where_it_is_by_what_it_turns_within_five_millimetres() -> None:
    turn = np.arctan2(1.0, 0.0) - np.arctan2(0.8, 0.6)
    bends = np.array([CORNER.bend(s) for s in CORNER.step * np.arange(181)])
    assert bends.max() == pytest.approx(turn / 5e-3, rel=0.05)
    curved = CORNER.step * np.flatnonzero(bends > 1e-3 / 5e-3)
    assert 0.0445 <= curved.min() < curved.max() <= 0.0555
    assert bends.sum() * CORNER.step == pytest.approx(turn, rel=0.02)
    assert CORNER.sharpest(0.0, 0.04) == pytest.approx(0.0, abs=1e-9)
    assert CORNER.sharpest(0.04, 0.06) == pytest.approx(bends.max())


def test_a_foot_is_found_forwards_and_back_and_progress_only_forwards() -> None:
    path = Path(circle(0.05, 1.5))
    place = path.at(0.03)
    aside = place.point + 2e-3 * place.normal
    for near in (0.028, 0.03, 0.032):
        assert path.foot(aside, near) == pytest.approx(0.03, abs=2e-5)
    assert path.advance(aside, 0.032, 5e-3) == 0.032
    assert path.advance(aside, 0.028, 5e-3) == pytest.approx(0.03, abs=1.5e-4)
    assert path.advance(aside, 0.02, 5e-3) == pytest.approx(0.025)


def test_at_its_very_end_a_path_is_at_its_last_point_and_climbs_as_it_does_there() -> None:
    rising = [0, 0, 0.05] * np.linspace(0.0, 1.5, 600)[:, None] ** 2
    path = Path(circle(0.05, 1.5) + rising)
    end = path.at(path.length)
    assert end.point == pytest.approx(path.points[-1, :2], abs=1e-12)
    assert end.tangent == pytest.approx(path.tangents[-1] / np.linalg.norm(path.tangents[-1]))
    points, _ = path.evaluate(np.array([path.length]))
    assert points[0] == pytest.approx(path.points[-1], abs=1e-12)
    rise = float(path.points[-1, 2] - path.points[-2, 2])
    assert path.climb(path.length) == pytest.approx(rise / path.step, abs=1e-3)


def test_progress_neither_goes_back_nor_jumps_to_another_branch() -> None:
    eight = Path(
        np.column_stack([np.sin(t := np.linspace(0, 2 * np.pi, 800)), np.sin(2 * t) / 2, 0 * t])
        * 0.1
    )
    s, crossings = 0.0, []
    for ahead in np.arange(0.0, eight.length, 1e-3):
        at = eight.at(float(ahead)).point
        before, s = s, eight.advance(at, s, 5e-3)
        assert before <= s <= before + 5e-3
        crossings.append(abs(s - ahead))
    assert max(crossings) < 1e-3
    assert eight.advance(eight.at(0.0).point, s, 5e-3) >= s


def test_the_curvature_of_a_path_is_not_its_scatter_s() -> None:
    scatter = straight() + 0.02e-3 * np.random.default_rng(0).standard_normal((200, 3))
    assert Path(scatter).sharpest(0.0, 0.12) < 5.0

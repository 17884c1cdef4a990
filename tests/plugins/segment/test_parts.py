"""Flat parts: of a piece that is flat, of one that is bent, and of none."""

from typing import Any

import numpy as np
import pytest

from flangeye.maths.planes import Plane
from flangeye_plugins.segment import discs as room
from flangeye_plugins.segment.discs import Patch, SurfacePiece, _flattest, _principal, flat_parts

PITCH = 2e-3
SCATTER = 3e-4


def piece(height, rows=60, columns=60, first=0) -> SurfacePiece:
    """Return a piece whose height over a plane 0.7 m away is a function of place."""
    y, x = (PITCH * a.ravel() for a in np.indices((rows, columns)))
    points = np.stack([x, y, 0.7 - height(x, y)], axis=1).astype(np.float32)
    return SurfacePiece(points, first + np.arange(rows * columns), columns, 10)


def flat(x, y):
    return 0.1 * x + 0 * y


def roof(x, y):
    return 0.5 * np.minimum(x, 0.12 - x) + 0 * y


def test_a_piece_that_is_flat_is_one_part_with_its_plane() -> None:
    both = [piece(flat), piece(lambda x, y: 0.02 + 0 * x, first=5000)]
    parts = flat_parts(both, 0.1, SCATTER, 50)
    assert [len(part.at) for part in parts] == [3600, 3600]
    assert parts[1].at.tolist() == list(range(5000, 8600))
    normal = np.array([-0.1, 0, -1]) / np.hypot(0.1, 1)
    assert parts[0].plane.normal == pytest.approx(normal, abs=1e-6)
    assert parts[1].plane.point[2] == pytest.approx(0.68, abs=1e-6)


def test_a_few_points_off_its_plane_are_no_part_of_it() -> None:
    wall = piece(lambda x, y: np.where(x + y < 0.03, 0.01, 0.0))
    (part,) = flat_parts([wall], 0.1, SCATTER, 500)
    assert (part.points[:, 2] == np.float32(0.7)).all()
    assert len(part.at) == (wall.points[:, 2] == np.float32(0.7)).sum()


def test_what_stands_on_a_flat_piece_is_a_part_of_its_own_if_it_is_large_enough() -> None:
    wall = piece(lambda x, y: np.where(x < 0.03, 0.005, 0.0))
    for fewest, expected in ((50, {0.7, 0.695}), (1000, {0.7})):
        parts = flat_parts([wall], 0.1, SCATTER, fewest)
        assert {round(float(p.plane.point[2]), 4) for p in parts} == expected


def test_a_bent_piece_has_a_part_for_each_side() -> None:
    parts = flat_parts([piece(roof)], 0.2, SCATTER, 50)
    found = sorted(part.plane.normal[0] for part in parts if len(part.at) > 1500)
    slope = 0.5 / np.hypot(0.5, 1)
    assert found == pytest.approx([-slope, slope], abs=1e-4)
    assert sum(len(part.at) for part in parts) <= 3660  # few belong to both


def test_a_part_of_a_bent_piece_reaches_no_farther_than_it_may() -> None:
    parts = flat_parts([piece(roof)], 0.03, SCATTER, 50)
    assert parts
    for part in parts:
        assert np.linalg.norm(np.ptp(part.points, axis=0)) <= 2 * 0.03 * np.sqrt(2) + 1e-3


def test_what_is_nowhere_flat_has_no_part_and_little_is_not_searched() -> None:
    ball = piece(lambda x, y: np.sqrt(0.1**2 - (x - 0.06) ** 2 - (y - 0.06) ** 2))
    assert all(len(part.at) < 50 for part in flat_parts([ball], 0.1, 5e-5, 50))
    assert not flat_parts([piece(roof)], 0.2, SCATTER, 3601)
    assert not flat_parts([], 0.2, SCATTER, 50)


def test_points_around_a_patch_are_those_within_reach_or_a_sample() -> None:
    wall = piece(flat)
    patch = Patch(wall, Plane(wall.points[1830].astype(float), np.array([0, 0, -1.0]), 0.0),
                  np.arange(12), np.arange(100, 3600))  # fmt: skip
    near = np.linalg.norm(wall.points - wall.points[1830], axis=1) < 0.021
    assert patch.around(0.021).tolist() == [k for k in np.flatnonzero(near) if k >= 100]
    sample = patch.around(0.021, 300)  # every third of 12 members' fifty patches
    assert set(sample) == {k for k in np.flatnonzero(near) if k >= 100 and (k - 100) % 3 == 0}


def test_groups_have_the_means_variances_and_normals_of_their_points() -> None:
    rng = np.random.default_rng(0)
    points, sizes = rng.standard_normal((60, 3)) * [3, 2, 1], np.array([10, 30, 20])
    starts = np.array([0, 10, 40])
    means, variances, normals = _principal(points, starts, sizes)
    for k, (start, size) in enumerate(zip(starts, sizes, strict=True)):
        group = points[start : start + size]
        values, axes = np.linalg.eigh(np.cov(group.T, bias=True))
        assert means[k] == pytest.approx(group.mean(axis=0))
        assert variances[k] == pytest.approx(values[0])
        assert abs(normals[k] @ axes[:, 0]) == pytest.approx(1)


def test_sixty_patches_are_tried_the_flattest_first() -> None:
    """Of 100, each of which is rougher than the one before; a patch of a few points is none."""
    rng = np.random.default_rng(0)
    bumpy = piece(flat, rows=100, columns=100)
    which = np.unique(bumpy.patches(np.arange(10000)), return_inverse=True)[1]
    rough = 1e-5 * (1 + np.argsort(rng.permutation(100)))
    noise = np.where(np.indices((100, 100)).sum(axis=0).ravel() % 2, 1.0, -1.0)
    points = bumpy.points.astype(np.float64)
    points[:, 2] += noise * rough[which]
    tried = list(_flattest(bumpy._replace(points=points.astype(np.float32)), np.arange(10000)))
    first = [int(which[patch.members[0]]) for patch in tried]
    assert first == np.argsort(rough)[:60].tolist()
    for patch in tried:
        assert len(patch.members) == 100 and len(set(which[patch.members])) == 1
        assert patch.rough.normal @ patch.rough.point < 0
    few = np.flatnonzero((which != which[0]) | (np.arange(10000) % 100 < 4))  # 40 of 100 are left
    assert int(which[0]) not in {which[p.members[0]] for p in _flattest(bumpy, few)}


def test_planes_are_settled_by_some_hundred_points_whatever_the_piece_holds(
    monkeypatch: Any,
) -> None:
    asked: list[list[int]] = []

    def planes(samples: Any, rough: Any, scatter: float) -> Any:
        asked.append([len(sample) for sample in samples])
        return [None] * len(samples)

    monkeypatch.setattr(room, "_planes", planes)
    assert not flat_parts([piece(flat, 120, 100), piece(flat, 20, 20)], 1.0, SCATTER, 50)
    whole, around = asked
    assert whole == [572, 400]  # every 21st point, and all
    assert max(around) == 706  # every 17th: of fifty patches of 100 points some 300

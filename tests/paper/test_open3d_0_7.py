"""The emulated normals of Open3D up to 0.7, and its ICP."""

import numpy as np
import pytest

from flangeye.types.geometry import rigid, rotation_exp
from flangeye_paper.open3d_0_7 import IcpStop, icp, normals_of

CONVERGED = IcpStop(100, 1e-12)


def plate(tilt=0.0):
    """A square plate of 60 mm in metres, exactly flat along z unless tilted."""
    ticks = np.float32(np.linspace(-0.03, 0.03, 40))
    x, y = (a.ravel().astype(float) for a in np.meshgrid(ticks, ticks))
    flat = np.column_stack([x, y, np.full_like(x, np.float32(-0.003))])
    return flat @ rotation_exp(np.array([tilt, 0.0, 0.0])).T


def bump():
    """A curved patch: no neighbourhood is flat."""
    points = plate()
    points[:, 2] = -2.0 * (points[:, 0] ** 2 + 1.5 * points[:, 1] ** 2)
    return points


def test_sound_normals_of_a_plate_stand_on_it() -> None:
    normals = normals_of(plate(), 1.0, "sound")
    np.testing.assert_allclose(np.abs(normals[:, 2]), 1.0, atol=1e-9)


def test_defective_normals_of_a_flat_plate_lie_in_it() -> None:
    normals = normals_of(plate(), 1.0, "open3d_0_7_normals")
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    lying = np.abs(normals[:, 2]) < 0.1
    assert lying.mean() > 0.3


def test_on_a_curved_patch_both_agree() -> None:
    sound, old = (normals_of(bump(), 1.0, kind) for kind in ("sound", "open3d_0_7_normals"))
    cosines = np.abs(np.einsum("ni,ni->n", sound, old))
    assert np.median(cosines) == pytest.approx(1.0, abs=1e-6)


def test_neighbours_beyond_the_radius_do_not_count() -> None:
    lonely = np.vstack([plate(), [[0.0, 0.0, 0.5]]])
    normals = normals_of(lonely, 0.01, "open3d_0_7_normals")
    np.testing.assert_array_equal(normals[-1], [0.0, 0.0, 1.0])  # the library's fallback


def corner():
    """Three faces that meet, each exactly flat: nothing can slide."""
    face = plate() + [0.0, 0.0, 0.003]
    points = np.vstack([face, face[:, [0, 2, 1]], face[:, [2, 0, 1]]])
    return points, np.repeat(np.eye(3)[[2, 1, 0]], len(face), axis=0)


def test_icp_finds_the_motion() -> None:
    target, normals = corner()
    motion = rigid(rotation_exp(np.array([0.01, -0.02, 0.015])), np.array([1e-3, -5e-4, 2e-4]))
    source = (target - motion[:3, 3]) @ motion[:3, :3]
    fit = icp(source, target, normals, 1.0, CONVERGED)
    np.testing.assert_allclose(fit.motion, motion, atol=1e-6)
    assert fit.share == 1.0
    assert fit.iterations < 100


def test_icp_stops_when_told() -> None:
    target, normals = corner()
    source = target + [2e-3, 1e-3, 0.0]
    assert icp(source, target, normals, 1.0, IcpStop(2, 0.0)).iterations == 2
    assert icp(source, target, normals, 1.0, IcpStop(30, 1.0)).iterations == 1


def test_icp_fails_when_nothing_is_near() -> None:
    target, normals = corner()
    assert icp(target + 1.0, target, normals, 0.1, CONVERGED) is None

"""Rigid-body and least-squares geometry shared by more than one kind of plugin. Arrays only."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from flangeye.types.arrays import Floats

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def arc_lengths(points: Floats) -> Floats:
    """Return the way along a polyline from its start to each of its points, (N, D) -> (N,)."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def rows_at(at: ArrayLike, known: Floats, rows: Floats) -> Floats:
    """Return ``rows`` (N, ...), given at ascending ``known`` (N,), interpolated at ``at`` (M,)."""
    columns = rows.reshape(len(rows), -1).T
    there = np.stack([np.interp(np.asarray(at), known, column) for column in columns], axis=-1)
    return there.reshape((*np.shape(at), *rows.shape[1:]))


def hat(vectors: ArrayLike) -> Floats:
    """Return the (..., 3, 3) cross-product matrices of (..., 3) vectors: ``hat(a) @ b = a x b``."""
    v = np.asarray(vectors, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def skew_parts(matrices: Floats) -> Floats:
    """Return the (..., 3) vectors v of (..., 3, 3) matrices M with ``hat(v) = (M - M.T) / 2``.

    Of a rotation it is the axis times the sine of the angle.
    """
    apart = matrices - np.swapaxes(matrices, -1, -2)
    return np.asarray(apart[..., (2, 0, 1), (1, 2, 0)] / 2)


def rotation_exp(vectors: ArrayLike) -> Floats:
    """Return the rotations of rotation vectors, (..., 3) [rad] -> (..., 3, 3) (Rodrigues)."""
    phi = np.asarray(vectors, dtype=np.float64)
    if phi.ndim == 1:  # an arm's pose, hundreds of times a second: floats are five times faster
        return _rotation_exp_of_one(*phi.tolist())
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    k = hat(phi)
    # sin(x)/x and (1 - cos(x))/x^2 without cancellation near zero.
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.asarray(np.eye(3) + a * k + b * (k @ k))


def _rotation_exp_of_one(x: float, y: float, z: float) -> Floats:
    angle = math.sqrt(x * x + y * y + z * z)
    half = 0.5 * angle
    a = math.sin(angle) / angle if angle else 1.0
    b = 0.5 * (math.sin(half) / half) ** 2 if half else 0.5
    return np.array(
        [
            [1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)],
        ]
    )


def rotation_log(rotation: Floats) -> Floats:
    """Return the rotation vectors (..., 3) [rad] of (..., 3, 3), their length at most pi."""
    r = np.asarray(rotation, dtype=np.float64)
    # Half the skew part is the sine times the axis, half the trace less one the cosine.
    sines = 0.5 * _skew_part(r)
    length = np.sqrt((sines**2).sum(axis=-1, keepdims=True))
    cosine = 0.5 * (np.trace(r, axis1=-2, axis2=-1)[..., None] - 1.0)
    ratio = np.arctan2(length, cosine) / np.maximum(length, 1e-300)
    vectors = np.asarray(sines * np.where(length < 1e-12, 1.0, ratio))
    # Near half a turn the sine is lost to rounding, and with it the axis; a quaternion keeps it
    far = cosine[..., 0] < -0.9
    if far.any():
        vectors[far] = _rotation_log_anywhere(r[far])
    return vectors


def _skew_part(r: Floats) -> Floats:
    """Return the vector (..., 3) of the differences of opposite entries of (..., 3, 3)."""
    return np.stack(
        [
            r[..., 2, 1] - r[..., 1, 2],
            r[..., 0, 2] - r[..., 2, 0],
            r[..., 1, 0] - r[..., 0, 1],
        ],
        axis=-1,
    )


def _rotation_log_anywhere(rotation: Floats) -> Floats:
    """Return rotation vectors via quaternions: near 180 degrees the sine loses the axis."""
    q = quaternion_from_rotation(rotation)
    xyz, w = q[..., :3], q[..., 3:]
    length = np.linalg.norm(xyz, axis=-1, keepdims=True)
    # Twice the angle over its sine; at zero angle, where w is one, the ratio is two.
    ratio = 2.0 * np.arctan2(length, w) / np.maximum(length, 1e-300)
    return np.asarray(xyz * np.where(length < 1e-12, 2.0, ratio))


def rotation_between(first: Floats, second: Floats) -> Floats:
    """Return the (N, 3) shortest rotation vectors that take unit vectors (N, 3) to others."""
    cross = (hat(first) @ second[..., None])[..., 0]
    sine = np.linalg.norm(cross, axis=1, keepdims=True)
    # Opposite vectors have no single axis: like equal ones they give zero, not half a turn
    angle = np.arctan2(sine, (first * second).sum(axis=1, keepdims=True))
    return np.asarray(cross * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0))


def quaternion_from_rotation(rotation: Floats) -> Floats:
    """Return unit quaternions (..., 4) xyzw, w >= 0, of (..., 3, 3) (Bar-Itzhack 2000).

    The dominant eigenvector of a symmetric matrix: stable at every angle, and the nearest
    rotation where the matrix is not quite orthonormal.
    """
    r = np.asarray(rotation, dtype=np.float64)
    symmetric = r + np.swapaxes(r, -1, -2)
    trace = np.trace(r, axis1=-2, axis2=-1)[..., None, None]
    # Three times the paper's matrix, which has the same eigenvectors
    k = np.empty((*r.shape[:-2], 4, 4))
    k[..., :3, :3] = symmetric - trace * np.eye(3)
    k[..., 3, 3] = trace[..., 0, 0]
    k[..., :3, 3] = k[..., 3, :3] = _skew_part(r)
    q = np.linalg.eigh(k)[1][..., -1]
    return np.asarray(np.where(q[..., 3:] >= 0, q, -q))


def rotation_from_quaternion(xyzw: Floats) -> Floats:
    """Return the (..., 3, 3) rotations of quaternions (..., 4) xyzw; they are normalised first."""
    q = np.asarray(xyzw, dtype=np.float64)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    entries = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.moveaxis(entries, (0, 1), (-2, -1))


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Floats:
    """Return the (3, 3) rotation Rz(yaw) Ry(pitch) Rx(roll), angles [rad] (URDF, ROS)."""
    cr, cp, cy = np.cos([roll, pitch, yaw])
    sr, sp, sy = np.sin([roll, pitch, yaw])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rpy_from_rotation(rotation: Floats) -> Floats:
    """Return (roll, pitch, yaw) [rad] with R = Rz(yaw) Ry(pitch) Rx(roll).

    The roll is that of Rz(-yaw) R: at a pitch of 90 deg, where yaw and roll are about one axis and
    each alone is arbitrary, the three still give R.
    """
    r = np.asarray(rotation, dtype=np.float64)
    # Not an arc sine, which loses digits near 90 deg and fails where rounding exceeds one
    pitch = np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0]))
    yaw = np.arctan2(r[1, 0], r[0, 0])
    s, c = np.sin(yaw), np.cos(yaw)
    roll = np.arctan2(s * r[0, 2] - c * r[1, 2], c * r[1, 1] - s * r[0, 1])
    return np.array([roll, pitch, yaw]) + 0.0  # no -0


def rigid(rotation: ArrayLike, translation: ArrayLike) -> Floats:
    """Return the (4, 4) matrix of a (3, 3) rotation and a (3,) translation [m]."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, translation
    return out


def each_applied(transforms: Floats, points: Floats) -> Floats:
    """Return (..., 3) points, each mapped by the (4, 4) transform of the same index."""
    turned = (transforms[..., :3, :3] @ points[..., None])[..., 0]
    return np.asarray(turned + transforms[..., :3, 3])


def stack_rows(blocks: Floats) -> Floats:
    """Return (N m, k) the rows of (N, m, k) blocks, one below the other."""
    return np.asarray(blocks.reshape(-1, blocks.shape[-1]))


def angle_between(first: Floats, second: Floats) -> Floats:
    """Return the (...) angles of vectors (..., 3), exact for small ones too [rad]."""
    # The arc cosine of the dot product would lose angles below 1e-8
    across = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.asarray(np.arctan2(across, (first * second).sum(axis=-1)))


def invert(transforms: Floats) -> Floats:
    """Return the inverses of rigid (..., 4, 4) matrices."""
    out = np.zeros_like(transforms)
    # The transpose: a general inverse would round the rotation out of orthonormality
    out[..., :3, :3] = np.swapaxes(transforms[..., :3, :3], -1, -2)
    out[..., :3, 3] = -(out[..., :3, :3] @ transforms[..., :3, 3, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def nearest_rotation(matrices: Floats) -> Floats:
    """Return the proper rotations (..., 3, 3) nearest to any (..., 3, 3), by Frobenius norm."""
    u, _, vt = np.linalg.svd(matrices)
    # A reflection is turned over along the least singular value, where that costs least
    u[..., :, 2] *= (np.linalg.det(u) * np.linalg.det(vt))[..., None]
    return np.asarray(u @ vt)


def basis_of_plane(normal: Floats) -> Floats:
    """Return (3, 3) whose rows are two in-plane axes and the unit normal, right-handed.

    NaN where the normal has no direction.
    """
    x, y, z = np.asarray(normal, dtype=np.float64).tolist()
    length = math.hypot(x, y, z)
    if not 0.0 < length < math.inf:
        return np.full((3, 3), np.nan)
    x, y, z = x / length, y / length, z / length
    # The cross product of the normal and the axis it is farthest from, without arrays of three.
    k = min(range(3), key=(abs(x), abs(y), abs(z)).__getitem__)
    a, b, c = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))[k]
    across = math.hypot(a, b, c)
    a, b, c = a / across, b / across, c / across
    return np.array([[a, b, c], [y * c - z * b, z * a - x * c, x * b - y * a], [x, y, z]])


def kabsch(source: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Return R (3, 3), t (3,) minimising sum |R source + t - target|^2, for (N, 3) points.

    Umeyama (1991) with scale one: the paper's equations (8) to (10), with the sign taken from
    det(U) det(V), which also holds for coplanar points, where det of the covariance is zero.
    """
    share = np.ones(len(source)) / len(source)
    mean_s, mean_t = share @ source, share @ target
    cross = (target - mean_t).T @ (share[:, None] * (source - mean_s))
    u, _, vt = np.linalg.svd(cross)
    sign = np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)])
    rotation = u @ sign @ vt
    return rotation, mean_t - rotation @ mean_s


def levers(points: Floats) -> Floats:
    """Return (..., 3, 6): how (..., 3) points move with (rotation, translation) about 0."""
    return np.concatenate([-hat(points), np.broadcast_to(np.eye(3), (*points.shape, 3))], axis=-1)


def adjoint_shift(offset: Floats) -> Floats:
    """Return the (6, 6) map of a perturbation (phi, tau) to another reference point.

    With ``tau`` taken about p, ``adjoint_shift(q - p) @ (phi, tau)`` is taken about q:
    ``tau_q = tau_p + phi x (q - p)``.
    """
    out = np.eye(6)
    out[3:, :3] = -hat(offset)
    return out


def covariance_at(covariance: Floats, about: Floats, points: Floats) -> Floats:
    """Return the (N, 3, 3) covariance of mapped points from a transform's (6, 6) covariance.

    Args:
        covariance: Order (rotation, translation), left perturbation, translation about ``about``.
        about: (3,) reference point [m].
        points: (N, 3) points in the parent frame [m].
    """
    # To first order a mapped point p moves by phi x (p - about) + tau
    jacobian = levers(np.asarray(points) - about)
    return np.asarray(jacobian @ covariance @ jacobian.transpose(0, 2, 1))


def kabsch_covariance(target: Floats, sigma: float) -> Floats:
    """Return the (6, 6) covariance of :func:`kabsch`, translation about the targets' centroid.

    Every coordinate of every pair carries independent noise of ``sigma`` [m], on either side.
    Rotation and translation are then independent, and this is the Cramér-Rao bound
    (Fitzpatrick, West & Maurer 1998).

    Raises:
        numpy.linalg.LinAlgError: The targets lie on a line: a rotation is not determined.
    """
    levers = hat(target - target.mean(axis=0))
    out = np.zeros((6, 6))
    out[:3, :3] = sigma**2 * np.linalg.inv(np.einsum("nki,nkj->ij", levers, levers))
    out[3:, 3:] = sigma**2 / len(target) * np.eye(3)
    return out

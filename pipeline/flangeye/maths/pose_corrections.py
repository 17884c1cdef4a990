"""Undo mistakes in recorded robot poses: inverses, tool offsets, orders. Arrays only.

Poses are (N, 4, 4) ``base_T_flange`` [m], in the order they were recorded.
"""

import warnings

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats, Mask
from flangeye.types.geometry import rows_at


def scaled(poses: Floats, factor: float | Floats) -> Floats:
    """Return the poses with their positions times ``factor``, one for all axes or one per axis."""
    out = np.array(poses)
    out[..., :3, 3] *= factor
    return out


def inverted(poses: Floats) -> Floats:
    """Return the inverse of each pose, for recordings of ``flange_T_base``."""
    return np.asarray(np.linalg.inv(poses))


def transposed(poses: Floats) -> Floats:
    """Return the poses with their rotations transposed: matrices stored column by column."""
    out = np.array(poses)
    out[..., :3, :3] = poses[..., :3, :3].swapaxes(-1, -2)
    return out


def reread(poses: Floats, read_as: str, written_as: str) -> Floats:
    """Return the poses with their rotation numbers read in another convention.

    Args:
        poses: The poses as read.
        read_as: Convention in which the rotations were read, as :class:`PoseConvention`
            names it.
        written_as: Convention in which they were written, with as many numbers.
    """
    out = np.array(poses)
    out[..., :3, :3] = _rotations(_numbers(poses[..., :3, :3], read_as), written_as)
    return out


def _numbers(rotations: Floats, written_as: str) -> Floats:
    from scipy.spatial.transform import Rotation

    known = Rotation.from_matrix(rotations)
    if written_as == "vector":
        return np.asarray(known.as_rotvec())
    if written_as in ("xyzw", "wxyz"):
        return np.asarray(known.as_quat()[:, _xyzw_to(written_as)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # gimbal lock: one answer of many
        return np.asarray(known.as_euler(written_as))


def _rotations(numbers: Floats, written_as: str) -> Floats:
    from scipy.spatial.transform import Rotation

    if written_as == "vector":
        return np.asarray(Rotation.from_rotvec(numbers).as_matrix())
    if written_as in ("xyzw", "wxyz"):
        back = np.argsort(_xyzw_to(written_as))
        return np.asarray(Rotation.from_quat(numbers[:, back]).as_matrix())
    return np.asarray(Rotation.from_euler(written_as, numbers).as_matrix())


def _xyzw_to(order: str) -> list[int]:
    return [0, 1, 2, 3] if order == "xyzw" else [3, 0, 1, 2]


def shifted(poses: Floats, by: int, start: int = 0) -> tuple[Floats, Mask]:
    """Return the poses shifted by whole samples, and the mask of samples that have one.

    Args:
        poses: (N, 4, 4) recorded poses.
        by: A sample's pose is the one recorded so many samples later.
        start: Index of the first sample that is shifted; those before keep their own.
    """
    source, kept = sources(len(poses), by, start)
    return poses[source], kept


def sources(count: int, by: int, start: int = 0) -> tuple[NDArray[np.intp], Mask]:
    """Return the index (N,) of the sample whose pose each one gets, and the mask of those with one.

    Args:
        count: Number of samples N.
        by: A sample's pose is the one recorded so many samples later.
        start: Index of the first sample that is shifted; those before keep their own.
    """
    samples = np.arange(count)
    source = np.where(samples < start, samples, samples + by)
    kept = (source >= 0) & (source < count) & ((samples < start) | (source >= start))
    return np.where(kept, source, samples), kept


def delayed(poses: Floats, times: Floats, delay: float) -> tuple[Floats, Mask]:
    """Return the poses ``delay`` later, and the mask of the samples for which they are known.

    Poses between samples are interpolated, as if the arm moved at constant velocity.

    Args:
        poses: (N, 4, 4) recorded poses.
        times: (N,) times of the poses, rising [s].
        delay: Negative for earlier [s].
    """
    moved, kept = delayed_by_each(poses, times, np.array([delay]))
    return moved[0], kept[0]


def delayed_by_each(poses: Floats, times: Floats, delays: Floats) -> tuple[Floats, Mask]:
    """Return poses (K, N, 4, 4) and masks (K, N) as :func:`delayed` does, for K delays at once."""
    from scipy.spatial.transform import Rotation, Slerp

    wanted = times + delays[:, None]
    kept = (wanted >= times[0]) & (wanted <= times[-1])
    inside = np.clip(wanted, times[0], times[-1])
    out = np.tile(poses, (len(delays), 1, 1, 1))
    turns = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(inside.ravel()).as_matrix()
    out[..., :3, :3] = turns.reshape(*inside.shape, 3, 3)
    out[..., :3, 3] = rows_at(inside, times, poses[:, :3, 3])
    return out, np.asarray(kept)


def without_tool(poses: Floats, offset: Floats) -> Floats:
    """Return flange poses from poses of a tool centre at ``offset`` (3,) in ``flange`` [m]."""
    out = np.array(poses)
    out[..., :3, 3] -= poses[..., :3, :3] @ offset
    return out

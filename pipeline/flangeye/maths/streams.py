"""Recorded streams: poses with times, standstills, and the offset of two clocks.

Times are (N,) ascending [s], poses (N, 4, 4) [m]. Arrays only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flangeye.types import Floats, Motion
from flangeye.types.geometry import nearest_rotation, rigid, rotation_log, rows_at

# An arm stands still while it stays within these of one pose [m, rad]
STILL_DISTANCE = 0.5e-3
STILL_ANGLE = np.radians(0.1)
LARGEST_OFFSET = 2.0
"""Largest offset between two clocks that is searched for [s]."""
PASSED_STEP = 0.02
"""Spacing of the poses that are kept about a moment of a stream [s]."""


@dataclass(frozen=True)
class Span:
    """A stretch of time, both ends in it [s]."""

    start: float
    end: float

    @property
    def middle(self) -> float:
        """Half way between its ends."""
        return (self.start + self.end) / 2


def standstills(times: Floats, poses: Floats) -> list[Span]:
    """Return the intervals in which the arm stood still, in order."""
    found: list[Span] = []
    first = 0
    while first < len(times):
        last = _still_until(times, poses, first)
        # An arm that only passes a pose slowly is not still: it has to stay for so long [s]
        if times[last] - times[first] >= 0.3:
            found.append(Span(float(times[first]), float(times[last])))
            first = last + 1
        else:
            first += 1
    return found


def _still_until(times: Floats, poses: Floats, first: int) -> int:
    """Return the last sample up to which the arm stays near its pose at ``first``."""
    last, size = first, 16
    while last + 1 < len(times):
        ahead = poses[last + 1 : last + 1 + size]
        moved = np.linalg.norm(ahead[:, :3, 3] - poses[first, :3, 3], axis=1)
        turned = np.linalg.norm(rotation_log(poses[first, :3, :3].T @ ahead[:, :3, :3]), axis=1)
        away = (moved > STILL_DISTANCE) | (turned > STILL_ANGLE)
        if away.any():
            return last + int(np.argmax(away))
        last, size = last + len(ahead), 2 * size
    return last


def interpolated(times: Floats, poses: Floats, at: Floats) -> Floats:
    """Return the poses (M, 4, 4) at the times ``at`` (M,), the ends held outside the stream."""
    from scipy.spatial.transform import Rotation, Slerp

    if not len(at):
        return np.zeros((0, 4, 4))
    inside = np.clip(at, times[0], times[-1])
    # Of a long stream the samples about these times alone
    first = max(int(np.searchsorted(times, inside.min())) - 1, 0)
    last = int(np.searchsorted(times, inside.max())) + 2
    times, poses = times[first:last], poses[first:last]
    turned = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(inside).as_matrix()
    moved = rows_at(inside, times, poses[:, :3, 3])
    return np.array([rigid(r, p) for r, p in zip(turned, moved, strict=True)])


def passed(
    times: Floats,
    poses: Floats,
    at: float,
    others: Mapping[str, tuple[Floats, Floats]] | None = None,
) -> Motion:
    """Return the flange's motion about a moment ``at`` of the stream.

    Args:
        times: (N,) times of the stream [s].
        poses: (N, 4, 4) poses of the stream [m].
        at: The moment [s].
        others: Times and poses of other moving frames, by name.
    """
    steps = PASSED_STEP * np.arange(-10, 11, dtype=np.float64)
    more = others or {}
    for each in (times, *(stream for stream, _ in more.values())):
        steps = steps[(steps == 0) | ((at + steps >= each[0]) & (at + steps <= each[-1]))]
    beside = {name: interpolated(*stream, at + steps) for name, stream in more.items()}
    return Motion(steps, interpolated(times, poses, at + steps), beside)


def with_joints(motion: Motion, at: float, of: str, stream: tuple[Floats, Floats]) -> Motion:
    """Return a motion about the time ``at`` [s] with joint values of a frame added.

    The motion is cut to the times that the joints' stream covers.

    Args:
        motion: Motion of the flange, and of other frames.
        at: Time of the motion's moment 0 [s].
        of: Name of the frame that the joints move.
        stream: Times (N,) [s] and joint values (N, n), or (N,) of one axis.
    """
    times, values = stream
    told = (at + motion.times >= times[0]) & (at + motion.times <= times[-1])
    told |= motion.times == 0
    joints = {name: each[told] for name, each in motion.joints.items()}
    joints[of] = rows_at(at + motion.times[told], times, values.reshape(len(times), -1))
    others = {name: poses[told] for name, poses in motion.others.items()}
    return Motion(motion.times[told], motion.poses[told], others, joints)


def later(motion: Motion, delay: float) -> Motion | None:
    """Return the flange's motion about the moment ``delay`` later [s]; None beyond the record."""
    if not motion.times[0] <= delay <= motion.times[-1]:
        return None
    return replace(motion, times=motion.times - delay)


def pose_at(motion: Motion, time: float, of: str | None = None) -> Floats:
    """Return the pose (4, 4) at a time of a motion [s]: the flange's, or that of another frame."""
    poses = motion.poses if of is None else motion.others[of]
    return np.asarray(interpolated(motion.times, poses, np.array([time]))[0])


def joints_at(motion: Motion, time: float, of: str) -> Floats | None:
    """Return the (n,) joints that move a frame at a time of a motion; None if not recorded."""
    if of not in motion.joints:
        return None
    return rows_at(time, motion.times, motion.joints[of])


def rates_of(motions: Sequence[Motion], of: str | None = None) -> Floats:
    """Return a frame's velocities (N, 6) [rad/s, m/s] at N moments, in the base, at its origin."""
    before, after = (
        np.array([pose_at(each, end, of) for each in motions])
        for end in (-PASSED_STEP, PASSED_STEP)
    )
    turned = rotation_log(after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2))
    moved = np.concatenate([turned, after[:, :3, 3] - before[:, :3, 3]], axis=1)
    return np.asarray(moved / (2 * PASSED_STEP))


def mean_pose(poses: Floats) -> Floats:
    """Return the mean (4, 4) of poses that are near each other."""
    rotation = nearest_rotation(poses[:, :3, :3].mean(axis=0))
    return rigid(rotation, poses[:, :3, 3].mean(axis=0))


def turning(times: Floats, poses: Floats) -> tuple[Floats, Floats]:
    """Return mid-times (N - 1,) [s] and angular speeds [rad/s], the same in every frame."""
    steps = np.swapaxes(poses[:-1, :3, :3], -1, -2) @ poses[1:, :3, :3]
    spans = np.maximum(np.diff(times), 1e-9)
    return (times[1:] + times[:-1]) / 2, np.linalg.norm(rotation_log(steps), axis=1) / spans


def clock_offset(
    first: tuple[Floats, Floats], second: tuple[Floats, Floats]
) -> tuple[float, float]:
    """Return the offset to add to the second stream's times, and its correlation.

    Args:
        first: Times (N,) and a signal of motion (N,) there, of the first stream.
        second: Speeds of the second stream, in any unit.

    Returns:
        Offset [s] and correlation; both 0 if no clear offset was found.
    """
    step = float(min(np.median(np.diff(first[0])), np.median(np.diff(second[0])), 0.05))
    most = 1_000_000  # steps; times in a unit that was not stated may span centuries
    step = max(step, float(first[0][-1] - first[0][0]) / most)
    best, shifts = 0, np.arange(-LARGEST_OFFSET, LARGEST_OFFSET + step / 2, step)
    grid = np.arange(first[0][0], first[0][-1], step)
    wanted = np.interp(grid, *first)
    alike = np.array([_correlation(wanted, grid, second, shift) for shift in shifts])
    best = int(np.argmax(alike))
    # A correlation below 0.7, or a maximum at the end of the range, is no clear offset
    if alike[best] < 0.7 or best in (0, len(shifts) - 1):
        return 0.0, 0.0
    # The top of the parabola through the best shift and its neighbours
    left, middle, right = alike[best - 1 : best + 2]
    bend = left - 2 * middle + right
    finer = 0.0 if bend == 0 else 0.5 * (left - right) / bend
    return float(shifts[best] + finer * step), float(middle)


def _correlation(
    wanted: Floats, grid: Floats, signal: tuple[Floats, Floats], shift: float
) -> float:
    """Return the correlation (-1 to 1) of two signals with the second moved by ``shift``."""
    inside = (grid >= signal[0][0] + shift) & (grid <= signal[0][-1] + shift)
    if inside.sum() < 10:
        return 0.0
    a, b = wanted[inside], np.interp(grid[inside] - shift, *signal)
    if a.std() == 0 or b.std() == 0:
        return 0.0
    return float(np.mean((a - a.mean()) * (b - b.mean())) / (a.std() * b.std()))


def offset_into(spans: list[Span], at: Floats) -> float:
    """Return the smallest shift that brings most of the moments ``at`` into the spans [s]."""
    shifts = np.arange(-LARGEST_OFFSET, LARGEST_OFFSET, 0.01)
    # Sorted by size, so that argmax takes the smallest of the best shifts
    shifts = shifts[np.argsort(np.abs(shifts), kind="stable")]
    starts, ends = (np.array([getattr(s, end) for s in spans]) for end in ("start", "end"))
    moved = at[None, :] + shifts[:, None]
    which = np.searchsorted(starts, moved, side="right") - 1
    inside = (which >= 0) & (moved <= ends[which])
    return float(shifts[int(np.argmax(inside.sum(axis=1)))])


def apart(poses: Floats, distance: float, angle: float) -> list[int]:
    """Return indices of poses at least ``distance`` [m] or ``angle`` [rad] from the last kept."""
    kept: list[int] = []
    for i, pose in enumerate(poses):
        if kept:
            step = np.linalg.inv(poses[kept[-1]]) @ pose
            turned = float(np.linalg.norm(rotation_log(step[:3, :3])))
            if np.linalg.norm(step[:3, 3]) < distance and turned < angle:
                continue
        kept.append(i)
    return kept

"""Pair an arm's recorded poses with a camera's measurements on another clock."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flangeye import Params, StageError
from flangeye.files.recording import MIN_CAPTURES
from flangeye.maths.streams import (
    Span,
    apart,
    clock_offset,
    interpolated,
    mean_pose,
    offset_into,
    passed,
    standstills,
)
from flangeye.types import Floats, Motion
from flangeye.units import Duration, param

Signal = tuple[Floats, Floats]
"""Times (N,) [s] and how much moved there (N,), in any unit."""


class PairingParams(Params):
    """Parameters for pairing poses with measurements."""

    clock_offset: Duration | None = None
    """Offset from the camera's times to the arm's, to be added; estimated if not given."""
    tolerance: Duration = param("100 ms", gt=0)
    """Largest time between a measurement and the arm's next pose."""


@dataclass(frozen=True, eq=False)
class MatchedPose:
    """A pose of the arm with its measurements.

    Attributes:
        time: Time on the arm's clock [s].
        pose: (4, 4) pose [m].
        events: Indices of the measurements, at least one.
        motion: Motion of the arm; None at rest.
    """

    time: float
    pose: Floats
    events: tuple[int, ...]
    motion: Motion | None = None

    def mean(self, measured: Sequence[Any]) -> Floats:
        """Return the mean of this pose's measurements, points (3,) or poses (4, 4)."""
        seen = np.array([measured[i] for i in self.events])
        return mean_pose(seen) if seen.ndim == 3 else np.asarray(seen.mean(axis=0))


def pair(
    arm: tuple[Floats, Floats],
    events: Floats,
    signals: tuple[Signal, Signal] | None,
    params: PairingParams,
) -> tuple[list[MatchedPose], list[str]]:
    """Return the matched pairs, and notes on the matching.

    Args:
        arm: Times (N,) [s] and poses (N, 4, 4) [m] of the arm.
        events: (M,) times of the measurements on the camera's clock [s].
        signals: Motion signals of arm and camera for estimating the clocks' offset, if known.
        params: Parameters of the pairing.

    Raises:
        StageError: The recordings do not overlap in time.
    """
    spans = standstills(*arm)
    offset, told = _offset(spans, events, signals, params)
    # Times of the measurements on the arm's clock [s]
    moved = events + offset
    overlap = (moved >= arm[0][0] - params.tolerance) & (moved <= arm[0][-1] + params.tolerance)
    if not overlap.any():
        raise StageError(
            f"the arm's poses are from {arm[0][0]:.3f} to {arm[0][-1]:.3f} s, the measurements "
            f"from {moved[0]:.3f} to {moved[-1]:.3f} s: they have no time in common; set "
            "clock_offset"
        )
    # At rest a wrong clock offset does no harm, so standstills are preferred to interpolation
    pairs = _standing(arm, spans, moved)
    if len(pairs) >= MIN_CAPTURES:
        return pairs, [f"the arm stood still {len(pairs)} times with measurements; {told}"]
    pairs = _passing(arm, moved, params)
    return pairs, [f"the arm hardly stood still, so {len(pairs)} poses are interpolated; {told}"]


def _offset(
    spans: Sequence[Span],
    events: Floats,
    signals: tuple[Signal, Signal] | None,
    params: PairingParams,
) -> tuple[float, str]:
    if params.clock_offset is not None:
        return params.clock_offset, f"clock offset {_ms(params.clock_offset)} as given"
    # Both angular speeds have the same course, whatever the frames: their correlation peaks at the
    # offset. Below some twenty samples chance makes peaks too
    if signals is not None and min(len(times) for times, _ in signals) > 20:
        offset, alike = clock_offset(*signals)
        if alike > 0:
            how = f"estimated from both motions (correlation {alike:.2f})"
            return offset, f"clock offset {_ms(offset)}, {how}"
    if len(spans) >= MIN_CAPTURES:
        offset = offset_into(list(spans), events)
        return offset, f"clock offset {_ms(offset)}, the smallest that fits the standstills"
    return 0.0, "clock offset assumed to be 0 ms: the recording does not show it"


def _ms(seconds: float) -> str:
    return f"{round(seconds * 1e3, 1) + 0.0:.1f} ms"  # a nought without a minus


def _standing(
    arm: tuple[Floats, Floats], spans: Sequence[Span], moved: Floats
) -> list[MatchedPose]:
    times, poses = arm
    found = []
    for span in spans:
        within = np.flatnonzero((moved >= span.start) & (moved <= span.end))
        if len(within):
            # Its ends hold the last of one motion and the first of the next.
            trim = 0.2 * (span.end - span.start)
            held = poses[(times >= span.start + trim) & (times <= span.end - trim)]
            if not len(held):  # a stream so slow that a standstill is its two ends
                held = poses[(times >= span.start) & (times <= span.end)]
            found.append(MatchedPose(span.middle, mean_pose(held), tuple(within.tolist())))
    return found


def _passing(arm: tuple[Floats, Floats], moved: Floats, params: PairingParams) -> list[MatchedPose]:
    times, poses = arm
    nearest = np.abs(times[_nearest(times, moved)] - moved) <= params.tolerance
    usable = np.flatnonzero(nearest)
    if not len(usable):
        return []
    before = np.clip(np.searchsorted(times, moved[usable]) - 1, 0, len(times) - 1)
    after = np.clip(before + 1, 0, len(times) - 1)
    # Between samples so far apart the arm's path is unknown: the nearer sample is taken as it is
    sparse = times[after] - times[before] > 2 * params.tolerance
    at = np.where(sparse, times[_nearest(times, moved[usable])], moved[usable])
    between = interpolated(times, poses, at) if len(times) > 1 else poses[[0] * len(at)]
    # Of an arm that never stands still, poses so far apart are taken: either is enough [m, rad].
    kept = apart(between, 5e-3, float(np.radians(2.0)))
    return [
        MatchedPose(
            float(at[i]), between[i], (int(usable[i]),),
            None if sparse[i] else passed(times, poses, float(at[i])),
        )
        for i in kept
    ]  # fmt: skip


def _nearest(times: Floats, at: Floats) -> Floats:
    after = np.clip(np.searchsorted(times, at), 0, len(times) - 1)
    before = np.clip(after - 1, 0, len(times) - 1)
    return np.where(np.abs(times[before] - at) <= np.abs(times[after] - at), before, after)

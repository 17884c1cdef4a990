"""Where the work is: the box over which errors are reported."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flangeye import types as t


def workspace_of(source: t.Source, given: t.Box | None, pairs: Sequence[t.Pair]) -> t.Box | None:
    """Return the recipe's box, or the source's, or the box around the flange's centres."""
    if given or source.workspace:
        return given or source.workspace
    if not pairs:
        return None
    return _around(np.array([pair.observation.tcp_in_base for pair in pairs]))


def work_of(calibration: t.HandEye, source: t.Source, given: t.Box | None) -> t.Box | None:
    """Return where the work is, in the frame that carries the camera.

    That of :func:`workspace_of` where it is the base; where the robot moves the camera, and in a
    cell, the box around what it looked at.
    """
    camera = calibration.camera.transform
    if camera.parent == t.BASE and (given or source.workspace or camera.child == t.CAMERA):
        return workspace_of(source, given, calibration.pairs)
    observed = [p.observation for p in calibration.pairs if p.observation.camera == camera.child]
    seen = np.array([o.feature.centre for o in observed])
    return _around(camera.apply(seen.reshape(-1, 3)))


def _around(points: t.Array) -> t.Box | None:
    if not len(points):
        return None
    low, high = points.min(axis=0), points.max(axis=0)
    return t.Box((low + high) / 2, high - low)

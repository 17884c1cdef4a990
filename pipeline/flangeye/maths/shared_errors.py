"""What features are without the errors that a whole session shares. Arrays only."""

from __future__ import annotations

from dataclasses import replace

from flangeye.maths.geometry import rotation_exp
from flangeye.types import Feature, Floats, Observation, PoseFeature, Transform


def without_shared(observation: Observation, found: Floats) -> Observation:
    """Return an observation as it is without the errors that all of its session share.

    Args:
        observation: As it was measured.
        found: (k,) of each error, in standard deviations; see :class:`HandEye`.
    """
    feature = observation.feature
    if not len(found) or not isinstance(feature, PoseFeature) or not feature.shared.size:
        return observation
    return replace(observation, feature=_moved_back(feature, found))


def _moved_back(feature: PoseFeature, found: Floats) -> Feature:
    moved = feature.shared @ found[: feature.shared.shape[1]]
    pose, seen = feature.camera_T_target.matrix.copy(), feature.camera_T_target
    pose[:3, :3] = rotation_exp(-moved[:3]) @ pose[:3, :3]
    pose[:3, 3] -= moved[3:]
    return replace(feature, camera_T_target=Transform(seen.parent, seen.child, pose))

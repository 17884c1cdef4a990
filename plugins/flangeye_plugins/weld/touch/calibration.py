"""Estimate a finger's rest pose, gain, noise and stiffness from readings of the tag.

A punch mark holds the tip while the robot makes small moves. Relative to the tool, the tip is then
displaced by exactly the opposite of the robot's motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flangeye.errors import StageError
from flangeye.models.finger import Calibration
from flangeye.types import Floats
from flangeye.types.geometry import nearest_rotation, rotation_exp, rotation_log
from flangeye.units import SI
from flangeye_plugins.weld.touch.tag_observation import TagReading


@dataclass(frozen=True, eq=False)
class HeldReading:
    """One reading of the tag with the tip held in the punch mark.

    Attributes:
        reading: Pose of the tag.
        displacement: (3,) displacement of the tip from its rest position, in the tool's axes [m].
        force: (3,) force on the finger in the tool's axes [N]; None if not measured.
    """

    reading: TagReading
    displacement: Floats
    force: Floats | None = None


def calibrate(rest: Sequence[TagReading], held: Sequence[HeldReading], source: str) -> Calibration:
    """Return the finger's calibration, fitted to readings by least squares.

    Args:
        rest: Readings of the undeformed finger.
        held: Readings with the tip held and displaced along all three axes.
        source: Text for the file: when and how it was measured.

    Raises:
        StageError: There are too few readings, no motion along one axis, or the tip slid.
    """
    if min(len(rest), len(held)) < 10:
        raise StageError(
            f"calibration: the tag was seen {len(rest)} times at rest and {len(held)} times held; "
            f"at least 10 each are needed"
        )
    place = np.mean([r.translation for r in rest], axis=0)
    tag = np.array([h.reading.translation for h in held]) - place
    tip = np.array([h.displacement for h in held])
    gain = _gain(tag, tip)
    left = tip - tag @ gain.T
    unexplained = float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
    if unexplained > 0.2e-3:
        raise StageError(
            f"calibration: the tag's motion leaves {unexplained * 1e3:.2f} mm of the tip's "
            f"motion unexplained, at most 0.20 mm are allowed; did the tip slide in its mark?"
        )
    # In the tip's coordinates: what a measurement of the seam will have.
    noise = np.std([gain @ (r.translation - place) for r in rest], axis=0)
    turns = np.array([rotation_exp(r.rotation) for r in rest])
    lateral, axial = _stiffness(held)
    return Calibration.model_validate(
        {
            "rest": _si(place),
            "rotation": _si(rotation_log(nearest_rotation(turns.mean(axis=0)))),
            "gain": gain.tolist(),
            "noise": _si(noise),
            "lateral": lateral,
            "axial": axial,
            "source": source,
        }
    )


def _gain(tag: Floats, tip: Floats) -> Floats:
    moved = np.linalg.svd(tip, compute_uv=False)
    # Singular values of the tip's motion: the smallest is how far it went in the least used
    # direction.
    if moved[-1] < 0.1 * moved[0]:
        raise StageError("calibration: the robot did not move the finger along all three axes")
    # Row vectors: tip = tag @ gain.T
    solution, *_ = np.linalg.lstsq(tag, tip, rcond=None)
    return np.asarray(solution.T)


def _stiffness(held: Sequence[HeldReading]) -> tuple[SI | None, SI | None]:
    """Return the stiffness across and along the finger [N/m]; None without measured forces."""
    known = [h for h in held if h.force is not None]
    if not known:
        return None, None
    # The finger is a spring: the force on it is opposite to its displacement.
    force = np.array([h.force for h in known])
    tip = np.array([h.displacement for h in known])
    if np.abs(force).max() < 0.5:  # [N]: smaller forces are within a force sensor's error
        return None, None
    # Least-squares slope per axis, means removed: a force sensor's zero drops out.
    slopes = -np.sum((force - force.mean(0)) * (tip - tip.mean(0)), 0) / np.sum(
        (tip - tip.mean(0)) ** 2, 0
    )
    return SI(abs(float(slopes[:2].mean()))), SI(abs(float(slopes[2])))


def _si(values: Floats) -> tuple[SI, ...]:
    return tuple(SI(float(v)) for v in values)

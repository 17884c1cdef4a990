"""Whether a pose that somebody typed can be meant, and what they may have meant instead."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from flangeye.maths.geometry import rotation_log
from flangeye.maths.pose_formats import CONVENTIONS, AngleUnit, LengthUnit, PoseConvention
from flangeye.types import Floats


class Tolerance(NamedTuple):
    """How near to the pose asked for a pose has to be.

    Attributes:
        distance: [m]
        angle: [rad]
    """

    distance: float
    angle: float


def fault(
    numbers: Floats,
    convention: PoseConvention,
    reach: float,
    asked: Floats | None,
    tolerance: Tolerance,
) -> str | None:
    """Return what is strange about a pose, and the probable mistake; None if nothing is.

    Args:
        numbers: As typed, in the convention.
        convention: The one that was agreed.
        reach: Reach of the arm, from the origin of its base [m].
        asked: (4, 4) where the arm was to go; None where any pose will do.
        tolerance: How near to it counts as there.
    """
    pose = convention.matrix(numbers)
    if asked is not None:
        off = _apart(asked, pose)
        if off.distance <= tolerance.distance and off.angle <= tolerance.angle:
            return None
        complaint = (
            f"that is {off.distance * 1e3:.1f} mm and {np.degrees(off.angle):.1f} deg from the "
            "pose asked for"
        )
        return _with_hint(complaint, _meant(numbers, convention, asked, tolerance))
    distance = float(np.linalg.norm(pose[:3, 3]))
    # A pose this much farther than the arm is long is not the arm's
    if distance > 1.1 * reach:
        complaint = f"that is {distance:.4g} m from the base, and the arm is {reach:.2f} m long"
        return _with_hint(complaint, _unit(convention))
    if distance < reach / 200:
        complaint = f"that is {distance * 1e3:.1f} mm from the middle of the base"
        return _with_hint(complaint, _unit(convention))
    return None


def _with_hint(complaint: str, hint: str | None) -> str:
    return f"{complaint}: {hint}?" if hint else complaint


def _unit(convention: PoseConvention) -> str:
    return f"is the position in {_other_length(convention)}, not in {convention.length}"


def _other_length(convention: PoseConvention) -> LengthUnit:
    return "m" if convention.length == "mm" else "mm"


def _meant(
    numbers: Floats, convention: PoseConvention, asked: Floats, tolerance: Tolerance
) -> str | None:
    """Return the reading of the numbers that puts the arm where it was asked to go."""
    for hint, reading in _readings(numbers, convention):
        try:
            off = _apart(asked, reading[0].matrix(reading[1]))
        except ValueError:
            continue
        if off.distance <= tolerance.distance and off.angle <= tolerance.angle:
            return hint
    return _tool(convention.matrix(numbers), asked, tolerance)


def _readings(
    numbers: Floats, convention: PoseConvention
) -> Iterator[tuple[str, tuple[PoseConvention, Floats]]]:
    """Yield other ways to read the numbers, the simplest mistake first."""
    length = _other_length(convention)
    angle: AngleUnit = "rad" if convention.angle == "deg" else "deg"
    in_length = convention.in_units(length, convention.angle)
    yield _unit(convention), (in_length, numbers)
    if not convention.is_quaternion:
        wrong_angle = f"are the angles in {angle}, not in {convention.angle}"
        in_angle = convention.in_units(convention.length, angle)
        yield wrong_angle, (in_angle, numbers)
        both = f"{_unit(convention)}, and {wrong_angle}"
        yield both, (convention.in_units(length, angle), numbers)
    for other in CONVENTIONS.values():
        if other.rotation != convention.rotation and other.count == convention.count:
            hint = f"are these numbers in the order and meaning of {other.name}"
            yield hint, (other.in_units(convention.length, other.angle), numbers)
    backwards = np.concatenate([numbers[:3], numbers[:2:-1]])
    yield "are the angles in the opposite order", (convention, backwards)


def _tool(pose: Floats, asked: Floats, tolerance: Tolerance) -> str | None:
    """Return a hint where only a tool can lie between the pose and the flange."""
    off = _apart(asked, pose)
    in_flange = asked[:3, :3].T @ (pose[:3, 3] - asked[:3, 3])
    # How far from the flange's axis a tool's tip is looked for [m]
    along_axis = np.hypot(in_flange[0], in_flange[1]) < 0.02 and in_flange[2] > 0
    if off.angle <= tolerance.angle and along_axis:
        return f"is a tool of {in_flange[2] * 1e3:.0f} mm set; the flange's pose is asked for"
    return None


def _apart(asked: Floats, pose: Floats) -> Tolerance:
    """Return how far two (4, 4) poses are apart."""
    angle = float(np.linalg.norm(rotation_log(asked[:3, :3].T @ pose[:3, :3])))
    return Tolerance(float(np.linalg.norm(asked[:3, 3] - pose[:3, 3])), angle)

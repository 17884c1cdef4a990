"""A guess of the scanner's pose before the first scan, good enough to plan poses in view."""

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.scanners import ScannerModel, middle_of_view
from flangeye.plugin.stage import Params, PlaceParams, part
from flangeye.types import Floats
from flangeye.types.geometry import basis_of_plane, rigid
from flangeye.units import Angle, Length, param


class GuessParams(PlaceParams):
    """Parameters of ``view.guess``."""

    position: tuple[Length, Length, Length]
    """Rough position of the scanner in the base."""
    rpy: tuple[Angle, Angle, Angle] = param(("180 deg", "0 deg", "-90 deg"))
    """Roll, pitch, yaw; the default looks down."""


@part("view.guess")
def view_guess(arm: Arm, scanner: ScannerModel, params: GuessParams) -> Floats:
    """Use the operator's estimate of the scanner's position; a tape measure is good enough.

    Returns:
        (4, 4) base_T_camera.
    """
    return params.matrix


class ShownParams(Params):
    """Parameters of ``view.shown``."""

    joints: tuple[tuple[Angle, ...], ...] = Field(min_length=3)
    """Joint angles of three or more poses at which the flange faces the scanner, as the pendant
    shows them."""


@part("view.shown")
def view_shown(arm: Arm, scanner: ScannerModel, params: ShownParams) -> Floats:
    """Estimate the scanner's pose from jogged poses in which the flange faces it.

    The scanner's position is the point closest to all flange axes. If they are nearly parallel, it
    is at the scanner's working distance ahead of the flanges' mean. The rotation about the optical
    axis stays unknown. It is not needed, as poses are planned within the smaller angle of view.

    Returns:
        (4, 4) base_T_camera.

    Raises:
        StageError: The poses do not fit the arm, or do not look at one place.
    """
    flanges = _flanges(arm, params.joints)
    places, axes = flanges[:, :3, 3], flanges[:, :3, 2]
    mean = axes.mean(axis=0) / np.linalg.norm(axes.mean(axis=0))
    apart = float(np.arccos(np.clip(axes @ mean, -1.0, 1.0)).max())
    # Axes of shown flanges are farther apart than this [rad]: they do not look at one scanner.
    widest = 0.6
    if apart > widest:
        raise StageError(
            f"view.shown: in one pose the flange faces {np.degrees(apart):.0f} deg away from the "
            f"others' mean direction, allowed {np.degrees(widest):.0f} deg; show poses that face "
            f"the "
            "scanner"
        )
    middle = places.mean(axis=0)
    distance = float(np.linalg.norm(middle_of_view(scanner, np.eye(4))))
    eye = _nearest_to_axes(places, axes, middle + distance * mean)
    view = (middle - eye) / np.linalg.norm(middle - eye)
    x, y, _ = basis_of_plane(view)
    return rigid(np.stack([x, y, view], axis=1), eye)


def _flanges(arm: Arm, joints: Sequence[Sequence[float]]) -> Floats:
    lengths = {len(row) for row in joints}
    if lengths != {arm.n}:
        raise StageError(
            f"view.shown: a pose has {' or '.join(map(str, sorted(lengths)))} joint angles, "
            f"the arm {arm.n} joints"
        )
    return arm.flange(np.array(joints))


def _nearest_to_axes(places: Floats, axes: Floats, expected: Floats) -> Floats:
    """Return the point (3,) nearest to lines (N, 3), pulled weakly to where it is expected."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    pull = 0.01 * len(places)
    normal = across.sum(axis=0) + pull * np.eye(3)
    return np.asarray(
        np.linalg.solve(normal, (across @ places[:, :, None]).sum(axis=0)[:, 0] + pull * expected)
    )

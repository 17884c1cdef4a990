"""Inverse kinematics of six revolute joints in closed form, by EAIK. Arrays only.

EAIK decomposes an arm into Paden-Kahan subproblems (Ostermeier, Külz, Althoff, "Automatic Geometric
Decomposition for Analytical Inverse Kinematics", IEEE RA-L 2025): spherical wrists, three parallel
axes, and most arms sold are one or the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from flangeye.types import Floats

ClosedForm = Callable[[Floats], Floats]
"""(4, 4) base_T_flange -> (K, 6) joint angles near its solutions [rad]."""


class Undecomposed(ArithmeticError):
    """EAIK met a pose that its decomposition of the arm does not solve."""


def closed_form(directions: Floats, points: Floats, flange: Floats) -> ClosedForm | None:
    """Return the closed form of an arm, or of the nominal one it differs from a little.

    Args:
        directions: (6, 3) of the axes, all joints at zero.
        points: (6, 3) one on each axis [m].
        flange: (4, 4) base_T_flange, all joints at zero.

    Returns:
        None where EAIK is not installed or knows no decomposition. The closed form raises
        :class:`Undecomposed` where EAIK fails at a pose.
    """
    forms = (_decomposed(*axes, flange) for axes in as_meant(directions, points))
    return next((form for form in forms if form is not None), None)


def as_meant(directions: Floats, points: Floats) -> Iterator[tuple[Floats, Floats]]:
    """Yield (6, 3) directions and points of axes, and those of the arm they may be a copy of.

    A calibrated arm differs a little from one whose axes are parallel, meet or are in line.
    """
    yield directions, points
    snapped = np.round(directions)
    if np.allclose(np.linalg.norm(snapped, axis=1), 1.0):
        yield snapped, _snapped(snapped, points)


def _snapped(directions: Floats, points: Floats) -> Floats:
    """Return (6, 3) points that agree in every coordinate in which axes nearly meet."""
    snapped = points.copy()
    for i, k in np.argwhere(directions == 0):  # along its axis a point may be anywhere
        others = snapped[:i][directions[:i, k] == 0, k]
        # Axes of a calibrated arm that were meant to meet or to be in line do so within this [m]
        near = np.abs(others - points[i, k]) < 5e-3
        snapped[i, k] = others[near][0] if near.any() else points[i, k]
    return snapped


def _decomposed(directions: Floats, points: Floats, flange: Floats) -> ClosedForm | None:
    try:
        from eaik.pybindings.EAIK import Robot
    except ImportError:
        return None
    # EAIK's subproblems hold for axes that point alike where they are parallel.
    signs = np.sign(directions[np.arange(6), np.abs(directions).argmax(axis=1)])
    places = np.vstack([np.zeros(3), points, flange[:3, 3]])
    try:
        robot = Robot(signs * directions.T, np.diff(places, axis=0).T, flange[:3, :3], [], True)
    except RuntimeError:
        return None
    if not robot.has_known_decomposition():
        return None

    def solve(base_T_flange: Floats) -> Floats:
        try:
            joints: Floats = np.asarray(robot.calculate_IK(base_T_flange).Q).reshape(-1, 6)
        except RuntimeError as error:
            raise Undecomposed(str(error)) from None
        return np.asarray(signs * joints)

    return solve

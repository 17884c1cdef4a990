"""Inverse kinematics of six revolute joints whose wrist is not spherical. Arrays only.

In most such arms axis 2 is square to axis 1 and parallel to axis 3, and axis 5 intersects axis 4.
The intersection is fixed in link 3 and in link 5, so with joint 6 held the pose determines its
place. Joints 1 to 3 follow in closed form, on four branches. One equation is left, in joint 6: axes
4 and 5 keep their angle. Its roots are bracketed on a grid of angles and refined (a search in one
dimension over Paden-Kahan subproblems: Elias and Wen, "IK-Geo", Mechanism and Machine Theory 2025).

Closed forms of other arms come from EAIK, which decomposes an arm into Paden-Kahan subproblems
(Ostermeier, Külz, Althoff, "Automatic Geometric Decomposition for Analytical Inverse Kinematics",
IEEE RA-L 2025): spherical wrists, three parallel axes, and most arms sold are one or the other.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats, Indices

ComplexNumbers = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class OffsetWrist:
    """An arm with an offset wrist, and its inverse kinematics.

    Its frame has z along axis 1, y along axis 2 at zero, and its origin on axis 1. Vectors in the
    plane normal to axis 2 are complex numbers z + ix, so that a turn of joint 2 or 3 is a product
    with a number of length one. For joint 1 likewise y - ix.

    Attributes:
        to_axes: (4, 4) from the base to that frame; its origin is on axis 1 at axis 2's height.
        from_zero: (4, 4) inverse of the flange's pose in that frame, all joints at zero.
        orbits: (4, 6) intersection of axes 4 and 5 (homogeneous), and direction of axis 5. Three
            columns each: columns @ (cos, sin, 1) is the vector with joint 6 turned back.
        shoulder: Offset of axis 2 from axis 1 [m].
        aside: Coordinate of the intersection of axes 4 and 5 along axis 2 [m].
        upper: Vector from axis 2 to axis 3, normal to them [m].
        fore: Vector from axis 3 to the intersection of axes 4 and 5, normal to axis 3 [m].
        sense: 1 if axis 3 points as axis 2 does, else -1.
        fourth: (3,) direction of axis 4.
        meant: Cosine of the angle between axes 4 and 5.
        about_fourth: (2, 3) axis 4 cross axis 5, and the part of axis 5 normal to axis 4.
        about_fifth: (6, 3) the same with axes 4 and 5 exchanged, as joint 6 turns: three pairs of
            rows, to be weighted by (cos, sin, 1).
    """

    to_axes: Floats
    from_zero: Floats
    orbits: Floats
    shoulder: float
    aside: float
    upper: complex
    fore: complex
    sense: float
    fourth: Floats
    meant: float
    about_fourth: Floats
    about_fifth: Floats

    def __call__(self, base_T_flange: Floats) -> Floats:
        """Return (K, 6) joint angles at or near the solutions for a (4, 4) pose [rad]."""
        moved = self.to_axes @ base_T_flange @ self.from_zero
        x, y, z, hx, hy, hz = (
            (moved[:3] @ self.orbits).reshape(3, 2, 3).swapaxes(0, 1).reshape(6, 3)
        )
        orbits = np.array([y - 1j * x, z, hx + 1j * hy, hz])
        orbits[1, 2] -= 1j * self.shoulder
        with np.errstate(invalid="ignore", divide="ignore"):
            brackets, seeds = self._brackets(orbits)
            angles = np.concatenate([self._refined(orbits, brackets), seeds[1]])
            ways = np.concatenate([brackets[0], seeds[0]]).astype(int)
            return self._joints(moved[:3, :3], orbits, angles, ways)

    def _posture(
        self, orbits: ComplexNumbers, angles: Floats, way: Indices
    ) -> tuple[
        Floats,
        tuple[ComplexNumbers, ComplexNumbers],
        tuple[ComplexNumbers, ComplexNumbers, ComplexNumbers],
    ]:
        """Return the error of the angle between axes 4 and 5, and the steps that led to it.

        Args:
            orbits: (4, 3) intersection of axes 4 and 5, and axis 5, by (cos, sin, 1) of joint 6.
            angles: (...) angles of joint 6 [rad].
            way: (...) branch of joints 1 to 3, 0 to 3.

        Returns:
            The error, axis 5 as two numbers, and joints 1 to 3 as complex numbers whose arguments
            are the angles plus a constant; each (...), NaN where the arm does not reach.
        """
        seen = orbits @ _circle(angles.ravel())
        place, height, axis, upwards = seen.reshape(4, *angles.shape)
        shoulder, elbow = np.array([[1j, 1j, -1j, -1j], [1j, -1j, 1j, -1j]])[:, way]
        # Joint 1: the wrist is `aside` from the plane of the upper arm, so the rest of its
        # distance from axis 1 lies before or behind that axis
        across = place.real**2 + place.imag**2
        forward = shoulder * np.sqrt(across - self.aside**2)
        turn = place * (forward + self.aside) / across
        reach = height + forward
        upper, fore = abs(self.upper), abs(self.fore)
        # Joint 3: the law of cosines in the triangle of upper arm, forearm and reach; its root is
        # NaN where the reach is too long or too short
        squares = reach.real**2 + reach.imag**2
        cosine = (squares - (upper**2 + fore**2)) * (0.5 / (upper * fore))
        bend = cosine + elbow * np.sqrt(1.0 - cosine * cosine)
        lift = reach / (1.0 + (fore / upper) * bend)
        level = axis * turn.conjugate()
        ahead = lift * bend * (complex(self.fourth[2], self.fourth[0]) * fore / upper / self.fore)
        value = ahead.imag * level.real + ahead.real * upwards.real - self.meant
        return value + self.fourth[1] * level.imag, (axis, upwards), (turn, lift, bend)

    def _brackets(self, orbits: ComplexNumbers) -> tuple[Floats, Floats]:
        """Return intervals with a sign change, and angles near which a root may be missed.

        Each row of samples is one branch; doubtful places are sampled more closely.

        Returns:
            (5, K) branch, two angles and the values there; (2, S) branch and angle.
        """
        # One sample more at each end: each has both its neighbours
        ways, starts = np.arange(4), np.array([-np.pi])
        # Angles of joint 6 at which the equation is looked at.
        samples = 128
        pitch, row = 2 * np.pi / samples, np.arange(-1.0, samples + 1)
        doubts = np.zeros(0)
        found = []
        # Each pass but the first puts so many samples for one where a root may hide
        finer = 16
        for _ in range(3):
            angles = starts[:, None] + pitch * row
            values = self._posture(orbits, angles, ways[:, None])[0]
            angles = np.broadcast_to(angles, values.shape)
            here, after = values[:, 1:-1], values[:, 2:]
            i, k = np.nonzero(here * after <= 0)
            places = angles[i, k + 1]
            found.append(np.array([ways[i], places, places + pitch, here[i, k], after[i, k]]))
            # The law of cosines ends in a square root, so where the reach ends the equation may
            # change by this over one pitch
            i, k = np.nonzero(_doubtful(values, 2.0 * np.sqrt(pitch)))
            ways, doubts = ways[i], angles[i, k + 1]
            if not len(ways):
                break
            starts, row, pitch = doubts - pitch, np.arange(-1.0, 2 * finer + 1), pitch / finer
        return np.hstack(found), np.array([ways, doubts])

    def _refined(self, orbits: ComplexNumbers, brackets: Floats) -> Floats:
        """Return the roots (K,) in brackets (5, K).

        By inverse quadratic interpolation, or bisection where that leads out of a bracket.
        """
        way, (a, b, fa, fb) = brackets[0].astype(int), brackets[1:]
        at = a + (b - a) * fa / (fa - fb)
        # Most roots take two steps
        root_steps = 12
        for _ in range(root_steps):
            value = self._posture(orbits, at, way)[0]
            same = value * fa > 0
            c, fc = np.where(same, a, b), np.where(same, fa, fb)
            b, fb = np.where(same, b, a), np.where(same, fb, fa)
            a, fa = at, value
            ab, bc, ca = fa - fb, fb - fc, fc - fa
            at = (a * fb * fc * bc + b * fc * fa * ca + c * fa * fb * ab) / -(ab * bc * ca)
            at = np.where((at - a) * (at - b) <= 0, at, (a + b) / 2)
            # So near to a root the next step is the last
            if np.abs(value).max(initial=0.0) < 1e-7:
                break
        return np.asarray(at)

    def _joints(
        self, turned: Floats, orbits: ComplexNumbers, angles: Floats, way: Indices
    ) -> Floats:
        """Return joint angles (K, 6) for angles (K,) of joint 6 and branches (K,)."""
        _, (axis, upwards), (turn, lift, bend) = self._posture(orbits, angles, way)
        second = lift / self.upper
        third = bend * (abs(self.fore) * self.upper / (self.fore * abs(self.upper)))
        both = second * third
        both = both / np.abs(both)
        # Axis 5 as link 3 sees it, and axis 4 as link 5 does: one turns about 4, the other about 5.
        level = axis * turn.conjugate()
        plane = (upwards + 1j * level.real) * both.conjugate()
        fourth = self.about_fourth @ np.array([plane.imag, level.imag, plane.real])
        plane = both * complex(self.fourth[2], self.fourth[0])
        level = (plane.imag + 1j * self.fourth[1]) * turn
        ahead = turned.T @ np.array([level.real, level.imag, plane.real])
        fifth = np.einsum(
            "ijk,ik->jk", (self.about_fifth @ ahead).reshape(3, 2, -1), _circle(angles)
        )
        joints = np.angle([turn, second, third])
        joints[2] *= self.sense
        wrist = [np.arctan2(*fourth), -np.arctan2(*fifth), angles]
        found = np.vstack([joints, wrist]).T
        return np.asarray(found[np.isfinite(found).all(axis=1)])


def offset_wrist(directions: Floats, points: Floats, flange: Floats) -> OffsetWrist | None:
    """Return the solver of an arm; of the nominal arm if this one differs from it by little.

    Args:
        directions: (6, 3) directions of the axes, all joints at zero.
        points: (6, 3) one on each axis [m].
        flange: (4, 4) base_T_flange, all joints at zero.

    Returns:
        None if the axes are not arranged as this method needs.
    """
    searches = (_prepared(*axes, flange) for axes in snapped_axes(directions, points))
    return next((search for search in searches if search is not None), None)


def _prepared(directions: Floats, points: Floats, flange: Floats) -> OffsetWrist | None:
    first, second, third, fourth, fifth, _ = directions
    normal = np.cross(fourth, fifth)
    between = points[4] - points[3]
    sine = np.linalg.norm(normal)
    exact = 1e-9  # axes that meet, are parallel or are square do so within this [m, rad]
    if abs(first @ second) > exact or np.linalg.norm(np.cross(second, third)) > exact:
        return None
    if sine < 0.1 or abs(normal @ between) > exact:
        return None
    met = points[3] + fourth * (np.cross(between, fifth) @ normal / sine**2)
    to_axes = np.eye(4)
    to_axes[:3, :3] = np.array([np.cross(second, first), second, first])
    height = first * (first @ (points[1] - points[0]))
    to_axes[:3, 3] = -to_axes[:3, :3] @ (points[0] + height)
    _, p2, p3, *_, p6, p45 = np.vstack([points, met]) @ to_axes[:3, :3].T + to_axes[:3, 3]
    *_, h4, h5, h6 = directions @ to_axes[:3, :3].T
    at_sixth = np.append(p6, 1.0)[:, None] * np.array([0.0, 0.0, 1.0])
    about_fourth = np.array([np.cross(h4, h5), h5 - h4 * (h4 @ h5)])
    about_fifth = np.array([np.cross(h5, h4), h4 - h5 * (h4 @ h5)])
    along, cross = np.outer(h6, h6), np.cross(np.eye(3), h6)
    return OffsetWrist(
        to_axes,
        np.asarray(np.linalg.inv(to_axes @ flange)),
        np.hstack([_orbit(h6, p45 - p6) + at_sixth, _orbit(h6, h5)]),
        shoulder=float(p2[0]),
        aside=float(p45[1]),
        upper=_across(p3 - p2),
        fore=_across(p45 - p3),
        sense=float(np.sign(second @ third)),
        fourth=h4,
        meant=float(h4 @ h5),
        about_fourth=about_fourth,
        about_fifth=np.vstack([about_fifth @ part for part in (np.eye(3) - along, cross, along)]),
    )


def _doubtful(values: Floats, change: float) -> Floats:
    """Return the mask of samples (M, S) near which two roots may lie between neighbours.

    The first and last samples are left out. Two roots without a change of sign between samples may
    lie at an extremum close to zero, and where the arm's reach ends.
    """
    before, here, after = values[:, :-2], values[:, 1:-1], values[:, 2:]
    size, bent, slope = np.abs(here), before - 2 * here + after, after - before
    # Two roots may hide where the equation comes this near to zero, in its second differences
    dips = (size < 0.25 * np.abs(bent)) & (np.abs(slope) < 2 * np.abs(bent)) & (here * bent > 0)
    dips &= (here * before > 0) & (here * after > 0)
    return np.asarray(dips | (np.isnan(slope) & (size < change)))


def _circle(angles: Floats) -> Floats:
    return np.array([np.cos(angles), np.sin(angles), np.ones_like(angles)])


def _orbit(axis: Floats, vector: Floats) -> Floats:
    """Return M (4, 3): M @ (cos a, sin a, 1) is a vector rotated by -a about an axis."""
    along = axis * (axis @ vector)
    return np.vstack([np.array([vector - along, -np.cross(axis, vector), along]).T, np.zeros(3)])


def _across(vector: Floats) -> complex:
    return complex(vector[2], vector[0])


InverseForm = Callable[[Floats], Floats]
"""(4, 4) base_T_flange -> (K, 6) joint angles near its solutions [rad]."""


class DecompositionFailed(ArithmeticError):
    """EAIK cannot solve a pose with its decomposition of the arm."""


def closed_form(directions: Floats, points: Floats, flange: Floats) -> InverseForm | None:
    """Return the closed form of an arm, or of the nominal one it differs from a little.

    Args:
        directions: (6, 3) directions of the axes, all joints at zero.
        points: (6, 3) one on each axis [m].
        flange: (4, 4) base_T_flange, all joints at zero.

    Returns:
        None where EAIK is not installed or knows no decomposition. The closed form raises
        :class:`DecompositionFailed` where EAIK fails at a pose.
    """
    forms = (_decomposed(*axes, flange) for axes in snapped_axes(directions, points))
    return next((form for form in forms if form is not None), None)


def snapped_axes(directions: Floats, points: Floats) -> Iterator[tuple[Floats, Floats]]:
    """Yield (6, 3) directions and points of the axes, then those of the nominal arm if one is near.

    A calibrated arm differs a little from one whose axes are parallel, meet or are in line.
    """
    yield directions, points
    snapped = np.round(directions)
    if np.allclose(np.linalg.norm(snapped, axis=1), 1.0):
        yield snapped, _snapped(snapped, points)


def _snapped(directions: Floats, points: Floats) -> Floats:
    """Return points (6, 3) with coordinates made equal where axes nearly meet."""
    snapped = points.copy()
    for i, k in np.argwhere(directions == 0):  # along its axis a point may be anywhere
        others = snapped[:i][directions[:i, k] == 0, k]
        # Axes of a calibrated arm that nominally intersect or coincide do so within this [m]
        near = np.abs(others - points[i, k]) < 5e-3
        snapped[i, k] = others[near][0] if near.any() else points[i, k]
    return snapped


def _decomposed(directions: Floats, points: Floats, flange: Floats) -> InverseForm | None:
    try:
        from eaik.pybindings.EAIK import Robot
    except ImportError:
        return None
    # EAIK expects parallel axes to point the same way; a reversed axis reverses its angle.
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
            raise DecompositionFailed(str(error)) from None
        return np.asarray(signs * joints)

    return solve

"""Pose conventions of controllers and files: a pose as a row of numbers.

A pose is a (4, 4) ``parent_T_child`` in metres here and nowhere else. Outside it is a position and
a rotation vector, a quaternion, or three angles about axes in some order. The sources of each
maker's convention are beside its entry in :data:`CONVENTIONS`.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Literal, Self

import numpy as np

from flangeye.types.arrays import Floats
from flangeye.types.geometry import (
    quaternion_from_rotation,
    rigid,
    rotation_exp,
    rotation_from_quaternion,
    rotation_log,
)

LengthUnit = Literal["m", "cm", "mm"]
AngleUnit = Literal["rad", "deg"]
_Token = Mapping[str, str | Any]

NORM_TOLERANCE = 1e-3
"""Tolerance of a quaternion's length: four printed digits pass, other numbers do not."""

EULER_ORDERS = tuple(
    "".join(axes)
    for letters in ("xyz", "XYZ")
    for axes in product(letters, repeat=3)
    if axes[0] != axes[1] != axes[2]
)
"""The twelve orders about fixed axes (``xyz``, extrinsic) and about turned ones (``ZYX``,
intrinsic), spelt as scipy spells them."""

LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
"""Units in which positions are written, in metres."""
ANGLES = {"rad": 1.0, "deg": math.pi / 180}
"""Units in which angles are written, in radians."""


@dataclass(frozen=True)
class PoseConvention:
    """One way to write a pose.

    Attributes:
        name: Shown in messages and reports.
        labels: Name of each number, position first.
        rotation: ``vector``, a quaternion's order (``xyzw``, ``wxyz``) or one of
            :data:`EULER_ORDERS`, in which angles are written in the order of their axes.
        length: Unit of the position.
        angle: Unit of a rotation vector's length and of angles; a quaternion has none.
        makers: Makers whose controllers use this form, as the catalogue of robots spells them.
        program: Regular expression of a position in a program, a group for each number.
        program_length: Unit of the positions there.
    """

    name: str
    labels: tuple[str, ...]
    rotation: str
    length: LengthUnit
    angle: AngleUnit = "rad"
    makers: tuple[str, ...] = ()
    program: str = ""
    program_length: LengthUnit = "mm"

    def __post_init__(self) -> None:
        known = ("vector", "xyzw", "wxyz", *EULER_ORDERS)
        if self.rotation not in known:
            raise ValueError(f"no rotation '{self.rotation}'; known: {', '.join(known)}")
        if len(self.labels) != self.count:
            raise ValueError(f"{self.name}: {self.count} numbers need as many labels")

    @property
    def is_quaternion(self) -> bool:
        """Whether the rotation is four numbers without a unit."""
        return self.rotation in ("xyzw", "wxyz")

    @property
    def count(self) -> int:
        """Number of values in a pose."""
        return 7 if self.is_quaternion else 6

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each number; empty for a quaternion's."""
        return (self.length,) * 3 + (("",) * 4 if self.is_quaternion else (self.angle,) * 3)

    def in_units(self, length: LengthUnit, angle: AngleUnit) -> Self:
        """Return the same convention in other units."""
        return replace(self, length=length, angle=angle)

    def matrix(self, numbers: Sequence[float] | Floats) -> Floats:
        """Return the pose (4, 4) [m] of a row of numbers.

        Raises:
            ValueError: Their count is wrong, one is not finite, or a quaternion's norm is not 1.
        """
        values = np.asarray(numbers, dtype=np.float64)
        if values.shape != (self.count,):
            raise ValueError(
                f"{self.name} has {self.count} numbers ({' '.join(self.labels)}), not {values.size}"
            )
        if not np.isfinite(values).all():
            raise ValueError(f"{self.name}: a number is not finite")
        return rigid(self._rotation(values[3:]), values[:3] * LENGTHS[self.length])

    def numbers(self, matrix: Floats) -> Floats:
        """Return the row of numbers (6,) or (7,) of a pose (4, 4) [m].

        A rotation vector is at most half a turn long, a quaternion has w >= 0. Where two of three
        angles turn about the same axis, the third is zero.
        """
        position = matrix[:3, 3] / LENGTHS[self.length]
        return np.concatenate([position, self._written(matrix[:3, :3])])

    def read(self, text: str) -> Floats:
        """Return the pose (4, 4) [m] of typed or pasted text; see :meth:`read_numbers`.

        Raises:
            ValueError: As :meth:`read_numbers`, or as :meth:`matrix`.
        """
        return self.matrix(self.read_numbers(text))

    def read_numbers(self, text: str) -> Floats:
        """Return the row of numbers of typed or pasted text, in the convention's units.

        Numbers stand in order, or in any order each behind its label, as a pendant shows them;
        brackets, separators and what else has a label are passed over. A number with a unit of
        its own (``0.4 m``) counts in that unit.

        Raises:
            ValueError: A number is missing, surplus, or has a unit of another kind.
        """
        text = text.replace("\N{MINUS SIGN}", "-")
        # Position and rotation of a RAPID robtarget; configuration and further axes come
        # behind.
        if nested := re.search(r"\[\s*\[([^\]]*)\]\s*,\s*\[([^\]]*)\]", text):
            text = f"{nested[1]} {nested[2]}"
        found = self._in_order(
            [
                match.groupdict()
                for match in re.finditer(
                    r"(?:(?P<label>[A-Za-z][A-Za-z0-9]*)\s*[:=]?\s*)?"
                    r"(?<![\d.])(?P<number>[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)"
                    r"(?:\s*(?P<unit>mm|m|deg|rad|°)(?![A-Za-z]))?",
                    text,
                )
            ]
        )
        return np.array([self._in_own_unit(i, token) for i, token in enumerate(found)])

    def text(self, matrix: Floats) -> str:
        """Return a pose (4, 4) [m] as a person reads it, to 0.01 mm and 0.001 deg."""
        digits = {"m": 5, "cm": 3, "mm": 2, "deg": 3, "rad": 5, "": 6}
        written = []
        for label, number, unit in zip(self.labels, self.numbers(matrix), self.units, strict=True):
            # Adding zero takes the sign off a zero.
            rounded = round(number, digits[unit]) + 0.0
            written.append(f"{label} {rounded:.{digits[unit]}f} {unit}".rstrip())
        return "  ".join(written)

    def _in_order(self, found: list[_Token]) -> list[_Token]:
        labelled = {token["label"].upper(): token for token in found if token["label"]}
        wanted = {label: labelled.get(label.upper()) for label in self.labels}
        if not any(wanted.values()):
            return found
        missing = [label for label, token in wanted.items() if token is None]
        if missing:
            raise ValueError(f"{self.name}: there is no {' and no '.join(missing)}")
        return [token for token in wanted.values() if token is not None]

    def _rotation(self, values: Floats) -> Floats:
        if self.is_quaternion:
            norm = float(np.linalg.norm(values))
            if abs(norm - 1) > NORM_TOLERANCE:
                raise ValueError(
                    f"{self.name}: the quaternion's norm is {norm:.4g}; "
                    f"it must be 1 (within {NORM_TOLERANCE})"
                )
            return rotation_from_quaternion(
                values if self.rotation == "xyzw" else values[[1, 2, 3, 0]]
            )
        radians = values * ANGLES[self.angle]
        return (
            rotation_exp(radians)
            if self.rotation == "vector"
            else _from_euler(self.rotation, radians)
        )

    def _written(self, rotation: Floats) -> Floats:
        if self.is_quaternion:
            q = quaternion_from_rotation(rotation)
            return q if self.rotation == "xyzw" else q[[3, 0, 1, 2]]
        radians = (
            rotation_log(rotation)
            if self.rotation == "vector"
            else _to_euler(self.rotation, rotation)
        )
        return np.asarray(radians / ANGLES[self.angle])

    def _in_own_unit(self, index: int, token: _Token) -> float:
        value = float(token["number"])
        unit = (token["unit"] or "").replace("°", "deg")
        if not unit or index >= self.count:
            return value
        own = self.units[index]
        for table in (LENGTHS, ANGLES):
            if unit in table and own in table:
                return value * table[unit] / table[own]
        raise ValueError(
            f"{self.name}: {self.labels[index]} has the unit {unit}, not {own or 'none'}"
        )


def _from_euler(order: str, radians: Floats) -> Floats:
    turns = [rotation_exp(angle * _axis(name)) for name, angle in zip(order, radians, strict=True)]
    first, second, third = reversed(turns) if order.islower() else turns
    return np.asarray(first @ second @ third)


def _axis(name: str) -> Floats:
    return np.asarray(np.eye(3)["xyz".index(name.lower())])


def _to_euler(order: str, rotation: Floats) -> Floats:
    """Return the (3,) angles about axes in an order; at gimbal lock, of many, that with the last 0.

    Bernardes and Viollet, "Quaternion to Euler angles conversion" (PLOS ONE, 2022).
    """
    *vector, w = quaternion_from_rotation(rotation)
    i, j, k = ("xyz".index(name) for name in (order if order.islower() else order[::-1].lower()))
    proper = i == k
    k = 3 - i - j
    sign = (i - j) * (j - k) * (k - i) // 2
    a, b, c, d = w, vector[i], vector[j], vector[k] * sign
    if not proper:
        a, b, c, d = a - c, b + d, c + a, d - b
    middle = 2 * np.arctan2(np.hypot(c, d), np.hypot(a, b))
    half_sum, half_difference = np.arctan2(b, a), np.arctan2(d, c)
    angles = np.array([half_sum - half_difference, middle, half_sum + half_difference])
    if not order.islower():
        angles = angles[::-1]
    # So near to gimbal lock [rad] only the sum of the first and the last angle is known
    locked = 1e-7
    if middle < locked:
        angles[[0, 2]] = 2 * half_sum, 0.0
    elif middle > np.pi - locked:
        angles[[0, 2]] = 2 * half_difference * (-1 if order.islower() else 1), 0.0
    if not proper:
        angles[2 if order.islower() else 0] *= sign
        angles[1] -= np.pi / 2
    # To half a turn at most; half a turn less a rounding error back is half a turn.
    return np.asarray(angles - 2 * np.pi * np.ceil(angles / (2 * np.pi) - 0.5 - 1e-12))


_N = r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)"
"""A number in a program."""


def _list_of(count: int) -> str:
    return r"\s*" + r"\s*,\s*".join([_N] * count) + r"\s*"


def _spaced(count: int) -> str:
    return r"\s+".join([_N] * count)


def _named(names: str, number: str) -> str:
    """Return a pattern of numbers behind their names: ``X 1.5, Y 2``."""
    return r"\s*,\s*".join(name + number for name in names)


CONVENTIONS: Mapping[str, PoseConvention] = {
    # PolyScope's Move tab in its default units; URScript's p[...] is the same in metres.
    "ur": PoseConvention(
        "UR", ("X", "Y", "Z", "RX", "RY", "RZ"), "vector", "mm", "rad",
        ("Universal Robots",), rf"\bp\[{_list_of(6)}\]", "m",
    ),
    # KUKA System Software, operating manual: A about Z, B about the turned Y, C about the turned X.
    "kuka": PoseConvention(
        "KUKA ABC", ("X", "Y", "Z", "A", "B", "C"), "ZYX", "mm", "deg",
        ("KUKA",), _named("XYZABC", rf"\s+{_N}"),
    ),
    # FANUC operator's manual: W about X, P about Y, R about Z, the axes of the user frame.
    "fanuc": PoseConvention(
        "Fanuc WPR", ("X", "Y", "Z", "W", "P", "R"), "xyz", "mm", "deg", ("FANUC", "Fanuc"),
        _named("XYZ", rf"\s*=\s*{_N}\s*mm") + r"\s*,\s*" + _named("WPR", rf"\s*=\s*{_N}\s*deg"),
    ),
    # ABB RAPID reference, data type orient: q1 is the real part.
    "abb": PoseConvention(
        "ABB", ("X", "Y", "Z", "Q1", "Q2", "Q3", "Q4"), "wxyz", "mm", "rad",
        ("ABB",), rf"\[\s*\[{_list_of(3)}\]\s*,\s*\[{_list_of(4)}\]",
    ),
    # Yaskawa operator's manual: as Fanuc.
    "yaskawa": PoseConvention(
        "Yaskawa", ("X", "Y", "Z", "RX", "RY", "RZ"), "xyz", "mm", "deg", ("Yaskawa",)
    ),
    # Mitsubishi's MELFA BASIC: P1=(X,Y,Z,A,B,C)(FL1,FL2), about fixed axes.
    "mitsubishi": PoseConvention(
        "Mitsubishi", ("X", "Y", "Z", "A", "B", "C"), "xyz", "mm", "deg", ("Mitsubishi",),
        rf"=\s*\({_list_of(6)}[^()]*\)\s*\(",
    ),
    # Epson RC+: U, V, W about Z, Y, X, turned axes.
    "epson": PoseConvention(
        "Epson", ("X", "Y", "Z", "U", "V", "W"), "ZYX", "mm", "deg", ("Epson",)
    ),
    # Staubli VAL 3 reference, data type trsf: Rx, Ry, Rz about turned axes.
    "staubli": PoseConvention(
        "Staubli", ("X", "Y", "Z", "RX", "RY", "RZ"), "XYZ", "mm", "deg", ("Stäubli", "Staubli")
    ),
    # Kawasaki AS reference: orientation, altitude, tool; ZYZ about turned axes.
    "kawasaki": PoseConvention(
        "Kawasaki OAT", ("X", "Y", "Z", "O", "A", "T"), "ZYZ", "mm", "deg", ("Kawasaki",)
    ),
    # Doosan programming manual (DRL), posx: A, B, C are Euler angles ZYZ.
    "doosan": PoseConvention(
        "Doosan", ("X", "Y", "Z", "A", "B", "C"), "ZYZ", "mm", "deg", ("Doosan Robotics",)
    ),
    # MVTec HALCON, create_pose with 'gba': Rx Ry Rz about turned axes, metres. The program is what
    # write_pose writes: representation 0, then the rotation, then the translation.
    "halcon": PoseConvention(
        "HALCON", ("X", "Y", "Z", "RX", "RY", "RZ"), "XYZ", "m", "deg",
        program=rf"\nf 0\s(?=[^+]{{0,200}}?\nt {_spaced(3)})[^+]{{0,200}}?\nr {_spaced(3)}",
        program_length="m",
    ),
    # ROS REP 103, and the URDF: fixed axes.
    "rpy": PoseConvention("roll pitch yaw", ("X", "Y", "Z", "ROLL", "PITCH", "YAW"), "xyz", "m"),
    # The program is what ROS's tf_echo prints.
    "quaternion_xyzw": PoseConvention(
        "quaternion", ("X", "Y", "Z", "QX", "QY", "QZ", "QW"), "xyzw", "m",
        program=rf"Translation:\s*\[{_list_of(3)}\][-\s]*Rotation:\s*in Quaternion[^\[]*"
        rf"\[{_list_of(4)}\]", program_length="m",
    ),
    "quaternion_wxyz": PoseConvention(
        "quaternion", ("X", "Y", "Z", "QW", "QX", "QY", "QZ"), "wxyz", "m"
    ),
}  # fmt: skip
"""The conventions people meet, by name; others are made from :class:`PoseConvention`. Readers,
``flangeye init``, the doctor, drivers and exports use these rows."""


def convention_of_maker(maker: str | None) -> str | None:
    """Return the name of the convention that a maker's controllers use; None if not known."""
    return next((name for name, c in CONVENTIONS.items() if maker in c.makers), None)


MATRIX, APART = "matrix", "3x3"
"""Rotations that are not numbers of a convention: 12 or 16 numbers row by row, and 9 behind a
position."""
QUATERNIONS = ("xyzw", "wxyz")
PLAIN = (*QUATERNIONS, "vector", *EULER_ORDERS)
"""Rotations that no maker's name stands for."""

RotationConvention = tuple[str, str | None]
"""How rotations are written, and in which unit of angle, where that matters."""


def is_known(rotation: object) -> bool:
    """Whether rotations are written as a maker does, or in a plain way, and not as a matrix."""
    return rotation in (*CONVENTIONS, *PLAIN)


def plain_rotation(rotation: str) -> str:
    """Return a maker's rotation convention; other names are returned unchanged."""
    return CONVENTIONS[rotation].rotation if rotation in CONVENTIONS else rotation


def other_conventions(rotation: str, angle: str | None) -> Iterator[RotationConvention]:
    """Yield other conventions with as many values, angles in both units; none for a matrix."""
    if not is_known(rotation):
        return
    if plain_rotation(rotation) in QUATERNIONS:
        yield from ((other, None) for other in QUATERNIONS if other != rotation)
        return
    for other in ("vector", *EULER_ORDERS):
        yield from ((other, unit) for unit in ("rad", "deg") if (other, unit) != (rotation, angle))


def describe_rotation(rotation: str, angle: str | None = None) -> str:
    """Return a convention of rotations in words."""
    rotation = plain_rotation(rotation)
    names = {
        "xyzw": "a quaternion x, y, z, w",
        "wxyz": "a quaternion w, x, y, z",
        "vector": "a rotation vector",
        "ZYX": "KUKA's A, B, C (ZYX about turned axes)",
        "xyz": "roll, pitch, yaw or Fanuc's W, P, R (xyz about fixed axes)",
    }
    about = "turned" if rotation.isupper() else "fixed"
    name = names.get(rotation, f"angles {rotation} about {about} axes")
    return f"{name} in {'radians' if angle == 'rad' else 'degrees'}" if angle else name


def written(rotation: str, length: LengthUnit, angle: AngleUnit) -> PoseConvention:
    """Return the convention of a rotation, given a maker's name or an order, in given units."""
    known = CONVENTIONS.get(rotation)
    plain = known.rotation if known else rotation
    labels = ("x", "y", "z", "a", "b", "c", "d")[: 7 if plain in QUATERNIONS else 6]
    return PoseConvention(rotation, labels, plain, length, angle)


def pose_of_numbers(
    numbers: Floats, rotation: str, length: LengthUnit, angle: AngleUnit = "rad"
) -> Floats:
    """Return the pose (4, 4) [m] of a row of numbers.

    Args:
        numbers: (k,), position first, or a matrix row by row; one of 16 numbers whose last column
            is 0, 0, 0, 1 stands column by column.
        rotation: A name in :data:`CONVENTIONS`, one of :data:`PLAIN`, ``matrix`` or ``3x3``.
        length: Unit of the position.
        angle: Unit of angles, or of a rotation vector's length.

    Raises:
        ValueError: They are not a pose in this convention.
    """
    if rotation not in (MATRIX, APART):
        return written(rotation, length, angle).matrix(numbers)
    count, sizes = ("3 and 9", (12,)) if rotation == APART else ("12 or 16", (12, 16))
    if numbers.size not in sizes:
        raise ValueError(f"a matrix has {count} numbers, not {numbers.size}")
    if rotation == APART:
        rows = np.column_stack([numbers[3:].reshape(3, 3), numbers[:3]])
    else:
        rows = numbers.reshape(-1, 4)
        rows = rows.T if by_columns(numbers[None]) else rows
        if len(rows) == 4 and tuple(rows[3]) != (0, 0, 0, 1):
            raise ValueError("is not a rigid transform (its last row is not 0 0 0 1)")
    return nearest_rigid(rows[:3] * np.array([1, 1, 1, LENGTHS[length]]))


def by_columns(matrices: Floats) -> bool:
    """Return whether all matrices (N, k) of 16 numbers are stored by columns, not by rows."""
    if matrices.shape[1] != 16:
        return False
    columns, rows = matrices[:, 3::4] == [0, 0, 0, 1], matrices[:, 12:] == [0, 0, 0, 1]
    return bool(columns.all() and not rows.all())


def nearest_rigid(matrix: Floats) -> Floats:
    """Return the rigid pose (4, 4) nearest to a matrix (3, 4) written with few digits.

    Raises:
        ValueError: A value is not finite, or the rotation is none.
    """
    if not np.isfinite(matrix).all():
        raise ValueError("has values that are not finite")
    rotation = matrix[:, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > NORM_TOLERANCE or np.linalg.det(rotation) < 0:
        raise ValueError(
            f"is not a rigid transform (its rotation is {error:.2g} from orthonormal, "
            f"at most {NORM_TOLERANCE} is allowed)"
        )
    u, _, vt = np.linalg.svd(rotation)
    return rigid(u @ vt, matrix[:, 3])

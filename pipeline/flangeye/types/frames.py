"""Points, frames, transforms between them, and how well these are known."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic_core import core_schema

from flangeye.types.arrays import Array, FloatArray, Floats, Singles, freeze, frozen

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in one frame, unorganised (N, 3) or organised (H, W, 3); a missing point is NaN.

    Single precision: at one metre it resolves 0.06 um, a thousandth of the best scanner's noise.

    Attributes:
        frame: Frame the points are expressed in.
        xyz: (N, 3) or (H, W, 3) positions [m], float32.
    """

    frame: str
    xyz: Singles

    def __init__(self, frame: str, xyz: ArrayLike) -> None:
        xyz = np.asarray(xyz, dtype=np.float32)
        if xyz.ndim not in (2, 3) or xyz.shape[-1] != 3:
            raise ValueError(f"a cloud is (N, 3) or (H, W, 3), not {xyz.shape}")
        view = xyz.view()
        view.setflags(write=False)
        object.__setattr__(self, "frame", frame)
        object.__setattr__(self, "xyz", view)

    @property
    def organised(self) -> bool:
        """Whether neighbours in the array are neighbours in the scanner's image."""
        return self.xyz.ndim == 3

    def points(self) -> Singles:
        """Return the (M, 3) points that are finite."""
        flat = self.xyz.reshape(-1, 3)
        return flat[np.isfinite(flat).all(axis=1)]

    @classmethod
    def __get_pydantic_core_schema__(cls, _source: Any, _handler: Any) -> core_schema.CoreSchema:
        # Points never travel as JSON: the log writes them as foxglove.PointCloud.
        return core_schema.is_instance_schema(cls)

    @classmethod
    def __get_pydantic_json_schema__(cls, _schema: Any, _handler: Any) -> dict[str, Any]:
        return {
            "description": "The points are on the channel with this channel's name plus /cloud."
        }


BASE, FLANGE, CAMERA, TARGET, TOOL = "base", "flange", "camera", "target", "tool"


BASE2, FLANGE2 = "base2", "flange2"


class FrameMismatchError(ValueError):
    """Two values that meet are not expressed in the same frame."""


@dataclass(frozen=True, eq=False)
class Transform:
    """Rigid transform ``parent_T_child``.

    Attributes:
        parent: Frame the result is expressed in.
        child: Frame the input is expressed in.
        matrix: (4, 4) homogeneous matrix, translation in [m].
    """

    parent: str
    child: str
    matrix: Array

    def __post_init__(self) -> None:
        for frame in (self.parent, self.child):
            # Names of frames are identifiers: they reach recipes, logs and other
            # programs' files
            if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]{0,63}", frame):
                raise ValueError(f"{frame[:80]!a} is not a valid frame name: letters, digits and _")
        freeze(self, matrix=(4, 4))
        rotation = self.matrix[:3, :3]
        # Not np.allclose: poses come 500 times a second, and it takes 30 us.
        # Entries of a rotation are within 1; the product of far larger ones overflows.
        small = np.abs(rotation).max() < 2.0
        orthonormal = small and np.abs(rotation @ rotation.T - np.eye(3)).max() < 2e-5
        if not orthonormal or np.linalg.det(rotation) < 0 or tuple(self.matrix[3]) != (0, 0, 0, 1):
            raise ValueError(f"{self.name} is not a rigid transform")

    @classmethod
    def named(cls, name: str, matrix: Any) -> Transform:
        """Return the transform of a name such as ``base_T_camera``.

        Raises:
            ValueError: The name is not of that form, or the matrix is not rigid.
        """
        parent, _, child = name.partition("_T_")
        return cls(parent, child, matrix)

    @property
    def name(self) -> str:
        """``parent_T_child``."""
        return f"{self.parent}_T_{self.child}"

    @property
    def rotation(self) -> Floats:
        """Rotation ``parent_R_child`` (3, 3)."""
        return self.matrix[:3, :3]

    @property
    def translation(self) -> Floats:
        """Origin (3,) of ``child`` in ``parent`` [m]."""
        return self.matrix[:3, 3]

    def __matmul__(self, other: Transform) -> Transform:
        """Return ``parent_T_other``; refuse frames that do not meet."""
        self._require(self.child, other.parent)
        return Transform(self.parent, other.child, self.matrix @ other.matrix)

    def apply(self, xyz: FloatArray) -> Floats:
        """Map (..., 3) coordinates in ``child`` to coordinates in ``parent``."""
        return np.asarray(xyz, dtype=np.float64) @ self.rotation.T + self.translation

    def apply_cloud(self, cloud: PointCloud) -> PointCloud:
        """Return the cloud expressed in ``parent``; refuse a cloud in another frame."""
        self._require(self.child, cloud.frame)
        return PointCloud(self.parent, self.apply(cloud.xyz).astype(np.float32))

    def inverse(self) -> Transform:
        """Return ``child_T_parent``."""
        inverted = np.eye(4)
        inverted[:3, :3] = self.rotation.T
        inverted[:3, 3] = -self.rotation.T @ self.translation
        return Transform(self.child, self.parent, inverted)

    def _require(self, expected: str, got: str) -> None:
        if expected != got:
            raise FrameMismatchError(f"{self.name} acts on frame '{expected}', not on '{got}'")


Poses = Mapping[str, Transform]
"""Poses that the controllers reported, by the frame that each places: flange, rail, …"""


def by_frame(*transforms: Transform | None) -> Poses:
    """Return transforms by their child frame; None is left out."""
    return {each.child: each for each in transforms if each is not None}


class PosedMeasurement:
    """A measurement, with the poses that controllers reported at its time."""

    poses: Poses

    @property
    def base_T_flange(self) -> Transform:
        """Pose of the (first) arm's flange."""
        return self.poses[FLANGE]


@dataclass(frozen=True, eq=False)
class Motion:
    """A flange's motion shortly before and after a capture, from a stream of its poses.

    Attributes:
        times: (K,) from the time of the capture's own pose, rising [s].
        poses: (K, 4, 4) base_T_flange [m].
        others: (K, 4, 4) of what else moved, each in its own base, by frame; a cell's are all here.
        joints: (K, n) of an arm, or of a rail or positioner its one value [rad or m], by the frame
            that they move.
    """

    times: Array
    poses: Array
    others: Mapping[str, Array] = field(default_factory=dict)
    joints: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = len(self.times)
        freeze(self, times=(count,), poses=(count, 4, 4))
        others = {n: frozen(x, (count, 4, 4), f"Motion.{n}") for n, x in self.others.items()}
        object.__setattr__(self, "others", others)
        joints = {
            n: frozen(q, (count, np.shape(q)[-1]), f"Motion.{n}") for n, q in self.joints.items()
        }
        object.__setattr__(self, "joints", joints)


@dataclass(frozen=True, eq=False)
class TransformEstimate:
    """An estimated transform with its covariance.

    Attributes:
        transform: The estimate.
        covariance: (6, 6), order (rotation [rad], translation [m]), left perturbation in the
            parent frame.
        about: (3,) point in the parent frame at which the translation part is taken [m].
        unobservable: (k, 6) unit directions, in the same order and about the same point, that no
            measurement depends on: the estimate is arbitrary along them, and the covariance
            is of the rest.
        shares: (6, 6) of the covariance by cause, where the solver gives them. The rest of it comes
            from the causes' sizes being uncertain.
    """

    transform: Transform
    covariance: Array
    about: Array
    unobservable: Array = field(default_factory=lambda: np.zeros((0, 6)))
    shares: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze(self, covariance=(6, 6), about=(3,))
        parts = {cause: frozen(share, (6, 6), cause) for cause, share in self.shares.items()}
        object.__setattr__(self, "shares", parts)
        directions = np.reshape(self.unobservable, (-1, 6))
        object.__setattr__(self, "unobservable", frozen(directions, directions.shape, "directions"))


@dataclass(frozen=True, eq=False)
class Box:
    """An axis-aligned box in the robot's base: where the work is.

    Attributes:
        centre: (3,) centre of the box [m].
        size: (3,) full edge lengths [m].
    """

    centre: Array
    size: Array

    def __post_init__(self) -> None:
        freeze(self, centre=(3,), size=(3,))

    def grid(self, n: int = 5) -> Floats:
        """Return (n^3, 3) points spread evenly over the box, its faces included."""
        ticks = np.linspace(-0.5, 0.5, n)
        unit = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.asarray(self.centre + unit * self.size)

"""The values that flow between stages, and the conventions they follow.

* SI units and radians; time in nanoseconds since the epoch.
* ``parent_T_child`` maps coordinates in ``child`` to coordinates in ``parent``; points carry the
  name of the frame they are given in. Frames: ``base`` (robot base), ``flange`` (ISO 9409-1: origin
  at the centre of the flange's face, z outwards), ``tool`` (what the controller takes for the
  tool's tip), ``camera`` (scanner, z along the view), ``target`` (what is looked at, z towards the
  scanner), ``link3`` (Denavit-Hartenberg's of that link), ``base2`` and ``flange2`` (of a second
  arm).
* Quaternions are xyzw. Covariances of a transform are 6x6, in the order (rotation, translation),
  of a left perturbation in the parent frame, and say about which point the translation is taken:
  ``x' = about + Exp(phi) (x - about) + tau``.
* Everything is frozen, arrays are read-only, and shapes and finiteness are checked here and
  nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, NewType, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic_core import core_schema

BASE, FLANGE, CAMERA, TARGET, TOOL = "base", "flange", "camera", "target", "tool"
BASE2, FLANGE2 = "base2", "flange2"


class _AsNestedLists:
    """Lets pydantic read and write an array as nested JSON lists, bit for bit."""

    def __init__(self, dtype: type[np.generic]) -> None:
        self._dtype = dtype

    def __get_pydantic_core_schema__(self, _source: Any, _handler: Any) -> core_schema.CoreSchema:
        return core_schema.no_info_plain_validator_function(
            lambda value: np.asarray(value, dtype=self._dtype),
            serialization=core_schema.plain_serializer_function_ser_schema(lambda a: a.tolist()),
        )

    def __get_pydantic_json_schema__(self, _schema: Any, _handler: Any) -> dict[str, Any]:
        return {"type": "array"}


Array = Annotated[NDArray[np.float64], _AsNestedLists(np.float64)]
Pixels = Annotated[NDArray[np.uint8], _AsNestedLists(np.uint8)]
FloatArray = NDArray[np.float32] | NDArray[np.float64]


class FrameMismatchError(ValueError):
    """Two values that meet are not expressed in the same frame."""


def _frozen(value: Any, shape: tuple[int, ...], what: str) -> NDArray[np.float64]:
    """Return a read-only float64 copy of ``value``; refuse another shape or non-finite entries."""
    array = np.array(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{what} has shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{what} holds values that are not finite")
    array.setflags(write=False)
    return array


def _freeze(instance: Any, **shapes: tuple[int, ...]) -> None:
    for name, shape in shapes.items():
        what = f"{type(instance).__name__}.{name}"
        object.__setattr__(instance, name, _frozen(getattr(instance, name), shape, what))


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in one frame, unorganised (N, 3) or organised (H, W, 3); a missing point is NaN.

    Single precision: at one metre it resolves 0.06 um, a thousandth of the best scanner's noise.

    Attributes:
        frame: Frame the points are expressed in.
        xyz: (N, 3) or (H, W, 3) positions [m], float32.
    """

    frame: str
    xyz: NDArray[np.float32]

    def __post_init__(self) -> None:
        xyz = np.asarray(self.xyz, dtype=np.float32)
        if xyz.ndim not in (2, 3) or xyz.shape[-1] != 3:
            raise ValueError(f"a cloud is (N, 3) or (H, W, 3), not {xyz.shape}")
        view = xyz.view()
        view.setflags(write=False)
        object.__setattr__(self, "xyz", view)

    @property
    def organised(self) -> bool:
        """Whether neighbours in the array are neighbours in the scanner's image."""
        return self.xyz.ndim == 3

    def points(self) -> NDArray[np.float32]:
        """Return the (M, 3) points that are finite."""
        flat = self.xyz.reshape(-1, 3)
        return flat[np.isfinite(flat).all(axis=1)]

    @classmethod
    def __get_pydantic_core_schema__(cls, _source: Any, _handler: Any) -> core_schema.CoreSchema:
        # Points never travel as JSON: the log writes them as foxglove.PointCloud.
        return core_schema.is_instance_schema(cls)

    @classmethod
    def __get_pydantic_json_schema__(cls, _schema: Any, _handler: Any) -> dict[str, Any]:
        return {"description": "On the channel named like this one with /cloud added."}


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
        _freeze(self, matrix=(4, 4))
        rotation = self.matrix[:3, :3]
        # Not np.allclose: poses come 500 times a second, and it takes 30 us.
        orthonormal = np.abs(rotation @ rotation.T - np.eye(3)).max() < 2e-5
        if not orthonormal or np.linalg.det(rotation) < 0 or tuple(self.matrix[3]) != (0, 0, 0, 1):
            raise ValueError(f"{self.name} is not a rigid transform")

    @classmethod
    def named(cls, name: str, matrix: Any) -> Transform:
        """Return the transform of a name such as ``base_T_camera``."""
        parent, _, child = name.partition("_T_")
        return cls(parent, child, matrix)

    @property
    def name(self) -> str:
        """``parent_T_child``."""
        return f"{self.parent}_T_{self.child}"

    @property
    def rotation(self) -> NDArray[np.float64]:
        """(3, 3) rotation ``parent_R_child``."""
        return self.matrix[:3, :3]

    @property
    def translation(self) -> NDArray[np.float64]:
        """(3,) origin of ``child`` in ``parent`` [m]."""
        return self.matrix[:3, 3]

    def __matmul__(self, other: Transform) -> Transform:
        """Return ``parent_T_other``; refuse frames that do not meet."""
        self._require(self.child, other.parent)
        return Transform(self.parent, other.child, self.matrix @ other.matrix)

    def apply(self, xyz: FloatArray) -> NDArray[np.float64]:
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


@dataclass(frozen=True, eq=False)
class TransformEstimate:
    """A transform that was estimated, with what is known of its error.

    Attributes:
        transform: The estimate.
        covariance: (6, 6), order (rotation [rad], translation [m]), left perturbation in the
            parent frame.
        about: (3,) point in the parent frame at which the translation part is taken [m].
        unobservable: (k, 6) unit directions, in the same order and about the same point, that no
            measurement tells anything of: the estimate is arbitrary along them, and the covariance
            is of the rest.
    """

    transform: Transform
    covariance: Array
    about: Array
    unobservable: Array = field(default_factory=lambda: np.zeros((0, 6)))

    def __post_init__(self) -> None:
        _freeze(self, covariance=(6, 6), about=(3,))
        directions = np.reshape(self.unobservable, (-1, 6))
        object.__setattr__(
            self, "unobservable", _frozen(directions, directions.shape, "directions")
        )


@dataclass(frozen=True, eq=False)
class Box:
    """An axis-aligned box in the robot's base: where the work is.

    Attributes:
        centre: (3,) [m].
        size: (3,) full edge lengths [m].
    """

    centre: Array
    size: Array

    def __post_init__(self) -> None:
        _freeze(self, centre=(3,), size=(3,))

    def grid(self, n: int = 5) -> NDArray[np.float64]:
        """Return (n^3, 3) points spread evenly over the box, its faces included."""
        ticks = np.linspace(-0.5, 0.5, n)
        unit = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.asarray(self.centre + unit * self.size)


Role = Literal["calibration", "verification"]


@dataclass(frozen=True, eq=False)
class Image:
    """What a calibrated camera saw.

    Attributes:
        pixels: (H, W) grey or (H, W, 3) RGB, uint8.
        camera_matrix: (3, 3) pinhole matrix [px].
        distortion: (k,) OpenCV's distortion coefficients; empty for an undistorted image.
    """

    pixels: Pixels
    camera_matrix: Array
    distortion: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        pixels = np.asarray(self.pixels)
        grey_or_rgb = pixels.ndim == 2 or pixels.shape[2:] == (3,)
        if pixels.dtype != np.uint8 or not grey_or_rgb:
            got = f"{pixels.shape} {pixels.dtype}"
            raise ValueError(f"an image is (H, W) or (H, W, 3) uint8, not {got}")
        view = pixels.view()
        view.setflags(write=False)
        object.__setattr__(self, "pixels", view)
        _freeze(self, camera_matrix=(3, 3), distortion=np.shape(self.distortion))


@dataclass(frozen=True, eq=False)
class Capture:
    """One look at the flange: where the robot says it stood, and what the scanner saw.

    Attributes:
        id: Unique within a run.
        cloud: The scan, in ``camera``; without points where only an image was taken.
        base_T_flange: Pose read from the controller.
        joints: (n,) joint angles [rad], when known.
        time_ns: When the exposure ended.
        role: ``verification`` captures are kept from every solver.
        image: What a camera in the scanner saw, in the same frame, if one looked.
        base2_T_flange2: Where a second arm stood, if there is one.
    """

    id: str
    cloud: PointCloud
    base_T_flange: Transform
    joints: Array | None = None
    time_ns: int = 0
    role: Role = "calibration"
    image: Image | None = None
    base2_T_flange2: Transform | None = None


@dataclass(frozen=True, eq=False)
class FlangeCloud:
    """The part of one scan that is the flange's face and rim.

    Attributes:
        cloud: (N, 3) points in ``camera``, all finite.
        centre: (3,) rough centre of the disc in ``camera`` [m]; a start for fitting.
        normal: (3,) rough unit normal in ``camera``, towards the scanner.
    """

    cloud: PointCloud
    centre: Array
    normal: Array

    def __post_init__(self) -> None:
        _freeze(self, centre=(3,), normal=(3,))


@dataclass(frozen=True, eq=False)
class CircleFeature:
    """A circle fitted to the flange, or a sphere fitted to one mounted on it, in ``camera``.

    Attributes:
        centre: (3,) [m].
        normal: (3,) unit normal of the face, towards the scanner; None where only centres exist.
        radii: Fitted radii by name, for example ``{"rim": .., "bore": ..}`` [m].
        covariance: (3, 3) of the centre [m^2].
        normal_covariance: (3, 3) of the normal, singular along it; None with the normal.
        arc_coverage: Share of the rim's circumference that was seen, 0 to 1; 0 if not known.
        clocking: Angle of the hole pattern about the normal [rad], or None when not visible.
        centre_in_flange: (3,) where the arm carries that centre, in ``flange`` [m]: its origin,
            unless a target is mounted on it.
    """

    centre: Array
    normal: Array | None
    radii: Mapping[str, float]
    covariance: Array
    normal_covariance: Array | None
    arc_coverage: float
    clocking: float | None = None
    centre_in_flange: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        _freeze(self, centre=(3,), covariance=(3, 3), centre_in_flange=(3,))
        if self.normal is not None or self.normal_covariance is not None:
            _freeze(self, normal=(3,), normal_covariance=(3, 3))

    @property
    def centre_covariance(self) -> NDArray[np.float64]:
        """(3, 3) of the centre [m^2]: what every feature has."""
        return self.covariance


@dataclass(frozen=True, eq=False)
class PoseFeature:
    """A target whose whole pose was measured, such as a marker.

    Attributes:
        camera_T_target: Its pose; the target's z points towards the scanner.
        covariance: (6, 6), order (rotation [rad], translation [m]), left perturbation in
            ``camera``, the translation taken at the target's origin.
        figures: What the fit has to tell of its quality, by name, in SI units and pixels.
    """

    camera_T_target: Transform
    covariance: Array
    figures: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _freeze(self, covariance=(6, 6))

    @property
    def centre(self) -> NDArray[np.float64]:
        """(3,) the target's origin in ``camera`` [m]."""
        return self.camera_T_target.translation

    @property
    def normal(self) -> NDArray[np.float64]:
        """(3,) the target's z in ``camera``."""
        return self.camera_T_target.rotation[:, 2]

    @property
    def centre_covariance(self) -> NDArray[np.float64]:
        """(3, 3) of the origin [m^2]."""
        return self.covariance[3:, 3:]


Feature = CircleFeature | PoseFeature
"""What a ``fit`` stage measures of a target, in ``camera``."""


@dataclass(frozen=True, eq=False)
class Rejected:
    """What a per-capture stage returns instead of a value: the capture is set aside, and why."""

    reason: str


@dataclass(frozen=True, eq=False)
class Rejection:
    """A capture that was set aside: which, by which stage, and why."""

    id: str
    stage: str
    reason: str


@dataclass(frozen=True, eq=False)
class Observation:
    """A fitted feature and the robot poses it belongs to: one equation for the solver."""

    id: str
    feature: Feature
    base_T_flange: Transform
    joints: Array | None = None
    base2_T_flange2: Transform | None = None

    @property
    def circle(self) -> CircleFeature:
        """The feature, for those who can use nothing but a circle."""
        if isinstance(self.feature, CircleFeature):
            return self.feature
        raise FrameMismatchError(f"observation {self.id} is a pose, and a circle is needed")

    @property
    def centre_in_mount(self) -> NDArray[np.float64]:
        """(3,) where the link that carries the target has what was seen, if that is known [m]."""
        feature = self.feature
        return feature.centre_in_flange if isinstance(feature, CircleFeature) else np.zeros(3)

    @property
    def tcp_in_base(self) -> NDArray[np.float64]:
        """(3,) the flange's centre, or what it carries, as the controller reports it [m]."""
        return self.base_T_flange.apply(self.centre_in_mount)


@dataclass(frozen=True, eq=False)
class VerificationView:
    """A segmented flange kept from the solver, for verifiers that compare whole clouds."""

    id: str
    flange: FlangeCloud
    base_T_flange: Transform


Look = Callable[[Sequence[Any]], PointCloud]
"""Simulation only: scans bodies, given in ``base``, with the scanner that was calibrated, from
where it stands; gives the cloud in ``camera``. The pose itself stays with the simulation."""

T = TypeVar("T")


class Stream(Generic[T]):
    """Values pulled one at a time, of which those already pulled are kept.

    A solver that has reached its target simply stops iterating: nothing more is acquired.

    Attributes:
        source: What is known of where the values come from.
        total: How many there will be, when known.
        seen: The values pulled so far.
    """

    def __init__(self, items: Iterable[T], source: Source, total: int | None = None) -> None:
        self._items = iter(items)
        self.source = source
        self.total = total
        self.seen: list[T] = []

    def __iter__(self) -> Iterator[T]:
        yield from list(self.seen)
        for item in self._items:
            self.seen.append(item)
            yield item


class Captures(Stream[Capture | Rejection]):
    """What an ``acquire`` stage gives. Captures are large, so those pulled are not kept.

    A source that knows a capture to be useless gives its ``Rejection`` in its place.

    Attributes:
        became: What became of each capture, by id: its observation, or None if it was set aside
            or kept for verifying. A source that chooses its next pose may look here.
        look: Simulation only: scans other things with the same scanner, see :data:`Look`.
    """

    def __init__(
        self,
        items: Iterable[Capture | Rejection],
        source: Source,
        total: int | None = None,
        look: Look | None = None,
    ) -> None:
        super().__init__(items, source, total)
        self.became: dict[str, Observation | None] = {}
        self.look = look

    def __iter__(self) -> Iterator[Capture | Rejection]:
        return self._items

    def close(self) -> None:
        """Tell the source that nothing more is wanted: a generator's ``finally`` runs now."""
        if isinstance(self._items, Generator):
            self._items.close()


class Observations(Stream[Observation]):
    """What a ``solve`` stage takes; an ``acquire`` stage may give it where no clouds exist."""


class Views(list[VerificationView]):
    """The verification views seen so far; they come before the first observation."""


@dataclass(frozen=True, eq=False)
class Truth:
    """What a simulated cell knows and no real one does. No stage can ask for it.

    Attributes:
        camera: Where the camera is, in the frame that carries it.
        others: The other unknowns of the configuration.
    """

    camera: Transform
    others: tuple[Transform, ...] = ()


@dataclass(frozen=True, eq=False)
class Source:
    """Where captures come from.

    Attributes:
        fingerprint: Hash of everything the captures are made from.
        notes: What the person should be told: what was skipped, detected, converted.
        workspace: Where the work is; the box of the flange's centres when not given.
        truth: Simulation only.
    """

    fingerprint: str
    notes: Sequence[str] = ()
    workspace: Box | None = None
    truth: Truth | None = None


@dataclass(frozen=True, eq=False)
class Pair:
    """One observation after solving.

    Attributes:
        observation: What went in.
        residual: (3,) measured centre, mapped to ``base``, minus where the calibration expects
            it: at the TCP (corrected, where the solver corrects the arm), or at the target [m].
        used: Whether it took part in the estimate.
        reason: Why it did not.
    """

    observation: Observation
    residual: Array
    used: bool = True
    reason: str | None = None

    def __post_init__(self) -> None:
        _freeze(self, residual=(3,))


@dataclass(frozen=True, eq=False)
class ArmCorrection:
    """What a solver found wrong with where the arm says its flange is.

    Attributes:
        tool_offset: (3,) the seen circle's centre in ``flange`` [m].
        joint_offsets: (n,) to add to the joint angles [rad], or None.
        joints: (n,) a configuration of the arm on the branch that it was in [rad], from which
            the angles of a pose without any are found; with ``joint_offsets``.
    """

    tool_offset: Array
    joint_offsets: Array | None = None
    joints: Array | None = None

    def __post_init__(self) -> None:
        _freeze(self, tool_offset=(3,))


@dataclass(frozen=True, eq=False)
class HandEye:
    """A calibration that nobody has verified yet.

    Attributes:
        camera: The camera's pose in the frame that carries it: ``base_T_camera`` where it stands
            beside the robot, ``flange_T_camera`` where the robot moves it.
        pairs: Every observation the solver pulled.
        method: Stage that solved it.
        notes: What the solver wants the person to know.
        correction: What it found wrong with the arm; the pose holds with it.
        others: The configuration's other unknowns, such as ``base_T_target``.
    """

    camera: TransformEstimate
    pairs: tuple[Pair, ...]
    method: str
    notes: tuple[str, ...] = ()
    correction: ArmCorrection | None = None
    others: tuple[TransformEstimate, ...] = ()

    @property
    def base_T_camera(self) -> TransformEstimate:
        """The camera's pose in the robot's base, for those who can use nothing else."""
        if self.camera.transform.parent != BASE:
            raise FrameMismatchError(
                f"the calibration is {self.camera.transform.name}, and base_T_camera is needed"
            )
        return self.camera

    @property
    def transforms(self) -> dict[str, TransformEstimate]:
        """Every estimate by its name, the camera's first."""
        return {x.transform.name: x for x in (self.camera, *self.others)}


@dataclass(frozen=True, eq=False)
class PoseError:
    """How far a candidate calibration is off, and where that matters.

    Attributes:
        motion: (4, 4) in ``camera``; takes what was measured onto what was predicted.
        at: (3,) where the work is, in ``camera`` [m].
        base_R_camera: (3, 3) of the candidate, to express the error in ``base``.
    """

    motion: Array
    at: Array
    base_R_camera: Array

    def __post_init__(self) -> None:
        _freeze(self, motion=(4, 4), at=(3,), base_R_camera=(3, 3))


@dataclass(frozen=True, eq=False)
class Verification:
    """What a ``verify`` stage found.

    Attributes:
        passed: Whether the calibration may be used.
        reason: One line: the figure and the limit it was held against.
        figures: Named results in SI units.
        errors: Per-pose errors on poses that took no part [m], by observation id.
    """

    passed: bool
    reason: str
    figures: Mapping[str, float]
    errors: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class VerifiedHandEye(HandEye):
    """A calibration that passed every verification; only the runner makes one."""

    verifications: Mapping[str, Verification] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class WorkpieceScan:
    """What the scanner saw of the workpiece, from where it was calibrated.

    Attributes:
        cloud: In ``camera``.
        source: Where it comes from, for people.
        notes: What the person should be told.
        truth: Simulation only: the true seams by name, (N, 3) in ``base`` [m]. The runner keeps it
            from the stages that plan and weld.
    """

    cloud: PointCloud
    source: str
    notes: tuple[str, ...] = ()
    truth: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Seam:
    """A weld seam as it is planned, in ``base``, from its start to its end.

    Attributes:
        points_in_base: (N, 3) along the root of the groove, N of at least 2 [m].
        openings_in_base: (N, 3) unit vectors out of the groove, towards the torch.
        covariance: (N, 3, 3) of each point: where it is on the workpiece, and the hand-eye pose,
            together [m^2]. Neighbours share most of it.
        half_angle: Between a wall and the opening [rad], or None where it is not known.
        half_width: From the root's plane to a shoulder [m], or None where it is not known.
        source: What it was planned from, for people.
        figures: How well that went, in SI units, by name.
        notes: What the person should be told.
        cloud: The part of the scan around it, in ``base``, for people.
    """

    points_in_base: Array
    openings_in_base: Array
    covariance: Array
    half_angle: float | None = None
    half_width: float | None = None
    source: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    cloud: PointCloud | None = None

    def __post_init__(self) -> None:
        n = len(self.points_in_base)
        _freeze(self, points_in_base=(n, 3), openings_in_base=(n, 3), covariance=(n, 3, 3))
        if n < 2 or not (np.diff(self.arc_length) > 0).all():
            raise ValueError("a seam has at least two points, each at another place than the last")
        if not np.allclose(np.linalg.norm(self.openings_in_base, axis=1), 1.0, atol=1e-6):
            raise ValueError("Seam.openings_in_base are not unit vectors")

    @property
    def arc_length(self) -> NDArray[np.float64]:
        """(N,) way along the seam from its start to each point [m]."""
        steps = np.linalg.norm(np.diff(self.points_in_base, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def tangents(self) -> NDArray[np.float64]:
        """(N, 3) unit vectors along the seam, in the direction of welding."""
        along = np.gradient(self.points_in_base, self.arc_length, axis=0)
        return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class WeldReport:
    """What the tip, the torch and the robot did, in ``base``, in at most a few thousand samples.

    Attributes:
        mode: How the seam was followed.
        completed: Whether the torch came to the seam's end.
        reason: Why it did not; empty when it did.
        planned: (N, 3) the plan [m].
        refined: (M, 3) the seam as the tip felt it; M may be zero [m].
        opening: (3,) unit vector out of the work: deviations are taken across it.
        time: (K,) since the weld began [s].
        tip: (K, 3) where the finger's tip was [m].
        torch: (K, 3) [m].
        robot: (K, 3) where the tip would have been, undeformed: what was commanded [m].
        deflection: (K,) of the tip against the wall, as measured [m].
        wanted: (K,) what was asked of it [m].
        speed: (K,) of the robot's end point along the plane [m/s].
        turn: (K,) angular velocity of the tool [rad/s].
        along: (K,) the torch's way along the plan; the lead-in is before zero [m].
        phases: K names of what the controller was doing.
        figures: By name, in SI units.
        loop: How the loop kept time, by name, in SI units; differs from run to run.
        notes: What the person should be told.
    """

    mode: str
    completed: bool
    reason: str
    planned: Array
    refined: Array
    opening: Array
    time: Array
    tip: Array
    torch: Array
    robot: Array
    deflection: Array
    wanted: Array
    speed: Array
    turn: Array
    along: Array
    phases: tuple[str, ...]
    figures: Mapping[str, float] = field(default_factory=dict)
    loop: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        k = len(self.phases)
        for name in ("refined", "tip", "torch", "robot"):
            if not len(getattr(self, name)):  # JSON does not tell (0, 3) from (0,)
                object.__setattr__(self, name, np.zeros((0, 3)))
        _freeze(self, planned=(len(self.planned), 3), refined=(len(self.refined), 3), opening=(3,))
        _freeze(self, tip=(k, 3), torch=(k, 3), robot=(k, 3))
        for name in ("time", "deflection", "wanted", "speed", "turn", "along"):
            _freeze(self, **{name: (k,)})


@dataclass(frozen=True)
class ArchivePath:
    """What ``--archive`` named on the command line, if anything."""

    path: Path | None = None


class Journal(Protocol):
    """Logs a value under a name, at once, with the step that asked for the journal.

    For what a stage does while it runs: where the arm is, what a loop measured and commanded.
    """

    def __call__(self, name: str, value: Any) -> None:
        """Log ``value``: a dataclass of ours, an :class:`Image`, or plain JSON data."""
        ...


@dataclass(frozen=True)
class Progress:
    """What a solver knows while it still takes poses.

    Attributes:
        poses: How many it has.
        error: No point of the workspace is off by more, with 95 % probability [m]; None while
            no answer can be trusted.
        required: When it stops [m].
    """

    poses: int
    error: float | None
    required: float


@dataclass(frozen=True)
class Resumed:
    """Captures that an earlier run already took, by id; a source leaves them out."""

    done: frozenset[str]


Seed = NewType("Seed", int)
"""The recipe's seed: the only source of randomness a stage may use."""

Solver = Callable[[Sequence[Observation]], HandEye]
"""Solves a subset of the observations again, with the recipe's own solve and refine steps."""

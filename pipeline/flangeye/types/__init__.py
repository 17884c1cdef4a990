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

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NewType, Protocol

import numpy as np

from flangeye.types.arrays import (
    Array,
    FloatArray,
    Floats,
    Indices,
    Mask,
    Note,
    Pixels,
    Singles,
    Warn,
    freeze,
    records_of,
    warnings_of,
)
from flangeye.types.calibration import (
    ArmCorrection,
    CorrectedArm,
    ExpectedError,
    HandEye,
    Pair,
    PoseError,
    SmoothField,
    Solver,
    Verification,
    VerifiedHandEye,
)
from flangeye.types.features import (
    CircleFeature,
    Feature,
    Observation,
    PoseFeature,
    Rejected,
    Rejection,
    VerificationView,
)
from flangeye.types.frames import (
    BASE,
    BASE2,
    CAMERA,
    FLANGE,
    FLANGE2,
    TARGET,
    TOOL,
    Box,
    FrameMismatchError,
    Motion,
    PointCloud,
    Poses,
    Transform,
    TransformEstimate,
    by_frame,
)
from flangeye.types.scans import Capture, FlangeCloud, Image, Role, ScanPlace, WorkpieceScan
from flangeye.types.streams import (
    Captures,
    Earlier,
    Look,
    Observations,
    Source,
    Stream,
    Truth,
    Views,
)

__all__ = [
    "BASE",
    "BASE2",
    "CAMERA",
    "FLANGE",
    "FLANGE2",
    "TARGET",
    "TOOL",
    "ArchivePath",
    "ArmCorrection",
    "Array",
    "Box",
    "CalibratedPose",
    "Capture",
    "Captures",
    "CircleFeature",
    "CorrectedArm",
    "Earlier",
    "ExpectedError",
    "ExportedFile",
    "Feature",
    "FlangeCloud",
    "FloatArray",
    "Floats",
    "FrameMismatchError",
    "HandEye",
    "Image",
    "Indices",
    "Look",
    "Mask",
    "Motion",
    "Note",
    "Observation",
    "Observations",
    "Pair",
    "Pixels",
    "PointCloud",
    "PoseError",
    "PoseFeature",
    "Poses",
    "Progress",
    "Rejected",
    "Rejection",
    "Resumed",
    "Role",
    "ScanPlace",
    "Seam",
    "Seed",
    "Singles",
    "SmoothField",
    "Solver",
    "Source",
    "StageLog",
    "Stream",
    "Transform",
    "TransformEstimate",
    "Truth",
    "Verification",
    "VerificationView",
    "VerifiedHandEye",
    "Views",
    "Warn",
    "WeldReport",
    "WorkpieceScan",
    "by_frame",
    "records_of",
    "warnings_of",
]


@dataclass(frozen=True, eq=False)
class CalibratedPose:
    """Input of an ``export`` stage.

    Attributes:
        transform: Where the camera is in what carries it: ``base_T_camera`` or
            ``flange_T_camera``, translation in [m].
        remarks: Lines that have to stand in the file: what it is, how it was judged, and, for one
            that was refused, that it must not be used. Made printable ASCII, one line each.
        others: For a cell of which no camera was chosen, every other transform that was found; only
            formats that declare to serve cells are given them.
    """

    transform: Transform
    remarks: tuple[str, ...] = ()
    others: tuple[Transform, ...] = ()

    def __post_init__(self) -> None:
        """Make each remark one line of ASCII, which can stand behind any comment mark."""
        object.__setattr__(self, "remarks", tuple(map(_one_line, self.remarks)))

    @property
    def each(self) -> tuple[CalibratedPose, ...]:
        """One calibrated pose for each transform, this one's first."""
        return tuple(replace(self, transform=x, others=()) for x in (self.transform, *self.others))

    @property
    def stands(self) -> bool:
        """Whether the camera is fixed in the base, not carried by the arm."""
        return self.transform.parent == BASE

    def comment(self, mark: str) -> str:
        """Return the remarks as comment lines, each behind ``mark``."""
        return "".join(f"{mark} {line}\n" for line in self.remarks)


def _one_line(text: str) -> str:
    line = " ".join(re.sub(r"[^ -~]", " ", text.encode("ascii", "replace").decode()).split())
    # In a Python file's first two lines it would name the encoding in which all else is read
    return re.sub("coding(?=[:=])", "coding ", line)


@dataclass(frozen=True)
class ExportedFile:
    """Output of an ``export`` stage.

    Attributes:
        name: File name, without a folder.
        text: The content.
        use: One line: where it goes in the other program.
    """

    name: str
    text: str
    use: str = ""

    def __post_init__(self) -> None:
        """Refuse a name that leads out of the folder."""
        if not re.fullmatch(r"\w[\w.-]*", self.name, re.ASCII):
            raise ValueError(f"{self.name!a} is not a plain file name")


@dataclass(frozen=True)
class ArchivePath:
    """The path given by ``--archive``, if any."""

    path: Path | None = None


class StageLog(Protocol):
    """Logs a named value at once, with the step that logs it.

    For what a stage does while it runs: where the arm is, what a loop measured and commanded.
    """

    def __call__(self, name: str, value: Any) -> None:
        """Log ``value``: a dataclass of ours, an :class:`Image`, or plain JSON data."""


@dataclass(frozen=True)
class Progress:
    """The state of a solver that still takes poses.

    Attributes:
        poses: Number of poses so far.
        error: 95 % bound of the error at any point of the workspace [m]; None while there is
            no reliable estimate.
        required: Error at which the solver stops [m].
    """

    poses: int
    error: float | None
    required: float


@dataclass(frozen=True, eq=False)
class Resumed:
    """State of an earlier run that a source continues from.

    Attributes:
        done: Captures that it took, by id; a source leaves them out.
        joints: (n,) angles of the arm at its last capture [rad], if they are known.
    """

    done: frozenset[str]
    joints: Array | None = None


Seed = NewType("Seed", int)
"""The recipe's seed: the only source of randomness a stage may use."""


@dataclass(frozen=True, eq=False)
class Seam:
    """A weld seam as it is planned, in ``base``, from its start to its end.

    Attributes:
        points_in_base: (N, 3) points along the root of the groove, two or more [m].
        openings_in_base: (N, 3) unit vectors out of the groove, towards the torch.
        covariance: (N, 3, 3) covariance of each point, from its place on the workpiece and from
            the hand-eye pose [m^2]. Neighbours share most of it.
        half_angle: Angle between a wall and the opening [rad]; None if unknown.
        half_width: Distance from the root's plane to a shoulder [m], or None where it is not known.
        source: Text that names what the seam was planned from.
        figures: Quality figures of the plan by name, SI units.
        notes: Warnings and records.
        cloud: The part of the scan around the seam, in ``base``, for pictures only.
    """

    points_in_base: Array
    openings_in_base: Array
    covariance: Array
    half_angle: float | None = None
    half_width: float | None = None
    source: str = ""
    figures: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[Note, ...] = ()
    cloud: PointCloud | None = None

    def __post_init__(self) -> None:
        n = len(self.points_in_base)
        freeze(self, points_in_base=(n, 3), openings_in_base=(n, 3), covariance=(n, 3, 3))
        if n < 2 or not (np.diff(self.arc_length) > 0).all():
            raise ValueError("a seam has at least two points, each at another place than the last")
        if not np.allclose(np.linalg.norm(self.openings_in_base, axis=1), 1.0, atol=1e-6):
            raise ValueError("Seam.openings_in_base are not unit vectors")

    @property
    def arc_length(self) -> Floats:
        """Arc length (N,) from the seam's start to each point [m]."""
        steps = np.linalg.norm(np.diff(self.points_in_base, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def tangents(self) -> Floats:
        """Unit vectors (N, 3) along the seam, in the direction of welding."""
        along = np.gradient(self.points_in_base, self.arc_length, axis=0)
        return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class WeldReport:
    """Motion of tip, torch and robot in ``base``, in at most a few thousand samples.

    Attributes:
        mode: Name of the way in which the seam was followed.
        completed: Whether the torch came to the seam's end.
        reason: Reason why it did not; empty if it did.
        planned: (N, 3) the plan [m].
        refined: (M, 3) the seam measured by the tip; M may be zero [m].
        openings: (N, 3) unit vectors out of the work there: deviations are taken across them.
        time: (K,) since the weld began [s].
        tip: (K, 3) position of the finger's tip [m].
        torch: (K, 3) positions of the torch [m].
        robot: (K, 3) commanded position: that of an undeformed tip [m].
        deflection: (K,) deflection of the tip against the wall, as measured [m].
        wanted: (K,) what was asked of it [m].
        speed: (K,) speed of the robot's end point along the plane [m/s].
        turn: (K,) angular velocity of the tool [rad/s].
        along: (K,) the torch's way along the plan; the lead-in is before zero [m].
        phases: K names of what the controller was doing.
        figures: Figures by name, in SI units.
        loop: Timing figures of the loop by name, SI units; they differ from run to run.
        notes: Warnings and records.
        sigma: (K,) standard deviation of the torch's place across the seam [m], or empty.
        bound: (K,) what its distance from the seam does not exceed [m], or empty.
        band: (K,) the same for 95 % of the seam [m], or empty.
        true_torch: (K, 3) simulation only: where the torch really was [m], or empty.
    """

    mode: str
    completed: bool
    reason: str
    planned: Array
    refined: Array
    openings: Array
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
    notes: tuple[Note, ...] = ()
    sigma: Array = field(default_factory=lambda: np.zeros(0))
    bound: Array = field(default_factory=lambda: np.zeros(0))
    band: Array = field(default_factory=lambda: np.zeros(0))
    true_torch: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        k = len(self.phases)
        for name in ("refined", "tip", "torch", "robot", "true_torch"):
            if not len(getattr(self, name)):  # JSON writes (0, 3) as (0,)
                object.__setattr__(self, name, np.zeros((0, 3)))
        n = len(self.planned)
        freeze(self, planned=(n, 3), refined=(len(self.refined), 3), openings=(n, 3))
        freeze(self, tip=(k, 3), torch=(k, 3), robot=(k, 3))
        freeze(self, true_torch=(len(self.true_torch) and k, 3))
        for name in ("sigma", "bound", "band"):
            freeze(self, **{name: (len(getattr(self, name)) and k,)})
        for name in ("time", "deflection", "wanted", "speed", "turn", "along"):
            freeze(self, **{name: (k,)})

    @property
    def opening(self) -> Array:
        """Mean direction (3,) of the openings, for a view of the seam."""
        mean = self.openings.mean(axis=0)
        return np.asarray(mean / np.linalg.norm(mean))

    def openings_beside(self, line: Array) -> Array:
        """Return the openings (M, 3) at points of a line (M, 3) near the plan."""
        away = np.linalg.norm(line[:, None] - self.planned, axis=2)
        return np.asarray(self.openings[away.argmin(axis=1)])

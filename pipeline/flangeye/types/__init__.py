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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NewType, Protocol

from flangeye.types.arrays import Array, FloatArray, Floats, Indices, Mask, Pixels, Singles
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
from flangeye.types.clouds import PointCloud
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
    Poses,
    Transform,
    TransformEstimate,
    by_frame,
)
from flangeye.types.notes import Note, Warn, records_of, warnings_of
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
from flangeye.types.welding import Seam, WeldReport

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
    """What an ``export`` takes.

    Attributes:
        transform: Where the camera is in what carries it: ``base_T_camera`` or
            ``flange_T_camera``, translation in [m].
        remarks: Lines that have to stand in the file: what it is, how it was judged, and, for one
            that was refused, that it must not be used. Made printable ASCII, one line each.
        others: Of a cell of which no camera was chosen, every other transform that was found; only
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
        """Every transform by itself."""
        return tuple(replace(self, transform=x, others=()) for x in (self.transform, *self.others))

    @property
    def stands(self) -> bool:
        """Whether the camera stands in the base, and is not carried by the arm."""
        return self.transform.parent == BASE

    def comment(self, mark: str) -> str:
        """Return the remarks as comment lines, each behind ``mark``."""
        return "".join(f"{mark} {line}\n" for line in self.remarks)


def _one_line(text: str) -> str:
    return " ".join(re.sub(r"[^ -~]", " ", text.encode("ascii", "replace").decode()).split())


@dataclass(frozen=True)
class ExportedFile:
    """What an ``export`` gives.

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
            raise ValueError(f"{self.name!a} is no plain file name")


@dataclass(frozen=True)
class ArchivePath:
    """What ``--archive`` named on the command line, if anything."""

    path: Path | None = None


class StageLog(Protocol):
    """Logs a value under a name, at once, with the step that asked for it.

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


@dataclass(frozen=True, eq=False)
class Resumed:
    """What an earlier run left.

    Attributes:
        done: Captures that it took, by id; a source leaves them out.
        joints: (n,) angles of the arm at its last capture [rad], if they are known.
    """

    done: frozenset[str]
    joints: Array | None = None


Seed = NewType("Seed", int)
"""The recipe's seed: the only source of randomness a stage may use."""

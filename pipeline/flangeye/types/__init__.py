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
from flangeye.types.exports import CalibratedPose, ExportedFile
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
from flangeye.types.running import ArchivePath, Progress, Resumed, Seed, StageLog
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

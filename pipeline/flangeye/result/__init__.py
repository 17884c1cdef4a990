"""``result.json``: the public contract of a run. SI units and radians throughout.

The models below are its definition; ``flangeye schema --result`` prints them as JSON Schema. Runs
of the same recipe, input and seed give the same document bit for bit, ``timing`` aside.
"""

from flangeye.result.calibration import (
    answers_result,
    correction_result,
    expected_error,
    expected_error_result,
    holdout_result,
    observations_result,
    standing_warnings,
    transforms_result,
    true_result,
    truth_result,
    verifications_result,
    warnings_result,
    workspace_result,
)
from flangeye.result.contract import (
    CorrectionResult,
    HoldoutResult,
    Matrix,
    ObservationResult,
    Provenance,
    Result,
    SeamResult,
    SeamTruthResult,
    StageTiming,
    TransformErrorResult,
    TransformResult,
    TruthResult,
    Vector,
    VerificationResult,
    WarningResult,
    WeldResult,
    WeldTruthResult,
    WorkspaceResult,
)
from flangeye.result.exported import calibrated_pose, require_one, result_of_camera, status_of
from flangeye.result.logged import logged_result
from flangeye.result.provenance import library_versions, sha256
from flangeye.result.welding import seam_result, weld_result

__all__ = [
    "CorrectionResult",
    "HoldoutResult",
    "Matrix",
    "ObservationResult",
    "Provenance",
    "Result",
    "SeamResult",
    "SeamTruthResult",
    "StageTiming",
    "TransformErrorResult",
    "TransformResult",
    "TruthResult",
    "Vector",
    "VerificationResult",
    "WarningResult",
    "WeldResult",
    "WeldTruthResult",
    "WorkspaceResult",
    "answers_result",
    "calibrated_pose",
    "correction_result",
    "expected_error",
    "expected_error_result",
    "holdout_result",
    "library_versions",
    "logged_result",
    "observations_result",
    "require_one",
    "result_of_camera",
    "seam_result",
    "sha256",
    "standing_warnings",
    "status_of",
    "transforms_result",
    "true_result",
    "truth_result",
    "verifications_result",
    "warnings_result",
    "weld_result",
    "workspace_result",
]

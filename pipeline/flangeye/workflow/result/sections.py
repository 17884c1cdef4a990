"""The sections of ``result.json``."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from flangeye import types as t
from flangeye.maths.seam_geometry import errors_from, torch_deviation, tube_radii
from flangeye.maths.statistics import rms
from flangeye.models.cell import Cell
from flangeye.models.configuration import mapped_and_expected
from flangeye.types.geometry import rotation_log
from flangeye.workflow.result.contract import (
    AnswerResult,
    AnswersResult,
    CorrectionResult,
    ExpectedErrorResult,
    HoldoutResult,
    ObservationResult,
    Result,
    SeamResult,
    SeamTruthResult,
    TransformErrorResult,
    TransformResult,
    TruthResult,
    VerificationResult,
    WarningResult,
    WeldResult,
    WeldTruthResult,
    WorkspaceResult,
)


def transforms_result(calibration: t.HandEye | None) -> dict[str, TransformResult]:
    """Return the section ``transforms``."""
    if calibration is None:
        return {}
    return {name: _transform(x) for name, x in calibration.transforms.items()}


def _transform(estimate: t.TransformEstimate) -> TransformResult:
    return TransformResult(
        matrix=estimate.transform.matrix.tolist(),
        covariance=estimate.covariance.tolist(),
        about=estimate.about.tolist(),
        unobservable=estimate.unobservable.tolist() if len(estimate.unobservable) else None,
        shares={cause: share.tolist() for cause, share in estimate.shares.items()},
    )


def correction_result(correction: t.ArmCorrection | None) -> CorrectionResult | None:
    """Return a correction as ``result.json`` and ``calibration.yaml`` carry it."""
    return None if correction is None else CorrectionResult.model_validate(correction)


def warnings_result(notes: Iterable[t.Note]) -> list[WarningResult]:
    """Return the section ``warnings``: the notes that need action."""
    return [WarningResult(text=str(note), fix=note.fix) for note in t.warnings_of(notes)]


def standing_warnings(result: Result) -> list[WarningResult]:
    """Return warnings about the result as a whole, in addition to those of its steps.

    They cover unobservable directions, a calibration that no step verified, a session most of whose
    captures were rejected, and a held-out error that contradicts the expected error.
    """
    found = []
    # A turn that is open is that of a round target about its own axis, which no pose would show.
    weak = [
        name for name, each in result.transforms.items()
        if any(any(direction[3:]) for direction in each.unobservable or [])
    ]  # fmt: skip
    if weak:
        text = f"not observable from these poses: some directions of {' and '.join(weak)}"
        found.append((text, "add the poses that flangeye show RUN --outlook names"))
    if result.transforms and result.status == "unverified":
        fix = "add '- verify.holdout' after the solver"
        found.append(("no verify step judged this calibration", fix))
    used, count = sum(o.used for o in result.observations), len(result.observations)
    # Share of captures that a sound session uses at least. Of our choice
    least_used = 0.5
    if used < least_used * count and not (result.refused and used == 0):
        text = f"{count - used} of {count} captures were rejected"
        found.append((text, "look for the cause: flangeye doctor RUN"))
    found += _unlike(result)
    return [WarningResult(text=text, fix=fix) for text, fix in found]


def _unlike(result: Result) -> list[tuple[str, str]]:
    """Return a warning with its fix if expected and held-out error differ significantly.

    95 % of the errors should be below the expected bound. So the measured rms is not above that
    bound by chance, nor the measured 95 % quantile below the expected rms.
    """
    expected, held = result.expected_error, result.holdout
    if expected is None or held is None or (expected.rms <= held.p95 and held.rms <= expected.p95):
        return []
    both = f"held-out error {held.rms * 1e3:.2f} mm rms, expected {expected.rms * 1e3:.2f} mm"
    if held.rms > expected.p95:
        fix = "trust the held-out error; flangeye doctor RUN looks for the cause"
        return [(f"{both}: significantly larger", fix)]
    fix = (
        "trust the expected error: held-out poses do not show what all poses share, such as the "
        "camera's own calibration"
    )
    return [(f"{both}: significantly smaller", fix)]


def expected_error(result: Result) -> tuple[float, float] | None:
    """Return the expected error at the work, rms and 95 % bound [m]; None if not estimated."""
    found = result.expected_error
    return None if found is None else (found.rms, found.p95)


def expected_error_result(calibration: t.HandEye | None) -> ExpectedErrorResult | None:
    """Return the section ``expected_error``."""
    found = calibration and calibration.expected
    return ExpectedErrorResult.model_validate(found) if found else None


def true_result(calibration: t.HandEye | None) -> dict[str, TransformResult]:
    """Return the section ``true``."""
    return {x.transform.name: _transform(x) for x in (calibration.true if calibration else ())}


def answers_result(
    calibration: t.HandEye | None, holdout: HoldoutResult | None
) -> AnswersResult | None:
    """Return the section ``answers``.

    Args:
        calibration: The estimate.
        holdout: Its cross-validation, if a step computed one.
    """
    if calibration is None:
        return None
    corrected = calibration.as_corrected()
    figures = holdout.figures if holdout else {}
    found = {"all": holdout.rms, **figures} if holdout else {}
    return AnswersResult(
        as_reported=_answer(calibration.as_reported(), found.get("all")),
        corrected=corrected and _answer(corrected, found.get("corrected_rms")),
    )


def _answer(calibration: t.HandEye, of_all: float | None) -> AnswerResult:
    return AnswerResult(
        transforms=transforms_result(calibration),
        correction=correction_result(calibration.correction),
        arms={n: CorrectionResult.model_validate(arm) for n, arm in calibration.arms.items()},
        expected_rms=calibration.expected and calibration.expected.rms,
        holdout_rms=of_all,
    )


def observations_result(
    pairs: Sequence[t.Pair], rejections: Sequence[t.Rejection]
) -> list[ObservationResult]:
    """Return the section ``observations`` with every capture, including those rejected early."""
    early = [ObservationResult(id=r.id, used=False, reason=str(r)) for r in rejections]
    return sorted([*map(_observation, pairs), *early], key=lambda o: o.id)


def _observation(pair: t.Pair) -> ObservationResult:
    feature = pair.observation.feature
    circle = feature if isinstance(feature, t.CircleFeature) else None
    alone = pair.observation.camera == t.CAMERA
    return ObservationResult(
        id=pair.observation.id,
        centre_in_camera=feature.centre.tolist(),
        normal_in_camera=None if feature.normal is None else feature.normal.tolist(),
        radii=dict(circle.radii) if circle else None,
        covariance=feature.centre_covariance.tolist(),
        arc_coverage=circle.arc_coverage if circle else None,
        clocking=circle.roll if circle else None,
        tcp_in_base=pair.observation.tcp_in_base.tolist() if alone else None,
        camera=None if alone else pair.observation.camera,
        target=None if alone else pair.observation.target,
        residual=float(np.linalg.norm(pair.residual)),
        residual_in_base=pair.residual.tolist(),
        used=pair.used,
        reason=pair.reason,
    )


def workspace_result(box: t.Box) -> WorkspaceResult:
    """Return the section ``workspace``."""
    return WorkspaceResult.model_validate(box)


def truth_result(
    calibration: t.HandEye, truth: t.Truth, box: t.Box, cell: Cell | None = None
) -> TruthResult:
    """Return the mapping error of the estimate over the workspace, against the truth.

    Directions marked as unobservable do not count.

    Args:
        calibration: The estimate.
        truth: True values from the simulation.
        box: The workspace.
        cell: Structure of the cell; needed if the truth has poses that were not used.
    """
    error = calibration.camera.transform.matrix @ truth.camera.inverse().matrix
    known = {x.name: x for x in (truth.camera, *truth.others)}
    free = calibration.camera.unobservable[:, 3:]
    found = calibration.transforms
    return TruthResult(
        base_T_camera=truth.camera.matrix.tolist() if truth.camera.parent == t.BASE else None,
        transforms={name: x.matrix.tolist() for name, x in known.items()},
        errors={name: _error(found[name], known[name]) for name in found if name in known},
        error_at_centroid=float(_displacement(error, box.centre, free)),
        rms_over_workspace=float(np.sqrt((_displacement(error, box.grid(), free) ** 2).mean())),
        rotation_error=float(np.linalg.norm(rotation_log(error[:3, :3]))),
        at_work=_at_work(calibration.as_reported(), truth.unseen, cell),
        at_work_corrected=_at_work(calibration.as_corrected(), truth.unseen, cell),
    )


def _at_work(
    calibration: t.HandEye | None, unseen: Sequence[t.Observation], cell: Cell | None
) -> float | None:
    """Return the rms distance between the target by camera and by (corrected) arm [m]."""
    if calibration is None or cell is None or not unseen:
        return None
    corrected = cell.corrected(unseen, calibration)
    transforms = {name: x.transform for name, x in calibration.transforms.items()}
    mapped, expected = mapped_and_expected(cell.ends(transforms, corrected), corrected)
    return float(np.sqrt(((mapped - expected) ** 2).sum(axis=1).mean()))


def _error(estimate: t.TransformEstimate, truth: t.Transform) -> TransformErrorResult:
    """Return the error of one transform, without its unobservable directions."""
    error = estimate.transform.matrix @ truth.inverse().matrix
    shift = error[:3, :3] @ estimate.about + error[:3, 3] - estimate.about
    twist = np.concatenate([rotation_log(error[:3, :3]), shift])
    twist -= estimate.unobservable.T @ (estimate.unobservable @ twist)
    return TransformErrorResult(
        rotation=float(np.linalg.norm(twist[:3])), translation=float(np.linalg.norm(twist[3:]))
    )


def _displacement(error: t.Array, points: Any, free: t.Array) -> Any:
    """Return the points' displacements perpendicular to the rows of ``free``."""
    moved = points @ error[:3, :3].T + error[:3, 3] - points
    return np.linalg.norm(moved - moved @ free.T @ free, axis=-1)


def holdout_result(verifications: Mapping[str, t.Verification]) -> HoldoutResult | None:
    """Return the section ``holdout`` from the step that computed one."""
    wanted = {"folds", "rms", "median", "p95"}
    for verification in verifications.values():
        figures = dict(verification.figures)
        if wanted <= figures.keys():
            core = {name: figures.pop(name) for name in wanted}
            return HoldoutResult(
                folds=int(core["folds"]), rms=core["rms"], median=core["median"], p95=core["p95"],
                figures=figures,
            )  # fmt: skip
    return None


def verifications_result(found: Mapping[str, t.Verification]) -> dict[str, VerificationResult]:
    """Return the section ``verifications``."""
    return {step: VerificationResult.model_validate(v) for step, v in found.items()}


def seam_result(seam: t.Seam | None, scan: t.WorkpieceScan | None) -> SeamResult | None:
    """Return the section ``seam``."""
    if seam is None:
        return None
    return SeamResult(
        source=seam.source,
        length=float(seam.arc_length[-1]),
        points=seam.points_in_base.tolist(),
        openings=seam.openings_in_base.tolist(),
        covariance=seam.covariance.tolist(),
        tube=tube_radii(seam).tolist(),
        half_angle=seam.half_angle,
        half_width=seam.half_width,
        figures=dict(seam.figures),
        notes=list(seam.notes),
        truth=_seam_truth(seam, list(scan.truth.values())) if scan and scan.truth else None,
    )


def _seam_truth(seam: t.Seam, true_seams: list[t.Array]) -> SeamTruthResult:
    """Compare with the true seam that is nearest: a workpiece may have several."""
    errors = min((errors_from(seam, truth) for truth in true_seams), key=lambda e: float(e.max()))
    return SeamTruthResult(
        rms=rms(errors),
        max=float(errors.max()),
        inside=float(np.mean(errors <= tube_radii(seam))),
    )


def weld_result(weld: t.WeldReport | None, scan: t.WorkpieceScan | None) -> WeldResult | None:
    """Return the section ``weld``."""
    if weld is None:
        return None
    ticks = np.diff(weld.time, append=weld.time[-1:])
    names = np.array(weld.phases)
    correction = torch_deviation(weld.refined, weld.planned, weld.openings)
    return WeldResult(
        mode=weld.mode,
        completed=weld.completed,
        reason=weld.reason,
        seconds=float(weld.time[-1]) if len(weld.time) else 0.0,
        correction_rms=rms(correction) if len(correction) else None,
        phases={name: float(ticks[names == name].sum()) for name in dict.fromkeys(weld.phases)},
        figures=dict(weld.figures),
        truth=_weld_truth(weld, list(scan.truth.values())) if scan and scan.truth else None,
    )


def _weld_truth(weld: t.WeldReport, true_seams: list[t.Array]) -> WeldTruthResult | None:
    """Return the torch's distance from the nearest true seam, between that seam's ends.

    Left out are the search for the groove, the sweep, the way before the arc was struck (a resumed
    weld first returns to the seam), and later passes, which run beside the seam on purpose.
    """
    torch = weld.true_torch if len(weld.true_torch) else weld.torch
    welds = ~np.isin(weld.phases, ("seeking", "probing", "entering", "returning", "passing"))
    torch = torch[welds & (weld.along >= weld.figures.get("arc_from", 0.0) - 1e-9)]
    lines = [np.asarray(seam) for seam in true_seams]
    found = [torch_deviation(torch, line, weld.openings_beside(line)) for line in lines]
    errors = min((e for e in found if len(e)), key=lambda e: float(e.max()), default=None)
    return None if errors is None else WeldTruthResult(rms=rms(errors), max=float(errors.max()))

"""``flangeye show``: what happened in a run, step by step, and every figure of its result."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from flangeye.cli.console import wrapped, write
from flangeye.files.words import printable
from flangeye.types import records_of
from flangeye.types.geometry import rpy_from_rotation
from flangeye.workflow.result import logged_result, status_of
from flangeye.workflow.result.contract import (
    CorrectionResult,
    HoldoutResult,
    NumberList,
    Result,
    TransformResult,
    TruthResult,
)
from flangeye.workflow.result.sections import expected_error

if TYPE_CHECKING:
    from rich.console import Console

    from flangeye.workflow.log.read import RunLog


def print_details(console: Console, result: Result) -> None:
    """Print verdict, figures, the poses for reported and corrected arm, seam, weld and notes."""
    used = sum(o.used for o in result.observations)
    count = f"{used} of {len(result.observations)} captures used"
    lines = [result.title, f"{status_of(result)}: {count}"]
    lines += [f"refused: {result.refused}"] if result.refused else []
    lines += [f"next step: {result.advice}"] if result.advice else []
    for each in result.warnings:
        lines += [f"warning: {each.text}", f"  -> {each.fix}"]
    for name, estimate in result.transforms.items():
        lines += ["", f"{name} (maps {name.split('_T_')[1]} to {name.split('_T_')[0]}, metres)"]
        lines += ["  " + "  ".join(f"{x:10.6f}" for x in row) for row in estimate.matrix]
        lines += ["", *_uncertainty(name.partition("_T_")[0], estimate)]
    lines += [*_errors(result), *_idle(result), *_answers(result), *_seam(result), *_weld(result)]
    lines += ["", *(f"note: {note}" for note in result.notes)] if result.notes else []
    write(console, "\n".join(_hung(console, line) for line in lines))


def _hung(console: Console, line: str) -> str:
    """Return a line wrapped with a hanging indent; commands and lines of a file are not broken."""
    if line.startswith("  ->") or not console.is_terminal:
        return line.replace("\n", " ")
    return wrapped(console, line, 21 if line.startswith("  ") else 2)


def _uncertainty(parent: str, estimate: TransformResult) -> list[str]:
    rpy = np.degrees(rpy_from_rotation(np.array(estimate.matrix)[:3, :3]))
    unknown = [f"  not observable     {_motion(d)}" for d in estimate.unobservable or []]
    turns = [None if s is None else np.degrees(s) for s in estimate.sigma[:3]]
    shifts = [None if s is None else s * 1e3 for s in estimate.sigma[3:]]
    return [
        f"  roll, pitch, yaw   {rpy[0]:.4f}, {rpy[1]:.4f}, {rpy[2]:.4f} deg",
        f"  one sigma          {_listed(turns, 4)} deg about {parent} x, y, z; "
        f"{_listed(shifts, 3)} mm at the work",
        *unknown,
    ]


def _listed(values: list[float | None], digits: int) -> str:
    return ", ".join("unknown" if x is None else f"{x:.{digits}f}" for x in values)


def _motion(direction: NumberList) -> str:
    """Return ``translation along (0.00, 0.00, 1.00)`` or the like for a unit direction."""
    kinds = (("rotation about", direction[:3]), ("translation along", direction[3:]))
    parts = [(kind, np.array(v)) for kind, v in kinds if np.linalg.norm(v) > 1e-3]
    axes = [(kind, np.round(v / np.linalg.norm(v), 2) + 0.0) for kind, v in parts]
    return " with ".join(f"{kind} ({', '.join(f'{x:.2f}' for x in v)})" for kind, v in axes)


def _errors(result: Result) -> list[str]:
    lines = []
    if found := expected_error(result):
        rms, p95 = found
        lines.append(f"  expected error     {_mm(rms)} rms at the work, 95 % below {_mm(p95)}")
    if h := result.holdout:
        lines.append(
            f"  held-out error     {_mm(h.rms)} rms, {_mm(h.median)} median, "
            f"95 % below {_mm(h.p95)} ({_over(h)})"
        )
    return lines + (_truth(result.truth) if result.truth else [])


def _truth(truth: TruthResult) -> list[str]:
    lines = []
    if truth.at_work is not None:
        figure = f"{_mm(truth.at_work)} rms at poses the solver never saw"
        if truth.at_work_corrected is not None:
            figure += f", {_mm(truth.at_work_corrected)} with the arm corrected"
        lines.append(f"  true at the work   {figure}")
    over = f"{_mm(truth.rms_over_workspace)} rms over the workspace"
    centre = f"{_mm(truth.error_at_centroid)} at its centre"
    turn = f"{np.degrees(truth.rotation_error):.4f} deg"
    return [*lines, f"  true error         {over}, {centre}, {turn}"]


def _over(held: HoldoutResult) -> str:
    """Return which poses the held-out figures cover, and the figure of all poses if it differs."""
    outliers = int(held.figures.get("outliers", 0))
    if not outliers:
        return f"{held.folds} folds over all poses"
    every = _mm(held.figures["rms_all"])
    return f"{held.folds} folds without {outliers} outliers; {every} rms with them"


def _answers(result: Result) -> list[str]:
    """Return the poses for reported and corrected arm; empty without a correction."""
    answers = result.answers
    if answers is None or answers.corrected is None:
        return []
    lines = ["", "Two camera poses: use each only with the arm model that it was estimated for"]
    for name, answer in (
        ("arm as reported", answers.as_reported), ("arm corrected", answers.corrected)
    ):  # fmt: skip
        pose = np.array(next(iter(answer.transforms.values())).matrix)
        at = ", ".join(f"{x * 1e3:z.2f}" for x in pose[:3, 3])
        turn = ", ".join(f"{x:z.3f}" for x in np.degrees(rpy_from_rotation(pose[:3, :3])))
        error = "" if answer.expected_rms is None else f"; {_mm(answer.expected_rms)} rms expected"
        lines.append(f"  {name:<18} ({at}) mm, ({turn}) deg{error}")
    found = [("its correction", answers.corrected.correction)]
    found = [(f"{n}, corrected", arm) for n, arm in answers.corrected.arms.items()] or found
    return [*lines, *(f"  {name:<18} {_correction(each)}" for name, each in found)]


def _correction(found: CorrectionResult | None) -> str:
    """Return a short text on the arm's correction; calibration.yaml has all of its numbers."""
    parts = []
    if found and found.joint_offsets:
        parts.append(f"joints {', '.join(f'{x * 1e3:.2f}' for x in found.joint_offsets)} mrad")
    if found and found.field:
        parts.append(f"a smooth field of {len(found.field.weights)} weights")
    return f"{' and '.join(parts)}; in calibration.yaml"


def _idle(result: Result) -> list[str]:
    shares = [spent.idle for spent in result.timing.values() if spent.idle is not None]
    return [f"  arm idle           {share:.1%} of its session" for share in shares]


def _seam(result: Result) -> list[str]:
    seam = result.seam
    if seam is None:
        return []
    lines = ["", f"seam: {seam.source}"]
    start, end = (", ".join(f"{1e3 * x:.1f}" for x in seam.points[i]) for i in (0, -1))
    lines.append(f"  from ({start}) to ({end}) mm in base, {_mm(seam.length)} along")
    lines.append(f"  tube               95 % within {_mm(max(seam.tube))} of the plan")
    if t := seam.truth:
        told = f"{_mm(t.rms)} rms, {_mm(t.max)} at most, {t.inside:.0%} of it inside the tube"
        lines.append(f"  true error         {told}")
    return lines


def _weld(result: Result) -> list[str]:
    weld = result.weld
    if weld is None:
        return []
    lines = [f"  weld               {weld.mode}, {weld.seconds:.1f} s"]
    if weld.correction_rms is not None:
        lines.append(f"  seam off the plan  {_mm(weld.correction_rms)} rms")
    if weld.truth:
        lines.append(
            f"  torch off the seam {_mm(weld.truth.rms)} rms, {_mm(weld.truth.max)} at most"
        )
    if not weld.completed:
        lines += ["", f"the weld was stopped: {weld.reason}"]
    return lines


def _mm(metres: float) -> str:
    return f"{metres * 1e3:.3f} mm"


def print_log(console: Console, log: RunLog) -> None:
    """Print a run's result, then what happened in it, step by step."""
    from rich.table import Table
    from rich.text import Text

    if result := logged_result(log):
        print_details(console, result)
        write(console, "")
    state = _state(log)
    expected = f" of {log.total}" if log.total else ""
    write(console, _hung(console, f"{log.path}: {state}"))
    # Centres or poses of a target that were found before this run are not captures.
    measured = any(entry.stage.startswith("acquire.") for entry in log.entries)
    arrived = "" if measured else f"{len(log.poses)}{expected} captures arrived, "
    went = f"{len(log.finished)}{expected} measurements" if measured else f"{len(log.finished)}"
    write(console, f"{arrived}{went} went through")
    for note in records_of(log.source.notes) if log.source else ():
        write(console, _hung(console, f"note: {note}"))
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("step", "values", "seconds", "rejected"):
        table.add_column(column, justify="left" if column == "step" else "right")
    rejected = Counter(r.stage for r in log.rejections)
    for step, poses in _by_acquire_step(log).items():
        seconds = sum(pose["seconds"] for pose in poses)
        table.add_row(Text(printable(step)), str(len(poses)), f"{seconds:.2f}", "0")
    for step in dict.fromkeys(entry.step for entry in log.entries):
        entries = [entry for entry in log.entries if entry.step == step]
        seconds = sum(entry.seconds for entry in entries)
        count = rejected[entries[0].stage]
        table.add_row(Text(printable(step)), str(len(entries)), f"{seconds:.2f}", str(count))
    console.print(table)
    for rejection in log.rejections:
        write(console, _hung(console, f"rejected {rejection.id}: {rejection}"))
    if log.finished and not log.complete:
        last = [e for e in log.entries if e.capture == log.finished[-1]]
        after = f", last step {last[-1].step}" if last else ""
        write(console, f"last finished capture: {log.finished[-1]}{after}")


def _state(log: RunLog) -> str:
    if log.damage:
        return "damaged: part of the log cannot be read; the rest is shown"
    if log.complete:
        return "complete"
    if not log.gathered:
        return "incomplete: the run ended early; no capture was recorded"
    return "incomplete: the run ended early; what it recorded is shown"


def _by_acquire_step(log: RunLog) -> dict[str, list[dict[str, Any]]]:
    steps: dict[str, list[dict[str, Any]]] = {}
    for pose in log.poses.values():
        steps.setdefault(pose["step"], []).append(pose)
    return steps

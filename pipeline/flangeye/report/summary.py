"""The top of the report: the verdict, the headline numbers and the matrix, ready to print."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye import result as r
from flangeye import types as t
from flangeye.maths.geometry import quaternion_from_rotation, rpy_from_rotation
from flangeye.report.facts import INCOMPLETE, Facts
from flangeye.report.units import degrees, millimetres

UNKNOWN = "not measured"
_FRAMES = {
    t.BASE: "the robot's base",
    t.FLANGE: "the flange",
    t.CAMERA: "the camera",
    t.TARGET: "the target",
    t.BASE2: "the second robot's base",
    t.FLANGE2: "the second robot's flange",
}


@dataclass(frozen=True)
class Verdict:
    """The first thing to read.

    Attributes:
        kind: verified, unverified, refused or incomplete; also a CSS class.
        label: One or two words.
        sentence: What it means, or why.
    """

    kind: str
    label: str
    sentence: str


def verdict_of(facts: Facts) -> Verdict:
    """Return the verdict and what it means for whoever wants to use the matrix."""
    result = facts.result
    if result.status == "refused":
        return Verdict("refused", "Refused", _sentence(result.refused or "no reason was given"))
    if result.status == INCOMPLETE:
        return Verdict(INCOMPLETE, "Incomplete", _sentence(_how_far(facts)))
    if result.status == "verified":
        reasons = "; ".join(v.reason for v in result.verifications.values())
        return Verdict("verified", "Verified", _sentence(reasons))
    advice = "no verify step checked this calibration; check it before anything relies on it"
    return Verdict("unverified", "Not verified", _sentence(advice))


def _sentence(reason: str) -> str:
    return f"{reason[:1].upper()}{reason[1:]}"


def _how_far(facts: Facts) -> str:
    log = facts.log
    expected = f" of {log.total}" if log.total else ""
    captures = f"{len(log.finished)}{expected} captures were finished"
    solved = "the solver had finished" if facts.estimate else "the solver had not finished"
    return (
        f"the run ended before its result was written: {captures}, {solved}; "
        "this is what the log holds"
    )


@dataclass(frozen=True)
class Headline:
    """One headline number.

    Attributes:
        name: What it is.
        value: The number.
        unit: Its unit, or nothing.
        note: What it is taken over.
    """

    name: str
    value: str
    unit: str
    note: str


def headlines_of(facts: Facts) -> list[Headline]:
    """Return the numbers that decide whether to trust the matrix, errors first."""
    result = facts.result
    figures = []
    if held := result.holdout:
        note = f"on poses left out, {held.folds} folds, over all poses"
        for name, value in (("rms", held.rms), ("median", held.median), ("95 %", held.p95)):
            figures.append(Headline(f"Held-out {name}", millimetres(value), "mm", note))
        if held.figures.get("outliers"):
            value, note = (
                held.figures["rms_inliers"],
                f"without {held.figures['outliers']:.0f} outliers",
            )
            figures.append(Headline("Held-out rms", millimetres(value), "mm", note))
    figures += _expected(result)
    if box := result.workspace:
        note = "95 % of errors over the workspace are below"
        figures.append(Headline("Predicted error", millimetres(box.predicted_p95), "mm", note))
    if truth := result.truth:
        over = "rms over the workspace; the simulation knows"
        figures.append(Headline("True error", millimetres(truth.rms_over_workspace), "mm", over))
        centre = f"at the workspace's centre; rotation {degrees(truth.rotation_error)}°"
        figures.append(Headline("True error", millimetres(truth.error_at_centroid), "mm", centre))
    return [*figures, _poses(facts)]


def _expected(result: r.Result) -> list[Headline]:
    """Return the error to expect at the work, of both answers where there are two."""
    if result.answers is None:
        return []
    named = {"the arm as its controller reports it": result.answers.as_reported}
    if result.answers.corrected:
        named["the arm corrected, with the pose that belongs to it"] = result.answers.corrected
    return [
        Headline("Expected at the work", millimetres(answer.expected_rms), "mm", f"rms; {note}")
        for note, answer in named.items()
        if answer.expected_rms is not None
    ]


def _poses(facts: Facts) -> Headline:
    poses = facts.result.observations
    kept = sum(meta["role"] == "verification" for meta in facts.log.poses.values())
    note = f"of {len(poses)} captures" + (f", and {kept} kept for verification" if kept else "")
    if facts.estimate is None:
        return Headline("Circles measured", str(len(facts.measured)), "", note)
    return Headline("Poses used", str(sum(o.used for o in poses)), "", note)


@dataclass(frozen=True)
class TransformText:
    """A transform and its uncertainty, in words and numbers.

    Attributes:
        name: ``parent_T_child``.
        meaning: Its direction in words.
        matrix: Four lines of four numbers, translation in m: to copy.
        translation: (x, y, z) [mm].
        rotation: (roll, pitch, yaw) [deg].
        quaternion: (x, y, z, w).
        translation_std: (x, y, z) [mm], at ``about``.
        rotation_std: About the parent's x, y, z [deg].
        about: (x, y, z) [mm].
    """

    name: str
    parent: str
    child: str
    meaning: str
    matrix: str
    translation: list[str]
    rotation: list[str]
    quaternion: list[str]
    translation_std: list[str]
    rotation_std: list[str]
    about: list[str]


def transform_text(name: str, estimate: r.TransformResult) -> TransformText:
    """Return an estimated transform for people."""
    parent, _, child = name.partition("_T_")
    matrix = np.array(estimate.matrix)
    return TransformText(
        name=name,
        parent=parent,
        child=child,
        meaning=_direction(parent, child),
        matrix="\n".join(" ".join(f"{x:z13.9f}" for x in row) for row in matrix),
        translation=[f"{x * 1e3:z.3f}" for x in matrix[:3, 3]],
        rotation=[degrees(x) for x in rpy_from_rotation(matrix[:3, :3])],
        quaternion=[f"{x:z.7f}" for x in quaternion_from_rotation(matrix[:3, :3])],
        translation_std=[UNKNOWN if x is None else millimetres(x) for x in estimate.sigma[3:]],
        rotation_std=[UNKNOWN if x is None else degrees(x) for x in estimate.sigma[:3]],
        about=[f"{x * 1e3:z.1f}" for x in estimate.about],
    )


def _direction(parent: str, child: str) -> str:
    parent, child = _FRAMES.get(parent, parent), _FRAMES.get(child, child)
    return (
        f"maps points given in {child} to points in {parent}; "
        f"equally, it is the pose of {child} in {parent}"
    )

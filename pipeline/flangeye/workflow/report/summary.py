"""The top of the report: the verdict, the headline numbers and the matrix, ready to print."""

import shlex
from dataclasses import dataclass

import numpy as np

from flangeye import types as t
from flangeye.files.remote import with_urls
from flangeye.types.geometry import quaternion_from_rotation, rpy_from_rotation
from flangeye.workflow.report.facts import Facts
from flangeye.workflow.report.units import degrees, millimetres, rounded_mm
from flangeye.workflow.result import contract as r
from flangeye.workflow.result import sections


@dataclass(frozen=True)
class Banner:
    """The first line of the report.

    Attributes:
        kind: verified, unverified, refused or incomplete; also a CSS class.
        label: One or two words.
        figures: Expected error, limit, and whether it is simulated.
        sentence: Meaning of the verdict, or its reason.
    """

    kind: str
    label: str
    figures: list[str]
    sentence: str


def banner_of(facts: Facts) -> Banner:
    """Return the verdict and its reason."""
    result = facts.result
    figures = ["SIMULATED"] if result.simulated else []
    if result.status == "refused":
        reason = _sentence(result.refused or "no reason was given")
        advice = f". Next step: {result.advice}" if result.advice else ""
        return Banner("refused", "Refused", figures, reason + advice)
    if result.status == "incomplete":
        return Banner("incomplete", "Incomplete", figures, _sentence(_how_far(facts)))
    if found := sections.expected_error(result):
        figures = [f"{rounded_mm(found[0])} mm expected", *_limit(result), *figures]
    if result.status == "verified":
        reasons = "; ".join(v.reason for v in result.verifications.values())
        return Banner("verified", "Verified", figures, _sentence(reasons))
    advice = "no verify step checked this calibration; check it before anything relies on it"
    return Banner("unverified", "Not verified", figures, _sentence(advice))


def _limit(result: r.Result) -> list[str]:
    limit = result.holdout and result.holdout.figures.get("limit")
    return [f"limit {rounded_mm(limit)} mm"] if limit else []


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
class KeyFigure:
    """One number of a tile or of the evidence.

    Attributes:
        name: Name of the figure.
        value: The number.
        unit: Unit of the figure; empty without one.
        note: Samples that the figure covers.
    """

    name: str
    value: str
    unit: str
    note: str


def tiles_of(facts: Facts) -> list[KeyFigure]:
    """Return the three numbers that decide whether to trust the matrix."""
    result, tiles = facts.result, []
    if found := sections.expected_error(result):
        rms, bound = found
        note = "rms" if bound is None else f"95 % below {rounded_mm(bound)} mm"
        tiles.append(KeyFigure("Expected error at the work", rounded_mm(rms), "mm", note))
    if held := result.holdout:
        note = f"rms, {held.folds} folds, poses that took no part"
        tiles.append(KeyFigure("Held-out error", rounded_mm(held.rms), "mm", note))
    return [*tiles, _poses(facts)]


def evidence_of(facts: Facts) -> list[KeyFigure]:
    """Return the other errors in the report, each with a remark."""
    result, found = facts.result, []
    answers = result.answers
    if answers and answers.corrected and answers.corrected.expected_rms is not None:
        value = millimetres(answers.corrected.expected_rms)
        found.append(KeyFigure("Expected, arm corrected", value, "mm", "rms, with its correction"))
    if held := result.holdout:
        if outliers := held.figures.get("outliers"):
            value = millimetres(held.figures["rms_all"])
            found.append(KeyFigure("Held-out", value, "mm", f"with {outliers:.0f} outliers"))
        found.append(KeyFigure("Held-out", millimetres(held.median), "mm", "median"))
        found.append(KeyFigure("Held-out", millimetres(held.p95), "mm", "95 % below"))
    if truth := result.truth:
        over = "rms over the workspace, known in simulation"
        found.append(KeyFigure("True error", millimetres(truth.rms_over_workspace), "mm", over))
        centre = f"at the workspace's centre; rotation {degrees(truth.rotation_error)}°"
        found.append(KeyFigure("True error", millimetres(truth.error_at_centroid), "mm", centre))
    return found


def next_steps_of(facts: Facts) -> list[tuple[str, str]]:
    """Return the suggested next steps as purposes with commands."""
    run = shlex.quote(with_urls(str(facts.log.path.parent)))
    if facts.result.status == "refused":
        return [("Find the cause", f"flangeye doctor {run}/{facts.log.path.name}")]
    if facts.result.status == "incomplete":
        return [
            ("Assess the poses so far", f"flangeye show {run} --outlook"),
            ("Continue a live run", f"flangeye run --resume {run} --move"),
        ]
    touch = f"flangeye touch {run} --seen 'X, Y, Z' --tip 'X, Y, Z' --move"
    return [
        ("Use the matrix", f"flangeye export {run} --to ros2_launch"),
        ("Check it by touch", touch),
        ("Watch it for drift", f"flangeye monitor {run} --archive LATER_SCANS"),
    ]


def _poses(facts: Facts) -> KeyFigure:
    poses = facts.result.observations
    kept = sum(meta["role"] == "verification" for meta in facts.log.poses.values())
    note = f"of {len(poses)} captures" + (f", {kept} kept for verification" if kept else "")
    if facts.estimate is None:
        return KeyFigure("Circles measured", str(len(facts.measured)), "", note)
    return KeyFigure("Poses used", str(sum(o.used for o in poses)), "", note)


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
        rotation_std: Standard deviations about the parent's x, y, z [deg].
        about: Point (x, y, z) to which the standard deviations refer [mm].
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
    """Return an estimated transform as text."""
    parent, _, child = name.partition("_T_")
    matrix = np.array(estimate.matrix)
    unknown = "not measured"
    return TransformText(
        name=name,
        parent=parent,
        child=child,
        meaning=_direction(parent, child),
        matrix="\n".join(" ".join(f"{x:z13.9f}" for x in row) for row in matrix),
        translation=[f"{x * 1e3:z.3f}" for x in matrix[:3, 3]],
        rotation=[degrees(x) for x in rpy_from_rotation(matrix[:3, :3])],
        quaternion=[f"{x:z.7f}" for x in quaternion_from_rotation(matrix[:3, :3])],
        translation_std=[unknown if x is None else millimetres(x) for x in estimate.sigma[3:]],
        rotation_std=[unknown if x is None else degrees(x) for x in estimate.sigma[:3]],
        about=[f"{x * 1e3:z.1f}" for x in estimate.about],
    )


def _direction(parent: str, child: str) -> str:
    named = {
        t.BASE: "the robot's base",
        t.FLANGE: "the flange",
        t.CAMERA: "the camera",
        t.TARGET: "the target",
        t.BASE2: "the second robot's base",
        t.FLANGE2: "the second robot's flange",
    }
    parent, child = named.get(parent, parent), named.get(child, child)
    return (
        f"maps points given in {child} to points in {parent}; "
        f"equally, it is the pose of {child} in {parent}"
    )

"""Input and output of ``check`` parts: a session as arrays, and findings about it.

A check is a part ``check.<name>``: a function of a :class:`RecordedSession` (and its own
parameters) that returns the significant :class:`Finding` s, or raises :class:`NotApplicable`.
``flangeye doctor`` runs every installed check, accepts the finding that explains most, corrects the
session accordingly, and repeats.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from flangeye.errors import StageError
from flangeye.files.yaml_lines import parse_value
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import BoundPart, Part
from flangeye.types import Floats, Mask, Motion

ReaderLine = str | Mapping[str, Any]
"""A reader as a recipe writes it: its name, or its name and parameters."""

Arms = Literal["both", "first", "second"]
"""Arms whose poses are read or corrected; with one arm, ``both`` is that arm."""

FEWEST_SAMPLES = 4
"""Fewest samples; with fewer, any explanation fits."""


class NotApplicable(Exception):
    """A check's mistake cannot be detected in this session; the message says why."""


@dataclass(frozen=True, eq=False)
class RecordedSession:
    """N robot poses with the measurement at each, in recording order.

    Attributes:
        ids: Names of the samples.
        poses: (N, 4, 4) ``base_T_flange`` [m], as the archive's reader gave them.
        centres: (N, 3) target's centre in ``camera`` [m]; NaN if not found.
        normals: (N, 3) target's axis in ``camera``; NaN if not measured.
        rotations: (N, 3, 3) ``camera_R_target``; NaN without a full pose.
        places: (N, 3) the centre in the target's own frame [m]; NaN if unknown.
        times: (N,) times of the samples [s]; NaN if unknown.
        carried: What the arm moves: the target or the camera; ``both`` if it moves the camera and a
            second arm the target.
        links: (N, 4, 4) ``base_T_link`` of the link that carries the camera [m]; else None.
        seconds: (N, 4, 4) ``base2_T_flange2`` [m] if a second arm carries the target; else None.
        place: (4, 4) pose of the target in its carrier [m]; None if unknown.
        robot: The arm's model, if the recipe names one.
        motions: N motions of the flange about each sample; None unless all were recorded.
        reach: Nearest and farthest distance that the scanner sees [m].
        reader: The archive's reader, as the recipe writes it.
        acquire: Name of the recipe's first step.
        changes: Parameters of that step changed by accepted findings.
        board: The board of the recipe's fit step, as a parameter of ``acquire.images``.
        limit: Error limit of the recipe [m]; by default that of ``verify.holdout``.
        marks_open: Whether the recipe's solver marks unobservable translations.
        remarks: Mistakes found and corrected when opening the archive.
        damage: Damaged or changed parts of the log, one line each.
        again: Reads the session again with other parameters of the reader and of its target; None
            if the session was changed after reading.
    """

    ids: tuple[str, ...]
    poses: Floats
    centres: Floats
    normals: Floats
    rotations: Floats
    places: Floats
    times: Floats
    carried: Literal["target", "camera", "both"] = "target"
    links: Floats | None = None
    seconds: Floats | None = None
    place: Floats = field(default_factory=lambda: np.eye(4))
    robot: RobotModel | None = None
    motions: tuple[Motion, ...] | None = None
    reach: tuple[float, float] = (0.05, 5.0)
    reader: ReaderLine = "auto"
    acquire: str = "acquire.archive"
    changes: Mapping[str, Any] = field(default_factory=dict)
    board: Mapping[str, Any] = field(default_factory=dict)
    limit: float = 1e-3
    marks_open: bool = False
    remarks: tuple[Finding, ...] = ()
    damage: tuple[str, ...] = ()
    again: ReadAgain | None = field(default=None, repr=False)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def seen(self) -> Mask:
        """Mask (N,) of the samples in which the target was measured."""
        return np.asarray(np.isfinite(self.centres[:, 0]))

    @property
    def arms(self) -> tuple[Arms, ...]:
        """The arms whose poses a check may correct, likeliest first."""
        return ("both",) if self.seconds is None else ("both", "first", "second")

    @property
    def uses_poses(self) -> bool:
        """Whether the flange's poses matter; not where a camera on a link sees a fixed target."""
        return self.links is None or self.carried == "target"

    def require_samples(self) -> None:
        """Refuse a session with too few samples for any check.

        Raises:
            NotApplicable: There are too few with a target in them.
        """
        if (seen := int(self.seen.sum())) < FEWEST_SAMPLES:
            raise NotApplicable(
                f"{seen} samples with a target in them, {FEWEST_SAMPLES} are needed"
            )

    def require_poses(self) -> None:
        """Raise NotApplicable unless a mistake in the flange poses would show.

        Raises:
            NotApplicable: There are too few samples, or all poses follow from joint angles.
        """
        self.require_samples()
        if not self.uses_poses:
            raise NotApplicable(
                "the camera's poses are computed from joint angles, so recorded flange poses are "
                "not used"
            )

    def where(self, mask: Mask) -> RecordedSession:
        """Return the samples of a mask."""
        return replace(
            self,
            ids=tuple(name for name, kept in zip(self.ids, mask, strict=True) if kept),
            poses=self.poses[mask],
            centres=self.centres[mask],
            normals=self.normals[mask],
            rotations=self.rotations[mask],
            places=self.places[mask],
            times=self.times[mask],
            links=None if self.links is None else self.links[mask],
            seconds=None if self.seconds is None else self.seconds[mask],
            motions=None if self.motions is None else tuple(compress(self.motions, mask)),
        )

    def without(self, mask: Mask) -> RecordedSession:
        """Return the session without masked samples, left out by a line of the recipe."""
        names = [name for name, gone in zip(self.ids, mask, strict=True) if gone]
        earlier = self.changes.get("leave_out", [])
        # The reader would bring the samples back, so nothing is read again from here on
        kept = replace(self.where(~mask), again=None)
        return kept.with_changes(leave_out=[*earlier, *names])

    def with_changes(self, **changes: Any) -> RecordedSession:
        """Return the session as read with other parameters of the acquire step."""
        return replace(self, changes={**self.changes, **changes})

    def read_with(self, **correction: Any) -> RecordedSession:
        """Return the session as read through ``reader.corrected`` with a correction."""
        stated = {k: value for k, value in correction.items() if (k, value) != ("arms", "both")}
        reader = {"corrected": {"reader": self.reader, **stated}}
        return replace(self, reader=reader, again=None)

    def corrected(
        self, change: PoseChange, arms: Arms = "both", **correction: Any
    ) -> RecordedSession:
        """Return the session with corrected poses, as read by ``reader.corrected``.

        Args:
            change: Returns an arm's corrected poses (N, 4, 4).
            arms: Names of the arms.
            correction: Options of the reader that make the same change.
        """
        poses = self.poses if arms == "second" else change(self.poses)
        given = self.seconds
        seconds = given if given is None or arms == "first" else change(given)
        read = self.read_with(arms=arms, **correction)
        # How the flange passed was recorded with the poses before the change
        return replace(read, poses=poses, seconds=seconds, motions=None)

    def stretched(self, factors: Floats) -> RecordedSession:
        """Return the session with measured positions scaled by factors (3,) along each axis."""
        # A mirror (a factor below 0) turns directions over; a unit leaves them as they are
        normals = self.normals * np.sign(factors)
        seen = replace(self, centres=self.centres * factors, normals=normals)
        if self.acquire == "acquire.archive":
            earlier = np.array(self.changes.get("stretch", (1.0, 1.0, 1.0)))
            return seen.with_changes(stretch=[float(f"{k:.6g}") for k in earlier * factors])
        # A reader of tables takes one mirrored axis or one unit, never both
        mirrored = {"mirrored": "xyz"[int(np.argmin(factors))]} if factors.min() < 0 else {}
        scale = float(f"{np.abs(factors[0]):.6g}")
        return seen.read_with(target=mirrored or {"scale": scale})

    def with_poses(self, poses: Floats) -> RecordedSession:
        """Return the session with other poses (N, 4, 4)."""
        return replace(self, poses=poses, motions=None)

    def step(self) -> str:
        """Return the acquire step that reads this session, as a line of the recipe."""
        return f"- {self.acquire}: {as_yaml({'reader': self.reader, **self.changes})}"


class Misfit(NamedTuple):
    """Errors of the best calibration, rms over the samples.

    Attributes:
        position: Position residual of the target's centre [m].
        angle: Angular residual of its normal or rotation [rad]; None for centres only.
    """

    position: float
    angle: float | None = None

    @property
    def numbers(self) -> Floats:
        """Errors that exist, (1,) or (2,)."""
        return np.array([x for x in self if x is not None])


@dataclass(frozen=True, eq=False)
class Finding:
    """One mistake that a check found.

    Attributes:
        name: Short name of the mistake.
        what: One sentence on the mistake and the samples concerned.
        fix: Remedy: the line of the recipe to change, if there is one.
        samples: Ids of the samples concerned; empty for all.
        before: Errors without the correction; None if not meaningful.
        after: Errors with the correction.
        probability: p-value: probability of such an improvement without this mistake, corrected for
            the number of alternatives.
        gain: Log-likelihood ratio minus the penalty for additional parameters; ranks findings.
            Infinite if no statistics are needed, as for a pose that is exactly the identity.
        corrected_session: The corrected session, for finding further mistakes; None if only new
            recordings help.
        note: Whether it is information only, not a mistake.
    """

    name: str
    what: str
    fix: str
    samples: tuple[str, ...] = ()
    before: Misfit | None = None
    after: Misfit | None = None
    probability: float = 0.0
    gain: float = math.inf
    corrected_session: RecordedSession | None = field(default=None, repr=False)
    note: bool = False

    @property
    def needs_new_recordings(self) -> bool:
        """Whether the mistake surely affects most samples, so that only new recordings help."""
        certain = self.gain == math.inf and bool(self.samples)
        return certain and self.corrected_session is None and not self.note

    @property
    def choices(self) -> list[str]:
        """The fixes, likeliest first."""
        return self.fix.split(OR_ELSE)

    @property
    def lines(self) -> list[dict[str, Any]]:
        """The lines of a recipe to choose from, steps and sections by their names.

        Empty where a person has something to do that is not a line.
        """
        form = r"(- [a-z]+\.\w+|[a-z_]+): \{.*\}(  # .*)?"
        choices = [choice.split("\n  ") for choice in self.choices]
        return [
            {
                name: value
                for line in choice
                for name, value in parse_value(line.removeprefix("- "), "the doctor's line").items()
            }
            for choice in choices
            if all(re.fullmatch(form, line) for line in choice)
        ]


Findings = Iterable[Finding]
ReadAgain = Callable[[Mapping[str, Any], Mapping[str, Any]], RecordedSession]
PoseChange = Callable[[Floats], Floats]
"""Gives poses (N, 4, 4) as they should be."""


OR_ELSE = "  # or, if it is not: "
"""Separates two lines of which a person has to choose one."""


def as_yaml(value: Any) -> str:
    """Return a value as YAML on one line, unquoted where that is read back the same."""
    if isinstance(value, Mapping):
        inside = ", ".join(f"{key}: {as_yaml(each)}" for key, each in value.items())
        return f"{{{inside}}}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(as_yaml, value))}]"
    if value is None:
        return "null"
    if not isinstance(value, str):
        return str(value).lower() if isinstance(value, bool) else str(value)
    plain = re.fullmatch(r"[A-Za-z_][\w.-]*(?: [\w.-]+)*|-?[\d.]+ [A-Za-z]+", value)
    if plain and parse_value(value, value) == value:
        return value
    return "'{}'".format(value.replace("'", "''"))


class Check(Protocol):
    """How a ``check`` part is called."""

    def __call__(self, session: RecordedSession) -> Iterable[Finding]:
        """Return the significant mistakes; raise :class:`NotApplicable` if it cannot judge."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """All findings of the checks.

    Attributes:
        samples: Number of samples.
        seen: Number of samples with a target in them.
        findings: Findings in order, each made with the earlier ones corrected.
        notes: Information that is not a mistake.
        checks: Names of the checks.
        idle: Checks that do not apply to this session: name and reason.
        damage: Damaged or changed parts of the log, one line each.
    """

    samples: int
    seen: int
    findings: tuple[Finding, ...]
    notes: tuple[Finding, ...]
    checks: tuple[str, ...]
    idle: Mapping[str, str]
    damage: tuple[str, ...] = ()


def examine(
    session: RecordedSession, checks: Iterable[Part], checked: Callable[[], None] = lambda: None
) -> Diagnosis:
    """Run the checks; return their findings, the most significant first.

    Each check has counted the alternatives it tried; here the checks are counted (Bonferroni), so
    that a session without a mistake gives any finding with a probability of 1e-3 at most.

    Args:
        session: The recordings.
        checks: The checks to run.
        checked: Called after each check; each correction is followed by another round of all.

    Raises:
        StageError: There are too few samples to judge.
    """
    bound = [check.bind() for check in checks]

    def diagnosed(
        found: Sequence[Finding], notes: tuple[Finding, ...], idle: Mapping[str, str]
    ) -> Diagnosis:
        names = tuple(check.part.name for check in bound)
        seen = int(session.seen.sum())
        return Diagnosis(len(session), seen, tuple(found), notes, names, idle, session.damage)

    found, current = [r for r in session.remarks if not r.note], session
    known = tuple(remark for remark in session.remarks if remark.note)
    if any(remark.needs_new_recordings for remark in found):
        return diagnosed(found, known, {})
    require_enough(int(session.seen.sum()), len(session), session.remarks, session.damage)
    offered, idle = _offered(current, bound, checked)
    if made_up := [f for f in offered if f.needs_new_recordings]:
        # What else these samples seem to show is made up like them.
        return diagnosed([*found, made_up[0]], known, idle)
    while mendable := [f for f in offered if f.corrected_session is not None and not f.note]:
        # The likeliest first: a large mistake imitates and hides smaller ones, which are looked
        # for again once it is mended
        found.append(max(mendable, key=lambda finding: finding.gain))
        current = found[-1].corrected_session or current
        offered = []
        # One session has no more; a guard against checks that undo each other
        if len(found) == 8 or current.seen.sum() < FEWEST_SAMPLES:
            break
        offered, _ = _offered(current, bound, checked)
        # A mistake of all samples is mended once: found again, it comes of the first correction
        named = {f.name for f in found if not f.samples}
        offered = [f for f in offered if f.samples or f.name not in named]
    found += [f for f in offered if f.corrected_session is None and not f.note]
    notes = (*known, *(f for f in offered if f.note))
    return diagnosed(found, notes, idle)


def _offered(
    session: RecordedSession, checks: Sequence[BoundPart], checked: Callable[[], None]
) -> tuple[list[Finding], dict[str, str]]:
    """Return the findings significant for this number of checks, and the checks not applicable."""
    found: list[Finding] = []
    idle: dict[str, str] = {}
    for check in checks:
        try:
            findings = list(check(session))
        except NotApplicable as why:
            idle[check.part.name] = str(why)
            continue
        finally:
            checked()
        # Bonferroni over the checks; each has done so over the alternatives that it tried
        found += [f for f in findings if f.probability * len(checks) < 1e-3]
    return found, idle


def require_enough(
    seen: int, samples: int, remarks: Sequence[Finding] = (), damage: Sequence[str] = ()
) -> None:
    """Refuse a session with too few samples for any check, and say what else is known of it.

    Raises:
        StageError: The target is in fewer.
    """
    if seen < FEWEST_SAMPLES:
        why = max(remarks, key=lambda remark: len(remark.samples), default=None)
        raise StageError(
            f"{seen} of {samples} samples have a target in them; at least {FEWEST_SAMPLES} "
            "are needed to tell a mistake from noise"
            + (f"; {len(why.samples)} of them: {why.what}" if why else "")
            + "".join(f"; {part}" for part in damage)
        )

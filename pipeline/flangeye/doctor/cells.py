"""Mistakes in the recordings of a cell: each one is tried on the whole graph.

A mistake is named only where the cell without it foretells sightings held out far better, of all
cameras together, and is mended by a line of the recipe: of the reader's tables, or of ``cell:``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, permutations
from typing import Any

import numpy as np

from flangeye.doctor.diagnosis import (
    Change,
    Diagnosis,
    Finding,
    Misfit,
    RecordedSession,
    require_enough,
)
from flangeye.errors import FlangeyeError
from flangeye.estimation.plan import rough
from flangeye.estimation.sightings import problem_of
from flangeye.maths.geometry import invert, rigid
from flangeye.maths.pose_formats import LENGTHS
from flangeye.models.cell import Cell, Link
from flangeye.types import (
    CAMERA,
    TARGET,
    CircleFeature,
    Floats,
    Observation,
    PoseFeature,
    Transform,
)


@dataclass(frozen=True, eq=False)
class Suspicion:
    """A mistake that may have been made.

    Attributes:
        name: In a word or two.
        what: In a sentence.
        fix: The line that mends it.
        observations: The sightings without it.
        cell: The cell without it.
    """

    name: str
    what: str
    fix: str
    observations: Sequence[Observation]
    cell: Cell


def examine_cell(
    observations: Sequence[Observation], cell: Cell, tables: Mapping[str, Any] | None = None
) -> Diagnosis:
    """Return the mistake that explains most, else the sightings that do not fit their poses.

    Args:
        observations: Every sighting.
        cell: What the recipe states stands on what.
        tables: Parameters of ``reader.cell``, where it read them.

    Raises:
        StageError: There are too few sightings to judge.
    """
    session = _session(observations)
    require_enough(session)
    some = _thinned(observations)
    before = foretold(some, cell)
    found = [] if before.ordinary else _likeliest(before, suspicions(some, cell, tables or {}))
    # Links last: one before a joint that hardly moved fits as well as the right one does
    if not (found or before.ordinary):
        found = _likeliest(before, _of_links(some, cell))
    found = found or _mispaired(observations, cell)
    return Diagnosis(session, tuple(found), (), ("cell",), {})


def _likeliest(before: Foretold, suspected: Iterator[Suspicion]) -> list[Finding]:
    """Return the mistake whose cure foretells sightings best, if it does so far better."""
    tried = [(foretold(s.observations, s.cell), s) for s in suspected if _possible(s)]
    if not tried:
        return []
    after, best = min(tried, key=lambda each: each[0].size)
    # Once a true mistake is mended at most half of the held-out errors remain; the best of many
    # wrong suspicions lowers them a little too
    if not after.ordinary or after.size > 0.5 * before.size:
        return []
    known = before.misfit if np.isfinite(before.size) else None
    return [Finding(best.name, best.what, best.fix, before=known, after=known and after.misfit)]


def suspicions(
    observations: Sequence[Observation], cell: Cell, tables: Mapping[str, Any]
) -> Iterator[Suspicion]:
    """Yield each mistake that may have been made, mended."""
    yield from _of_sightings(observations, cell, tables.get("sightings", ()))
    yield from _of_arms(observations, cell, tables.get("arms", {}))
    yield from _of_mountings(observations, cell)


def _of_sightings(
    observations: Sequence[Observation], cell: Cell, tables: Sequence[Mapping[str, Any]]
) -> Iterator[Suspicion]:
    """Yield inverted markers and wrong units of what cameras saw."""
    stated = {(each["camera"], each["target"]): each.get("pose") for each in tables}
    pairs = {(o.camera, o.target): _whole(o) for o in observations if _whole(o) or _is_point(o)}
    for (camera, target), whole in sorted(pairs.items()):

        def mended(change: Change, pair: tuple[str, str] = (camera, target)) -> list[Observation]:
            return [_seen(o, change) if (o.camera, o.target) == pair else o for o in observations]

        of = f"{{camera: {camera}, target: {target}, "
        seen = f"what {camera} saw of {target}"
        if whole:
            pose = _other(stated.get((camera, target)), "camera_T_target", "target_T_camera")
            yield Suspicion(
                "inverted marker",
                f"{seen} are poses {pose}, not the other way round",
                f"sightings: [{of}pose: {pose}}}]",
                mended(invert),
                cell,
            )
        for unit, factor in _other_units():
            yield Suspicion(
                "unit",
                f"{seen} is in {unit}",
                f"sightings: [{of}length: {unit}}}]",
                mended(partial(_scaled, factor=factor)),
                cell,
            )


def _whole(observation: Observation) -> bool:
    return isinstance(observation.feature, PoseFeature)


def _is_point(observation: Observation) -> bool:
    """Whether the centre comes from a table; that of a scan has a normal and the scanner's unit."""
    feature = observation.feature
    return isinstance(feature, CircleFeature) and feature.normal is None


def _other(stated: str | None, usual: str, otherwise: str) -> str:
    """Return whose pose it is if it is not what was stated."""
    return usual if stated == otherwise else otherwise


def _of_arms(
    observations: Sequence[Observation], cell: Cell, tables: Mapping[str, Mapping[str, Any]]
) -> Iterator[Suspicion]:
    """Yield inverted poses, wrong units and exchanged tables of the arms."""
    for arm in cell.arms:
        pose = _other(tables.get(arm, {}).get("pose"), "base_T_flange", "flange_T_base")
        yield Suspicion(
            "inverted pose",
            f"the poses of {arm} are {pose}, not the other way round",
            f"arms: {{{arm}: {{pose: {pose}}}}}",
            [_moved(o, {arm: invert(o.poses[arm].matrix)}) for o in observations],
            cell,
        )
        for unit, factor in _other_units():
            yield Suspicion(
                "unit",
                f"the poses of {arm} are in {unit}",
                f"arms: {{{arm}: {{length: {unit}}}}}",
                [_moved(o, {arm: _scaled(o.poses[arm].matrix, factor)}) for o in observations],
                cell,
            )
    files = {arm: tables.get(arm, {}).get("file", f"the table of {arm}") for arm in cell.arms}
    for one, two in combinations(cell.arms, 2):
        yield Suspicion(
            "swapped arms",
            f"the poses of {one} are those of {two}, and the other way round",
            f"arms: {{{one}: {{file: {files[two]}}}, {two}: {{file: {files[one]}}}}}",
            [_exchanged(o, one, two) for o in observations],
            cell,
        )


def _of_mountings(observations: Sequence[Observation], cell: Cell) -> Iterator[Suspicion]:
    """Yield cameras and targets that stand on something else than the recipe states."""
    for group, name in _to_find(cell):
        for other in ("base", *cell.movers):
            if other != cell.frames[name].parent:
                on = f"cell: {{{group}: {{{name}: {{on: {other}}}}}}}"
                yield _mounted(name, other, on, (observations, cell))


def _of_links(observations: Sequence[Observation], cell: Cell) -> Iterator[Suspicion]:
    """Yield cameras and targets that stand on another link of the same arm."""
    for group, name in _to_find(cell):
        for link in _links_beside(cell.frames[name].parent, observations, cell):
            on = f"cell: {{{group}: {{{name}: {{on: {link.arm}, link: {link.number}}}}}}}"
            yield _mounted(name, link.frame, on, (observations, cell.with_links([link])))


def _to_find(cell: Cell) -> list[tuple[str, str]]:
    """Return the cameras and targets whose places are not known, with their group."""
    ends = [*(("cameras", x) for x in cell.cameras), *(("targets", x) for x in cell.targets)]
    return [(group, name) for group, name in ends if cell.frames[name].place is None]


def _mounted(
    name: str, other: str, fix: str, given: tuple[Sequence[Observation], Cell]
) -> Suspicion:
    """Return that something stands on something else."""
    observations, cell = given
    frame = replace(cell.frames[name], parent=other)
    return Suspicion(
        "mounting",
        f"{name} stands on {other}, not on {cell.frames[name].parent}",
        fix,
        observations,
        replace(cell, frames={**cell.frames, name: frame}),
    )


def _links_beside(stands: str, observations: Sequence[Observation], cell: Cell) -> list[Link]:
    """Return the links of the arm that carries something, if its joints are known.

    The last is left out: what stands on it stands on the flange as well.
    """
    arm = cell.links[stands].arm if stands in cell.links else stands
    if arm not in cell.joints(observations):
        return []
    links = [Link(arm, i) for i in range(1, len(cell.arms[arm].joints))]
    return [link for link in links if link.frame != stands]


def _mispaired(observations: Sequence[Observation], cell: Cell) -> list[Finding]:
    """Return the sightings that do not belong to the poses beside them, if others agree."""
    try:
        found = rough(problem_of(observations, cell), cell.freedoms)
    except (FlangeyeError, np.linalg.LinAlgError):
        return []
    errors = np.linalg.norm(found.errors[:, 3:], axis=1)
    # What the solver sets aside may be noise; a sighting of another pose is off by far more
    ordinary = 5.0 * np.sqrt((errors[found.inliers] ** 2).mean())
    wrong = ~found.inliers & (errors > ordinary)
    far = [o.id for o, gone in zip(observations, wrong, strict=True) if gone]
    if not far or 3 * len(far) > len(observations):
        return []
    return [
        Finding(
            "mis-paired pose",
            f"{len(far)} of {len(observations)} sightings do not fit their poses; the others "
            "agree without them",
            f"- acquire.samples: {{leave_out: [{', '.join(far)}]}}",
            tuple(far),
        )
    ]


@dataclass(frozen=True)
class Foretold:
    """Prediction error of held-out sightings.

    Attributes:
        misfit: Medians over the sightings, of the pair where they are largest.
        share: That of places, as a share of how far the pair's sightings are apart: a unit that
            changes no error is not a finding.
    """

    misfit: Misfit
    share: float

    @property
    def size(self) -> float:
        """Of the errors, in units of ordinary ones."""
        # Errors of sound sightings, as a share of how far they are apart, and of their rotations
        # [rad]: so large that noise does not reach them, for a wrong unit, side or mounting gives
        # errors as large as the motion itself
        ordinary = 0.02, np.radians(1.0)
        return float(max(self.share / ordinary[0], (self.misfit.angle or 0.0) / ordinary[1]))

    @property
    def ordinary(self) -> bool:
        """Whether errors of this size occur without a mistake."""
        return self.size <= 1


def foretold(observations: Sequence[Observation], cell: Cell) -> Foretold:
    """Return each sighting's error as predicted by the others; infinite without a solution."""
    try:
        found = rough(problem_of(observations, cell), cell.freedoms)
    except (FlangeyeError, np.linalg.LinAlgError):
        return Foretold(Misfit(np.inf), np.inf)
    # Rows are twists, the rotation before the translation
    turns, places = (np.linalg.norm(found.errors[:, at], axis=1) for at in (slice(3), slice(3, 6)))
    centres = np.array([o.feature.centre for o in observations])
    of_pairs = []
    for of in _by_pair(observations).values():
        # Medians: a few sightings beside wrong poses are not yet a mistake of the whole pair
        spread = max(float(np.linalg.norm(centres[of].std(axis=0))), 1e-12)
        place, turn = float(np.median(places[of])), float(np.median(turns[of]))
        of_pairs.append(Foretold(Misfit(place, turn), place / spread))
    return max(of_pairs, key=lambda pair: pair.size)


def _possible(suspicion: Suspicion) -> bool:
    """Whether distances of targets from cameras and of flanges from bases are those of a cell."""
    seen = np.array([np.linalg.norm(o.feature.centre) for o in suspicion.observations])
    reach = [x.translation for o in suspicion.observations for x in o.poses.values()]
    far = np.linalg.norm(reach, axis=1)
    # A wrong unit makes half a metre half a millimetre or half a kilometre; without bounds [m] a
    # cell shrunk to a point would have the smallest errors of all
    nearest, farthest = 0.02, 10.0
    return bool(nearest < np.median(seen) < farthest and nearest < np.median(far) < farthest)


def _by_pair(observations: Sequence[Observation]) -> dict[tuple[str, str], list[int]]:
    pairs: dict[tuple[str, str], list[int]] = {}
    for i, o in enumerate(observations):
        pairs.setdefault((o.camera, o.target), []).append(i)
    return pairs


def _thinned(observations: Sequence[Observation]) -> list[Observation]:
    """Return some sightings of each pair, evenly over the session."""
    # Twelve of each pair are enough to compare; every suspicion costs a solution of the graph
    return [
        observations[of[i]]
        for of in _by_pair(observations).values()
        for i in np.unique(np.linspace(0, len(of) - 1, 12).round().astype(int))
    ]


def _session(observations: Sequence[Observation]) -> RecordedSession:
    """Return the sightings as the other checks' text counts them."""
    n = len(observations)
    nothing = np.full((n, 3), np.nan)
    return RecordedSession(
        tuple(o.id for o in observations),
        np.broadcast_to(np.eye(4), (n, 4, 4)),
        np.array([o.feature.centre for o in observations]).reshape(-1, 3),
        nothing,
        np.full((n, 3, 3), np.nan),
        nothing,
        np.full(n, np.nan),
    )


def _seen(observation: Observation, change: Change) -> Observation:
    """Return an observation of a marker whose pose was another one, or of a point elsewhere."""
    feature = observation.feature
    if isinstance(feature, CircleFeature):
        centre = change(rigid(np.eye(3), feature.centre))[:3, 3]
        return replace(observation, feature=replace(feature, centre=centre))
    pose = Transform(CAMERA, TARGET, change(feature.camera_T_target.matrix))
    return replace(observation, feature=replace(feature, camera_T_target=pose))


def _moved(observation: Observation, poses: Mapping[str, Floats]) -> Observation:
    """Return an observation at which controllers reported other poses (4, 4)."""
    moved = {name: replace(observation.poses[name], matrix=pose) for name, pose in poses.items()}
    return replace(observation, poses={**observation.poses, **moved})


def _exchanged(observation: Observation, one: str, two: str) -> Observation:
    """Return an observation at which two arms reported what the other did."""
    poses, told = observation.poses, observation.arm_joints
    moved = _moved(observation, {one: poses[two].matrix, two: poses[one].matrix})
    other = {one: two, two: one}
    return replace(moved, arm_joints={other.get(name, name): x for name, x in told.items()})


def _scaled(pose: Floats, factor: float) -> Floats:
    return rigid(pose[:3, :3], factor * pose[:3, 3])


def _other_units() -> Iterator[tuple[str, float]]:
    """Give each unit of lengths, and the factor if they are in it and the recipe states another."""
    for unit, said in permutations(("m", "mm"), 2):
        yield unit, LENGTHS[unit] / LENGTHS[said]

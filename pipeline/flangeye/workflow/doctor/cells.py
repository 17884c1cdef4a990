"""Detection of mistakes in the recordings of a cell, tested on the whole graph.

A mistake corresponds to a change of the recipe: how a table is read, or what is mounted on what.
The tables are read again with the change, and the mistake is reported only if held-out observations
of all cameras are then predicted far better. The remedy is the changed line of the recipe.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flangeye.errors import FlangeyeError, StageError
from flangeye.estimation.plan import preview
from flangeye.estimation.start.sightings import problem_of
from flangeye.files.recording import Archive, Recording
from flangeye.files.yaml_lines import dumped, parse_yaml
from flangeye.models.cell import Axis, Cell, Link
from flangeye.plugin.registry import Registry
from flangeye.types import (
    CAMERA,
    TARGET,
    ArchivePath,
    CircleFeature,
    Observation,
    PoseFeature,
    Transform,
)
from flangeye.types.pose_formats import LENGTHS, describe_rotation, other_conventions
from flangeye.workflow.doctor.diagnosis import Diagnosis, Finding, Misfit, as_yaml, require_enough
from flangeye.workflow.log.read import is_log, log_of, read_run
from flangeye.workflow.recipe.load import Recipe, parse_recipe
from flangeye.workflow.run.folder import recipe_of_log
from flangeye.workflow.run.runner import Runner

YamlPath = tuple[Hashable, ...]
Changes = Mapping[YamlPath, Any]
"""Changed values in a recipe's data, by their path of keys."""

ReaderTable = Mapping[str, Any]
"""Parameters of one of the tables that ``reader.cell`` reads."""


class Suspicion(NamedTuple):
    """A mistake that may have been made.

    Attributes:
        name: Short name of the mistake.
        what: The mistake in a sentence.
        changes: Parameters of the recipe that correct it.
    """

    name: str
    what: str
    changes: Changes


@dataclass(frozen=True, eq=False)
class CellSession:
    """Observations of a cell, and the recipe by which they are read.

    Attributes:
        observations: All observations.
        cell: Graph of frames by the recipe.
        recipe: Read with the parts of ``registry``.
        registry: The installed plugins.
        tables: Folder of the tables for ``reader.cell``; None if the observations come from
            elsewhere, or the tables do not exist any more.
    """

    observations: Sequence[Observation]
    cell: Cell
    recipe: Recipe
    registry: Registry
    tables: Path | None

    @property
    def first(self) -> tuple[YamlPath, Mapping[str, Any]]:
        """Path of the first step's parameters in the recipe, and their values."""
        ((name, params),) = self._data["steps"][0].items()
        return ("steps", 0, name), params

    @cached_property
    def _data(self) -> dict[str, Any]:
        """The recipe as data, with every default written out."""
        return _as_data(self._files["recipe.resolved.yaml"], self.recipe.name)

    @cached_property
    def _files(self) -> dict[str, str]:
        return dict(self.recipe.files)

    def read_with(self, changes: Changes) -> CellSession:
        """Return the session by a changed recipe.

        Raises:
            FlangeyeError: The tables cannot be read so.
        """
        models = {n: t.encode() for n, t in self._files.items() if n != "recipe.resolved.yaml"}
        text = dumped(_edited(self._data, changes), width=100)
        recipe = parse_recipe(text, self.recipe.name, self.registry, models=models)
        cell = recipe.context[Cell]
        if self.tables is None:
            return replace(self, cell=cell)
        archive: Archive = getattr(recipe.steps[0].params, "reader")(self.tables)  # noqa: B009
        recorded = {recording.id: recording for recording in archive.recordings}
        # Detections in scans are kept by id, so rows that are joined otherwise have none
        if any(o.id not in recorded for o in self.observations):
            raise StageError("other rows belong together")
        again = [_recorded(o, recorded[o.id], cell) for o in self.observations]
        return replace(self, observations=again, cell=cell)

    def line(self, changes: Changes) -> str:
        """Return the changed line of the recipe, as its author wrote the rest of it."""
        data = _edited(_as_data(self.recipe.text, self.recipe.name), changes)
        section = str(next(iter(changes))[0])
        if section != "steps":
            return f"{section}: {as_yaml(data[section])}"
        ((name, params),) = data["steps"][0].items()
        return f"- {name}: {as_yaml(params)}"


def _as_data(text: str, name: str) -> dict[str, Any]:
    """Return a recipe's data; its first step has a mapping of parameters, if an empty one."""
    data: dict[str, Any] = parse_yaml(text, name).data
    if isinstance(data["steps"][0], str):
        data["steps"][0] = {data["steps"][0]: {}}
    return data


def _edited(data: Mapping[str, Any], changes: Changes) -> dict[str, Any]:
    changed: dict[str, Any] = deepcopy(dict(data))
    for (*above, last), value in changes.items():
        at: Any = changed
        for key in above:
            at = at[key]
        at[last] = value
    return changed


def _recorded(observation: Observation, recording: Recording, cell: Cell) -> Observation:
    """Return an observation with poses and target as recorded, before any correction."""
    feature = observation.feature
    if isinstance(feature, PoseFeature) and recording.camera_T_target is not None:
        marker = Transform(CAMERA, TARGET, recording.camera_T_target)
        feature = replace(feature, camera_T_target=marker)
    if isinstance(feature, CircleFeature) and recording.centre_in_camera is not None:
        feature = replace(feature, centre=recording.centre_in_camera)
    poses = cell.reported(recording.poses, recording.axes)
    return replace(observation, feature=feature, poses=poses, arm_joints=recording.arm_joints)


def open_cell(path: Path, registry: Registry, recipe: Recipe | None = None) -> CellSession | None:
    """Return a cell's observations with their recipe; None if the recording is not of a cell.

    Args:
        path: A run.mcap, or a folder that the recipe's reader knows.
        registry: The plugins on offer.
        recipe: Recipe with the cell's structure; a log contains its own.

    Raises:
        StageError: The recordings cannot be read.
    """
    log = read_run(log_of(path)) if path.suffix == ".mcap" or is_log(log_of(path)) else None
    if recipe is None and log and log.has_recipe:
        recipe = recipe_of_log(log, registry, name=path.name)
    cell = recipe.context.get(Cell) if recipe else None
    if recipe is None or cell is None:
        return None
    seen = log.observations() if log else Runner(recipe, registry, ArchivePath(path)).take(None)
    tables = recipe.archive if log else path
    reader = getattr(getattr(recipe.steps[0].params, "reader", None), "part", None)
    if tables is None or not tables.is_dir() or getattr(reader, "name", "") != "reader.cell":
        tables = None
    return CellSession(seen, cell, recipe, registry, tables)


def examine_cell(session: CellSession) -> Diagnosis:
    """Return the mistake that explains most, or else the observations that contradict their poses.

    Raises:
        StageError: There are too few observations.
    """
    count = len(session.observations)
    require_enough(count, count)
    some = replace(session, observations=_thinned(session.observations))
    before = predicted(some)
    found = [] if before.ordinary else _likeliest(some, before, suspicions(some))
    if not (found or before.ordinary):
        found = _likeliest(some, before, _of_links(some))
    found = found or _mispaired(session)
    return Diagnosis(count, count, tuple(found), (), ("cell",), {})


def _likeliest(
    session: CellSession, before: CellPrediction, suspected: Iterable[Suspicion]
) -> list[Finding]:
    """Return the mistake whose cure predicts sightings best, if it does so far better."""
    tried = []
    for suspicion in suspected:
        with suppress(FlangeyeError):  # so the numbers are not poses, or not those of a cell
            mended = session.read_with(suspicion.changes)
            if _possible(mended.observations):
                # No slow search from random places: once the true mistake is corrected, closed
                # forms suffice
                tried.append((predicted(mended, search=False), suspicion))
    if not tried:
        return []
    after, best = min(tried, key=lambda each: each[0].size)
    # Once a true mistake is mended at most half of the held-out errors remain; the best of many
    # wrong suspicions lowers them a little too
    if not after.ordinary or after.size > 0.5 * before.size:
        return []
    known = before.misfit if np.isfinite(before.size) else None
    fix = session.line(best.changes)
    return [Finding(best.name, best.what, fix, before=known, after=known and after.misfit)]


def suspicions(session: CellSession) -> Iterator[Suspicion]:
    """Yield each mistake that may have been made, mended."""
    if session.tables is not None:
        above, params = session.first
        at: YamlPath = (*above, "reader", "cell")
        given = params["reader"]["cell"]
        yield from _of_tables(at, given)
        yield from _of_axes(at, given.get("axes", {}), session.cell)
        yield from _exchanged(at, given.get("arms", {}))
    yield from _of_mountings(session.cell)


def _of_tables(at: YamlPath, given: Mapping[str, Any]) -> Iterator[Suspicion]:
    """Yield tables of poses read in another way: each alone, those of all cameras, and all."""
    arms = {(*at, "arms", name): table for name, table in given.get("arms", {}).items()}
    seen = {(*at, "sightings", i): table for i, table in enumerate(given.get("sightings", ()))}
    for keys, table in arms.items():
        yield from _read_otherwise(f"the poses of {keys[-1]}", {keys: table})
    for keys, table in seen.items():
        whose = f"what {table['camera']} saw of {table['target']}"
        yield from _read_otherwise(whose, {keys: table})
    if len(seen) > 1:
        yield from _read_otherwise("what all cameras saw", seen)
    yield from _rotations("all poses", {**arms, **seen})


def _read_otherwise(whose: str, tables: Mapping[YamlPath, ReaderTable]) -> Iterator[Suspicion]:
    """Yield tables whose poses are inverted, in another unit, or have other rotations."""
    pose = _common(tables, "pose")
    if pose is not None and _common(tables, "rotation") != "point":
        parent, child = str(pose).split("_T_")
        name = "inverted marker" if "camera" in (parent, child) else "inverted pose"
        inverse = f"{child}_T_{parent}"
        what = f"{whose} are poses {inverse}, not {pose}"
        yield Suspicion(name, what, {(*keys, "pose"): inverse for keys in tables})
    length = _common(tables, "length")
    for unit in LENGTHS:
        if length not in (None, unit):
            changes = {(*keys, "length"): unit for keys in tables}
            yield Suspicion("unit", f"{whose} is in {unit}", changes)
    yield from _rotations(whose, tables)


def _rotations(whose: str, tables: Mapping[YamlPath, ReaderTable]) -> Iterator[Suspicion]:
    """Yield other conventions in which the rotations of these tables may be written."""
    rotation, angle = _common(tables, "rotation"), _common(tables, "angle")
    for other in other_conventions(rotation, angle) if rotation is not None else ():
        was, fits = describe_rotation(rotation, angle), describe_rotation(*other)
        changes: dict[YamlPath, Any] = {(*keys, "rotation"): other[0] for keys in tables}
        changes |= {(*keys, "angle"): other[1] for keys in tables if other[1]}
        what = f"the rotations of {whose} were read as {was}, and fit as {fits}"
        yield Suspicion("pose convention", what, changes)


def _common(tables: Mapping[YamlPath, ReaderTable], key: str) -> Any:
    """Return the value that all tables state; None if they differ."""
    stated = {table.get(key) for table in tables.values()}
    return stated.pop() if len(stated) == 1 else None


def _of_axes(at: YamlPath, tables: Mapping[str, ReaderTable], cell: Cell) -> Iterator[Suspicion]:
    """Yield rails and positioners in another unit, or that move the other way."""
    for name, table in tables.items():
        for unit in {"m": ["mm"], "mm": ["m"], "rad": ["deg"], "deg": ["rad"]}[table["unit"]]:
            what = f"the values of {name} are in {unit}"
            yield Suspicion("unit", what, {(*at, "axes", name, "unit"): unit})
        axis = cell.movers[name]
        if isinstance(axis, Axis):
            section: YamlPath = ("cell", "positioners" if axis.turns else "rails", name)
            low, high = axis.travel
            unit = "rad" if axis.turns else "m"
            other = {
                (*section, "axis"): [0.0 - float(x) for x in axis.direction],
                (*section, "travel"): [f"{-high:g} {unit}", f"{-low:g} {unit}"],
            }
            what = f"{name} moves against the axis that the recipe states"
            yield Suspicion("reversed axis", what, other)


def _exchanged(at: YamlPath, arms: Mapping[str, ReaderTable]) -> Iterator[Suspicion]:
    """Yield changes that exchange the tables of two arms."""
    for one, two in combinations(arms, 2):
        tables = arms[one], arms[two]
        changes = {
            (*at, "arms", name, key): other[key]
            for name, own, other in ((one, *tables), (two, *tables[::-1]))
            for key in own.keys() & other.keys()
            if own[key] != other[key]
        }
        if changes:
            what = f"the poses of {one} and {two} are exchanged"
            yield Suspicion("swapped arms", what, changes)


def _of_mountings(cell: Cell) -> Iterator[Suspicion]:
    """Yield changes that mount a camera or target on another frame."""
    for group, name in _to_find(cell):
        stands = cell.frames[name].parent
        for other in ("base", *cell.movers):
            if other != stands:
                what = f"{name} is mounted on {other}, not on {stands}"
                yield Suspicion("mounting", what, {("cell", group, name): {"on": other}})


def _of_links(session: CellSession) -> Iterator[Suspicion]:
    """Yield changes that mount a camera or target on another link of the same arm."""
    cell = session.cell
    for group, name in _to_find(cell):
        stands = cell.frames[name].parent
        for link in _links_beside(stands, session.observations, cell):
            on = {"on": link.arm, "link": link.number}
            what = f"{name} is mounted on {link.frame}, not on {stands}"
            yield Suspicion("mounting", what, {("cell", group, name): on})


def _to_find(cell: Cell) -> list[tuple[str, str]]:
    """Return the cameras and targets whose places are not known, with their group."""
    ends = [*(("cameras", x) for x in cell.cameras), *(("targets", x) for x in cell.targets)]
    return [(group, name) for group, name in ends if cell.frames[name].place is None]


def _links_beside(stands: str, observations: Sequence[Observation], cell: Cell) -> list[Link]:
    """Return the links of the arm that carries a frame, if its joints are recorded.

    The last link is left out, as it is rigidly connected to the flange.
    """
    arm = cell.links[stands].arm if stands in cell.links else stands
    if arm not in cell.joints(observations):
        return []
    links = [Link(arm, i) for i in range(1, len(cell.arms[arm].joints))]
    return [link for link in links if link.frame != stands]


def _mispaired(session: CellSession) -> list[Finding]:
    """Return the observations that contradict their poses, if the others agree."""
    observations = session.observations
    try:
        found = preview(problem_of(observations, session.cell), session.cell.freedoms)
    except (FlangeyeError, np.linalg.LinAlgError):
        return []
    errors = np.linalg.norm(found.errors[:, 3:], axis=1)
    # What the solver sets aside may be noise; a sighting of another pose is off by far more
    ordinary = 5.0 * np.sqrt((errors[found.inliers] ** 2).mean())
    wrong = ~found.inliers & (errors > ordinary)
    far = [o.id for o, gone in zip(observations, wrong, strict=True) if gone]
    if not far or 3 * len(far) > len(observations):
        return []
    what = (
        f"{len(far)} of {len(observations)} sightings do not fit their poses; the others agree "
        "without them"
    )
    step, params = session.first
    fix = session.line({(*step, "leave_out"): far}) if "leave_out" in params else ""
    return [Finding("mis-paired pose", what, fix, tuple(far))]


@dataclass(frozen=True)
class CellPrediction:
    """Prediction error of held-out observations.

    Attributes:
        misfit: Median errors over the observations, of the camera-target pair with the largest.
        share: Position error relative to the spread of the pair's observations; a change of unit
            scales both and is no finding.
    """

    misfit: Misfit
    share: float

    @property
    def size(self) -> float:
        """Size of the errors, in units of those of sound sightings."""
        # Errors of sound sightings, as a share of how far they are apart, and of their rotations
        # [rad]: so large that noise does not reach them, for a wrong unit, side or mounting gives
        # errors as large as the motion itself
        ordinary = 0.02, np.radians(1.0)
        return float(max(self.share / ordinary[0], (self.misfit.angle or 0.0) / ordinary[1]))

    @property
    def ordinary(self) -> bool:
        """Whether errors of this size occur without a mistake."""
        return self.size <= 1


def predicted(session: CellSession, search: bool = True) -> CellPrediction:
    """Return each sighting's error as predicted by the others; infinite without a solution."""
    observations = session.observations
    try:
        found = preview(problem_of(observations, session.cell), session.cell.freedoms, search)
    except (FlangeyeError, np.linalg.LinAlgError):
        return CellPrediction(Misfit(np.inf), np.inf)
    turns, places = (np.linalg.norm(found.errors[:, at], axis=1) for at in (slice(3), slice(3, 6)))
    centres = np.array([o.feature.centre for o in observations])
    of_pairs = []
    for of in _by_pair(observations).values():
        # Medians: a few sightings beside wrong poses are not yet a mistake of the whole pair
        spread = max(float(np.linalg.norm(centres[of].std(axis=0))), 1e-12)
        place, turn = float(np.median(places[of])), float(np.median(turns[of]))
        of_pairs.append(CellPrediction(Misfit(place, turn), place / spread))
    return max(of_pairs, key=lambda pair: pair.size)


def _possible(observations: Sequence[Observation]) -> bool:
    """Whether typical distances of targets and arms are those of a cell."""
    seen = np.array([np.linalg.norm(o.feature.centre) for o in observations])
    reach = [x.translation for o in observations for x in o.poses.values()]
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

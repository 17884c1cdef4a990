"""Read an archive with its recipe into the arrays that checks use.

The reader's poses are used unchanged, even if they are wrong. Features are found in the scans by
the recipe's steps with placeholder poses, so that wrong poses have no influence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.files.recording import Archive, NotThisLayout, Recording, check_ids
from flangeye.files.yaml_lines import parse_yaml
from flangeye.models.boards import BoardKind
from flangeye.models.cell import cell_of
from flangeye.models.configuration import DEFAULT, LINK, Configuration
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerData
from flangeye.models.targets import Flange, flange_of, known_standards
from flangeye.plugin.registry import Registry
from flangeye.plugin.stage import BoundPart, Params, Part
from flangeye.types import Floats
from flangeye.types.geometry import rigid
from flangeye.workflow.doctor.cells import examine_cell, open_cell
from flangeye.workflow.doctor.diagnosis import (
    FEWEST_SAMPLES,
    Diagnosis,
    Finding,
    ReadAgain,
    ReaderLine,
    RecordedSession,
    as_yaml,
    examine,
)
from flangeye.workflow.log.read import RunLog, is_log, log_of, read_run
from flangeye.workflow.recipe.load import Recipe
from flangeye.workflow.recipe.steps import Step
from flangeye.workflow.run.folder import recipe_of_log
from flangeye.workflow.run.runner import Runner


class State(NamedTuple):
    """Optional records of a sample: joint angles (n,) [rad], base2_T_flange2 (4, 4) [m]."""

    joints: Floats | None
    second: Floats | None


def in_configuration(
    session: RecordedSession,
    configuration: Configuration,
    robot: RobotModel | None,
    states: Mapping[str, State],
) -> RecordedSession:
    """Return the session with its configuration: carriers of camera and target, and mounting.

    Args:
        session: The session of one arm beside its camera, as far as is known.
        configuration: Replaces the configuration that the session assumes.
        robot: The arm's model, if the recipe names one.
        states: Other recorded data, by the samples' ids.

    Raises:
        StageError: A carrier's pose is missing.
    """
    carried: Literal["target", "camera", "both"] = (
        "both" if configuration.other_base else "camera" if configuration.target == t.BASE
        else "target"
    )  # fmt: skip
    known = configuration.place
    if configuration.other_base and known is None and not np.isfinite(session.rotations).any():
        raise StageError(
            "two arms with a circle at an unknown place cannot be solved: state its place, which "
            "is known for the flange's own circle, or use a marker"
        )
    links = seconds = None
    carriers = (configuration.camera, configuration.target)
    if any(LINK in carrier for carrier in carriers) or configuration.other_base:
        bare = [_bare(session, i, states) for i in range(len(session))]
        frames = cell_of(configuration, robot).graph(bare)
        if configuration.other_base:
            seconds = frames[t.FLANGE2].place
        elif LINK in configuration.camera:
            links = frames[configuration.camera].place
        else:
            # The link that carries the target takes the flange's place in every check
            session = replace(session, poses=np.asarray(frames[configuration.target].place))
    # A place that is to be found is unknown to the checks too; the origin would be a claim
    places = session.places if known is not None else np.full_like(session.places, np.nan)
    return replace(
        session,
        carried=carried,
        links=links,
        seconds=seconds,
        place=np.eye(4) if known is None else known,
        robot=robot,
        places=places,
    )


def _bare(session: RecordedSession, index: int, states: Mapping[str, State]) -> t.Observation:
    """Return a sample as an observation without a feature: where the controllers had it."""
    name = session.ids[index]
    joints, second = states.get(name, State(None, None))
    nothing = t.CircleFeature(np.zeros(3), None, {}, np.eye(3), None, 0.0)
    return t.Observation(
        name,
        nothing,
        t.by_frame(
            t.Transform(t.BASE, t.FLANGE, session.poses[index]),
            None if second is None else t.Transform(t.BASE2, t.FLANGE2, second),
        ),
        joints,
    )


def examined(
    path: Path,
    registry: Registry,
    recipe: Recipe | None = None,
    checked: Callable[[], None] = lambda: None,
) -> Diagnosis:
    """Return the mistakes in an archive, by every check, or by those of cells for a cell.

    Args:
        path: A run.mcap, or a folder that a reader knows.
        registry: The plugins on offer.
        recipe: See :func:`open_session`.
        checked: See :func:`examine`.

    Raises:
        StageError: The archive cannot be read, or holds too few samples to judge.
    """
    if cell := open_cell(path, registry, recipe):
        return examine_cell(cell)
    session = open_session(path, registry, recipe)
    return examine(session, registry.of_kind("check"), checked)


def open_session(path: Path, registry: Registry, recipe: Recipe | None = None) -> RecordedSession:
    """Return an archive as a session for checks.

    Args:
        path: A run.mcap, or a folder that a reader knows.
        registry: The plugins on offer.
        recipe: Recipe for reading the archive and finding the target in scans; a log contains its
            own, and a folder with detected centres needs none.

    Raises:
        StageError: The archive cannot be read, or contains scans and there is no recipe.
    """
    if not path.exists():
        raise StageError(f"{path}: does not exist")
    if path.suffix == ".mcap" or is_log(log_of(path)):
        return _of_log(log_of(path), registry, recipe)
    if recipe is None:
        return _of_centres(path, registry)
    return _of_recipe(path, registry, recipe)


def _of_log(path: Path, registry: Registry, recipe: Recipe | None) -> RecordedSession:
    log = read_run(path)
    log.require_gathered()
    if recipe is None and log.has_recipe:
        recipe = recipe_of_log(log, registry, name=path.name)
    found = {o.id: o.feature for o in log.observations()}
    calibration = [meta for meta in log.poses.values() if meta["role"] == "calibration"]
    given = {o.id: o.base_T_flange.matrix for o in log.observations()}
    poses = {meta["id"]: np.array(meta["poses"][t.FLANGE]["matrix"]) for meta in calibration}
    times = {meta["id"]: int(meta["time_ns"]) for meta in calibration}
    # Captures without a feature keep their poses and places: the checks of order need every moment
    every = poses | {name: pose for name, pose in given.items() if name not in poses}
    session = replace(_session(every, found, times), damage=tuple(log.notes))
    states = {meta["id"]: _state_of(meta) for meta in calibration}
    if recipe is not None:
        session = replace(_as_recipe(session, recipe, states), again=_archive_again(recipe, found))
    remarks = (*session.remarks, *_rejected(log.rejections), *_set_aside(log))
    return replace(session, remarks=remarks)


def _archive_again(recipe: Recipe, found: Mapping[str, t.Feature]) -> ReadAgain | None:
    """Return a function that reads a log's archive again, if the recipe names it."""
    params = recipe.steps[0].params
    path, reader = getattr(params, "path", None), getattr(params, "reader", None)
    if path is None or not isinstance(reader, BoundPart) or not Path(path).exists():
        return None
    return partial(_read_again, Path(path), (reader, recipe), found)


def _rejected(rejections: Sequence[t.Rejection]) -> Iterator[Finding]:
    """Yield a finding for each cause that the whole session shares, and a note on the others."""
    alike: dict[tuple[str, str, str], list[str]] = {}
    for one in rejections:
        alike.setdefault((one.stage, one.reason, one.fix), []).append(one.id)
    for (stage, reason, fix), ids in alike.items():
        what = f"{stage}: {reason}" + ("" if fix else f": {', '.join(ids)}")
        yield Finding("set aside", what, fix, tuple(ids), note=not fix)


def _set_aside(log: RunLog) -> Iterator[Finding]:
    """Yield a note on the observations that the run's solver did not use."""
    of_solver = [o for o in (log.result or {}).get("observations", ()) if o["residual"] is not None]
    gone = [o for o in of_solver if not o["used"]]
    if gone and len(gone) < len(of_solver):
        worst = sorted(gone, key=lambda o: -o["residual"])
        # Samples that are written out
        told = ", ".join(f"'{o['id']}' {1e3 * o['residual']:.1f} mm" for o in worst[:8])
        what = f"the run's solver did not use {len(gone)} of the samples, with residuals {told}"
        # The solver's own reason for the worst names what to look for in all of them
        fix = f"look at these samples; {worst[0]['reason']}"
        yield Finding("set aside", what, fix, tuple(o["id"] for o in worst), note=True)


def _state_of(meta: Mapping[str, Any]) -> State:
    joints, second = meta["joints"], meta["poses"].get(t.FLANGE2)
    return State(
        None if joints is None else np.array(joints),
        None if second is None else np.array(second["matrix"]),
    )


def _of_centres(path: Path, registry: Registry) -> RecordedSession:
    try:
        archive: Archive = registry.part("reader.auto").bind()(path)
    except NotThisLayout:
        raise StageError(
            f"{path}: no reader knows this layout by itself, and no recipe states how it is read; "
            f"write one: flangeye init {path}; then: flangeye doctor recipe.yaml"
        ) from None
    if not _ready_made(archive):
        raise StageError(
            f"{path}: holds scans ({archive.layout}), and nothing says what to look for in them; "
            f"write a recipe: flangeye init {path}; then: flangeye doctor recipe.yaml"
        )
    return _of_archive(archive, _ready_made(archive))


def _of_recipe(path: Path, registry: Registry, recipe: Recipe) -> RecordedSession:
    first = recipe.steps[0]
    reader = getattr(first.params, "reader", None)
    if not isinstance(reader, BoundPart):
        raise StageError(
            f"{recipe.name}: begins with {first.stage.name}, which reads no archive; the doctor "
            "needs a recipe that begins with acquire.archive or acquire.centres"
        )
    archive: Archive = reader(path)
    check_ids(archive)
    found, remarks, other = found_in(archive, first, recipe, registry)
    kept = _kept(archive, first)
    session = _of_recordings(kept, found, recipe)
    if other is not None:
        return _read_otherwise(session, *other)
    again = partial(_read_again, path, (reader, recipe), found)
    return replace(session, again=again, remarks=remarks)


def _read_again(
    path: Path,
    by: tuple[BoundPart, Recipe],
    found: Mapping[str, t.Feature],
    arm: Mapping[str, Any],
    target: Mapping[str, Any],
) -> RecordedSession:
    """Return an archive's session by its reader with other parameters; see RecordedSession."""
    reader, recipe = by
    bound = _bound_with(reader, arm, target)
    archive = _kept(bound(path), recipe.steps[0])
    session = _of_recordings(archive, _ready_made(archive) or found, recipe)
    return replace(session, reader=_written(bound))


def _of_recordings(
    archive: Archive, found: Mapping[str, t.Feature], recipe: Recipe
) -> RecordedSession:
    states = {r.id: State(r.joints, r.poses.get(t.FLANGE2)) for r in archive.recordings}
    return _as_recipe(_of_archive(archive, found), recipe, states)


def _bound_with(reader: BoundPart, arm: Mapping[str, Any], target: Mapping[str, Any]) -> BoundPart:
    """Return a reader with other parameters for the poses and for the target's table."""
    changed: dict[str, Any] = dict(arm)
    of_target = getattr(reader.params, "target", None)
    if target and of_target is not None:
        changed["target"] = of_target.model_copy(update=target)
    return replace(reader, params=reader.params and reader.params.model_copy(update=changed))


def _read_otherwise(
    session: RecordedSession, change: Mapping[str, Any], why: str
) -> RecordedSession:
    """Return the session with its clouds read in another way, and a remark on that."""
    corrected_session = session.with_changes(**change)
    name = "unit" if "unit" in change else "mirrored axis"
    return replace(corrected_session, remarks=(Finding(name, why, corrected_session.step()),))


def _kept(archive: Archive, first: Step) -> Archive:
    left_out = getattr(first.params, "leave_out", ())
    return replace(archive, recordings=[r for r in archive.recordings if r.id not in left_out])


def _ready_made(archive: Archive) -> dict[str, t.Feature]:
    markers = {
        r.id: t.PoseFeature(t.Transform(t.CAMERA, t.TARGET, r.camera_T_target), np.eye(6))
        for r in archive.recordings
        if r.camera_T_target is not None
    }
    return markers | {
        r.id: t.CircleFeature(r.centre_in_camera, None, {}, np.eye(3), None, 0.0)
        for r in archive.recordings
        if r.centre_in_camera is not None
    }


def _of_archive(archive: Archive, found: Mapping[str, t.Feature]) -> RecordedSession:
    calibration: Sequence[Recording] = [r for r in archive.recordings if r.role == "calibration"]
    poses = {r.id: r.base_T_flange for r in calibration}
    times = {r.id: r.time_ns for r in calibration}
    session = _session(poses, found, times)
    motions = tuple(r.motion for r in calibration if r.motion and r.passes_alone)
    if len(motions) == len(calibration):
        session = replace(session, motions=motions)
    if not np.isfinite(session.rotations).any():
        return replace(session, acquire="acquire.centres")
    # A marker's place on what carries it is not known unless a recipe states it.
    unknown = np.full_like(session.places, np.nan)
    return replace(session, acquire="acquire.samples", places=unknown)


def _session(
    poses: Mapping[str, Floats], found: Mapping[str, t.Feature], times: Mapping[str, int]
) -> RecordedSession:
    features = [found.get(name) for name in poses]
    when = np.array([times.get(name, 0) for name in poses], dtype=np.float64)
    return RecordedSession(
        ids=tuple(poses),
        poses=np.array(list(poses.values())).reshape(-1, 4, 4),
        centres=_rows(None if f is None else f.centre for f in features),
        normals=_rows(f.normal if isinstance(f, t.CircleFeature) else None for f in features),
        rotations=_rotations(features),
        places=_rows(
            f.centre_in_flange if isinstance(f, t.CircleFeature) else np.zeros(3) for f in features
        ),
        times=np.where(when > 0, (when - when[:1]) * 1e-9, np.nan),
    )


def _rows(vectors: Iterable[Floats | None]) -> Floats:
    nothing = np.full(3, np.nan)
    return np.array([nothing if v is None else v for v in vectors]).reshape(-1, 3)


def _rotations(features: Iterable[t.Feature | None]) -> Floats:
    nothing = np.full((3, 3), np.nan)
    return np.array(
        [f.camera_T_target.rotation if isinstance(f, t.PoseFeature) else nothing for f in features]
    ).reshape(-1, 3, 3)


def _as_recipe(
    session: RecordedSession, recipe: Recipe, states: Mapping[str, State]
) -> RecordedSession:
    """Return the session with the recipe's facts about cell and reader."""
    first = recipe.steps[0]
    scanner: ScannerData | None = recipe.context.get(ScannerData)
    robot: RobotModel | None = recipe.context.get(RobotModel)
    reach = session.reach if scanner is None else scanner.range
    reader = _written(getattr(first.params, "reader", None))
    configuration: Configuration = recipe.context.get(Configuration) or DEFAULT
    return replace(
        in_configuration(session, configuration, robot, states),
        reach=reach,
        limit=_limit(recipe),
        marks_open=any(getattr(s.params, "unobservable", None) == "mark" for s in recipe.steps),
        reader=reader,
        acquire=first.stage.name,
        changes={**_given(first.params, {"reader", "path"}), **_path_in(recipe)},
        board=_board_of(recipe),
    )


def _board_of(recipe: Recipe) -> dict[str, Any]:
    """Return the board of a recipe's fit step, with its parameters as written."""
    asked = {"columns", "rows", "square", "marker", "dictionary"}
    for step in recipe.steps:
        kind = step.stage.name.removeprefix("fit.")
        if kind in get_args(BoardKind):
            stated = _given(step.params)
            return {"kind": kind, **{name: stated[name] for name in stated if name in asked}}
    return {}


def _path_in(recipe: Recipe) -> dict[str, Any]:
    """Return the archive's path as written in the recipe, for use in a suggested line."""
    steps = parse_yaml(recipe.text, recipe.name).data["steps"]
    params = next(iter(steps[0].values())) if isinstance(steps[0], Mapping) else None
    path = params.get("path") if isinstance(params, Mapping) else None
    return {} if path is None else {"path": path}


def _limit(recipe: Recipe) -> float:
    """Return the smallest error that the recipe asks for [m]."""
    asked = [
        getattr(s.params, name, None) for s in recipe.steps for name in ("max_rms", "required")
    ]
    return min(
        [float(limit) for limit in asked if limit is not None], default=RecordedSession.limit
    )


def _written(reader: Any) -> ReaderLine:
    """Return a reader as people write it: its name, with the parameters that were stated."""
    if not isinstance(reader, BoundPart):
        return "auto"
    name = reader.part.name.partition(".")[2]
    params = _given(reader.params)
    return {name: params} if params else name


def _given(params: Params | None, apart_from: Set[str] = frozenset()) -> dict[str, Any]:
    """Return the parameters that the recipe states, as it may write them."""
    if params is None:
        return {}
    stated = set(params.model_fields_set - apart_from)
    return params.model_dump(mode="json", include=stated, exclude_unset=True, exclude_none=True)


class _Seen(NamedTuple):
    """Result of a recipe's steps on scans: features, rejections, and a refusal of all."""

    features: dict[str, t.Feature]
    rejections: Sequence[t.Rejection]
    refused: StageError | None


def found_in(
    archive: Archive, first: Step, recipe: Recipe, registry: Registry
) -> tuple[dict[str, t.Feature], tuple[Finding, ...], tuple[Mapping[str, Any], str] | None]:
    """Return the features that the recipe finds in the scans; try other parameters if none.

    Returns:
        The features by id; findings from rejected captures; and, if the recipe's parameters find no
        feature, working parameters with the reason.
    """
    stated = None if first.params is None else getattr(first.params, "unit", None)
    seen = _seen_by(archive, first, recipe, registry)
    remarks = tuple(_rejected(seen.rejections))
    # A rejection with a cure of its own is the mistake: no other unit is tried
    if any(remark.fix for remark in remarks):
        return seen.features, remarks, None
    if len(seen.features) < FEWEST_SAMPLES and first.params is not None and stated is not None:
        # Other units; last the z of clouds that were written with the scene behind the scanner
        tried: list[dict[str, Any]] = [
            {"unit": unit} for unit in ("auto", "m", "mm", "cm", "in") if unit != stated
        ]
        for change in [*tried, {"stretch": (1.0, 1.0, -1.0)}]:
            params = first.params.model_copy(update=change)
            others = _seen_by(archive, replace(first, params=params), recipe, registry).features
            if len(others) >= FEWEST_SAMPLES:
                count = f"{len(seen.features)} of {len(archive.recordings)} scans"
                why = f"{count} show a target as read, {len(others)} do with {as_yaml(change)}"
                return others, (), (change, f"{seen.refused}; {why}" if seen.refused else why)
    if seen.refused is not None:
        if plate := _other_plate(archive, first, recipe, registry):
            return *plate, None
        raise seen.refused
    return seen.features, remarks, None


def _other_plate(
    archive: Archive, first: Step, recipe: Recipe, registry: Registry
) -> tuple[dict[str, t.Feature], tuple[Finding, ...]] | None:
    """Return the features of another standard plate, and the finding that names it.

    None if no other plate is seen either.
    """
    stated = recipe.context.get(Flange)
    if stated is None or stated.bore is None:
        return None
    few = replace(archive, recordings=archive.recordings[:FEWEST_SAMPLES])
    most: tuple[int, str, Recipe] = (0, "", recipe)
    for standard in known_standards():
        context = recipe.context | {Flange: flange_of(stated.details, standard)}
        other = replace(recipe, context=context)
        count = len(_seen_by(few, first, other, registry).features)
        most = max(most, (count, standard.designation, other), key=lambda each: each[0])
    features = _seen_by(archive, first, most[2], registry).features if most[0] else {}
    if len(features) < FEWEST_SAMPLES:
        return None
    what = (
        f"no scan shows the plate {stated.name}, {len(features)} of {len(archive.recordings)} "
        f"show {most[1]}"
    )
    fix = f"feature: {as_yaml({'standard': most[1]})}"
    return features, (Finding("wrong plate", what, fix),)


def _seen_by(archive: Archive, first: Step, recipe: Recipe, registry: Registry) -> _Seen:
    """Return the result of the recipe's own steps on the archive's scans."""
    stand_in = BoundPart(
        Part("reader.stand_in", lambda _: _with_stand_in_poses(archive), None, {}, (Archive,)), None
    )
    # The recipe's steps run as in any run; only the reader of the first is replaced
    params = first.params.model_copy(update={"reader": stand_in}) if first.params else None
    steps = (replace(first, params=params), *recipe.steps[1:])
    runner = Runner(replace(recipe, steps=steps), registry, t.ArchivePath(archive.root))
    try:
        features = {o.id: o.feature for o in runner.observe()}
    except StageError as error:
        return _Seen({}, runner.rejections, error)
    return _Seen(features, runner.rejections, None)


def _with_stand_in_poses(archive: Archive) -> Archive:
    # 10 mm apart, half a metre above the base: no two alike, and every one within reach
    recordings = [
        replace(recording, poses={t.FLANGE: rigid(np.eye(3), np.array([0.01 * i, 0.0, 0.5]))})
        for i, recording in enumerate(archive.recordings)
    ]
    return replace(archive, recordings=recordings)

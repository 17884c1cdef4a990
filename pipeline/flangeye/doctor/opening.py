"""From an archive, and the recipe that would run on it, to the arrays that checks look at.

The reader's poses are taken as they are, whatever is wrong with them. What is seen in the scans
does not depend on them, so the recipe's own steps find it with stand-in poses that no step can
object to.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from flangeye import types as t
from flangeye.archive import Archive, Recording, check_ids
from flangeye.catalogue import ScannerModel
from flangeye.configuration import DEFAULT, Configuration
from flangeye.diagnosis import Finding, Floats, Reader, Session
from flangeye.errors import StageError
from flangeye.geometry import rigid
from flangeye.recipe import Recipe, parse_recipe
from flangeye.registry import Registry
from flangeye.runlog import read_run
from flangeye.runner import Runner
from flangeye.stage import Chosen, Params, Part
from flangeye.steps import Step

APART = 0.01
"""Between two stand-in poses [m]."""


def open_session(path: Path, registry: Registry, recipe: Recipe | None = None) -> Session:
    """Return what an archive holds, as checks see it.

    Args:
        path: A run.mcap, or a folder that a reader knows.
        registry: The plugins on offer.
        recipe: Says how the archive is read and how the target is found in its scans; a log
            brings its own, and a folder with ready-made centres needs none.

    Raises:
        StageError: The archive cannot be read, or has scans and no recipe says what is in them.
    """
    if not path.exists():
        raise StageError(f"{path}: does not exist")
    if path.suffix == ".mcap":
        return _of_log(path, registry, recipe)
    if recipe is None:
        return _of_centres(path, registry)
    return _of_recipe(path, registry, recipe)


def _of_log(path: Path, registry: Registry, recipe: Recipe | None) -> Session:
    log = read_run(path)
    text = log.attachments.get("recipe.yaml")
    if recipe is None and text is not None:
        recipe = parse_recipe(text.decode(), path.name, registry)
    found = {o.id: o.feature for o in log.observations()}
    calibration = [meta for meta in log.poses.values() if meta["role"] == "calibration"]
    given = {o.id: o.base_T_flange.matrix for o in log.observations()}
    poses = {meta["id"]: np.array(meta["base_T_flange"]["matrix"]) for meta in calibration}
    times = {meta["id"]: int(meta["time_ns"]) for meta in calibration}
    session = _session({**given, **poses}, found, times)
    return session if recipe is None else _as_recipe(session, recipe)


def _of_centres(path: Path, registry: Registry) -> Session:
    archive: Archive = registry.part("reader.auto").bind()(path)
    if not _ready_made(archive):
        raise StageError(
            f"{path}: holds scans ({archive.layout}), and nothing says what to look for in them; "
            "add --recipe with the recipe that would run on it"
        )
    return _of_archive(archive, _ready_made(archive))


def _of_recipe(path: Path, registry: Registry, recipe: Recipe) -> Session:
    first = recipe.steps[0]
    reader = getattr(first.params, "reader", None)
    if not isinstance(reader, Chosen):
        raise StageError(
            f"{recipe.name}: begins with {first.stage.name}, which reads no archive; the doctor "
            "needs a recipe that begins with acquire.archive or acquire.centres"
        )
    archive: Archive = reader(path)
    check_ids(archive)
    found, refused = _found(archive, first, recipe, registry)
    session = _as_recipe(_of_archive(_kept(archive, first), found), recipe)
    return session if refused is None else _in_other_unit(session, refused)


def _in_other_unit(session: Session, refused: StageError) -> Session:
    """Return the session with the remark that the stated unit of the clouds was refused."""
    mended = session.with_changes(unit="auto")
    remark = Finding("unit", str(refused), mended.step())
    return replace(mended, remarks=(remark,))


def _kept(archive: Archive, first: Step) -> Archive:
    left_out = getattr(first.params, "leave_out", ())
    return replace(archive, recordings=[r for r in archive.recordings if r.id not in left_out])


def _found(
    archive: Archive, first: Step, recipe: Recipe, registry: Registry
) -> tuple[dict[str, t.Feature], StageError | None]:
    """Return what the recipe's steps find in the scans, and why not in the unit that it states."""
    try:
        return _found_by(archive, first, recipe, registry), None
    except StageError as error:
        if first.params is None or getattr(first.params, "unit", "auto") == "auto":
            raise
        any_unit = replace(first, params=first.params.model_copy(update={"unit": "auto"}))
        return _found_by(archive, any_unit, recipe, registry), error


def _found_by(
    archive: Archive, first: Step, recipe: Recipe, registry: Registry
) -> dict[str, t.Feature]:
    """Return what the recipe's own steps find in the archive's scans, by id."""
    stand_in = Chosen(
        Part("reader.stand_in", lambda _: _with_stand_in_poses(archive), None, {}, (Archive,)), None
    )
    params = first.params.model_copy(update={"reader": stand_in}) if first.params else None
    steps = (replace(first, params=params), *recipe.steps[1:])
    runner = Runner(replace(recipe, steps=steps), registry, t.ArchivePath(archive.root))
    return {o.id: o.feature for o in runner.observe()}


def _with_stand_in_poses(archive: Archive) -> Archive:
    recordings = [
        replace(recording, base_T_flange=rigid(np.eye(3), np.array([APART * (i % 1000), 0.0, 0.5])))
        for i, recording in enumerate(archive.recordings)
    ]
    return replace(archive, recordings=recordings)


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


def _of_archive(archive: Archive, found: Mapping[str, t.Feature]) -> Session:
    calibration: Sequence[Recording] = [r for r in archive.recordings if r.role == "calibration"]
    poses = {r.id: r.base_T_flange for r in calibration}
    times = {r.id: r.time_ns for r in calibration}
    session = _session(poses, found, times)
    if not np.isfinite(session.rotations).any():
        return replace(session, acquire="acquire.centres")
    # A marker's place on what carries it is not known unless a recipe says so.
    unknown = np.full_like(session.places, np.nan)
    return replace(session, acquire="acquire.samples", places=unknown)


def _session(
    poses: Mapping[str, Floats], found: Mapping[str, t.Feature], times: Mapping[str, int]
) -> Session:
    features = [found.get(name) for name in poses]
    when = np.array([times.get(name, 0) for name in poses], dtype=np.float64)
    return Session(
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


def _in_configuration(session: Session, configuration: Configuration) -> Session:
    """Add who carries what, and where the target is in what carries it.

    Raises:
        StageError: More than one arm, or a link, carries something.
    """
    carried: dict[str, Literal["target", "camera"]] = {
        "eye-on-base": "target", "eye-in-hand": "camera",
    }  # fmt: skip
    if configuration.name not in carried:
        raise StageError(
            f"the doctor knows {' and '.join(carried)}, not {configuration.name}; give it the "
            "recording of one arm as one of these"
        )
    known = configuration.place
    places = session.places if known is not None else np.full_like(session.places, np.nan)
    return replace(
        session,
        carried=carried[configuration.name],
        place=np.eye(4) if known is None else known,
        places=places,
    )


def _as_recipe(session: Session, recipe: Recipe) -> Session:
    """Add what the recipe says of the cell and of how the archive is read."""
    first = recipe.steps[0]
    scanner: ScannerModel | None = recipe.context.get(ScannerModel)
    reach = session.reach if scanner is None else (scanner.near, scanner.far)
    reader = _written(getattr(first.params, "reader", None))
    configuration: Configuration = recipe.context.get(Configuration) or DEFAULT
    return replace(
        _in_configuration(session, configuration),
        reach=reach,
        reader=reader,
        acquire=first.stage.name,
        changes={} if first.params is None else _given(first.params, {"reader", "path"}),
    )


def _written(reader: Any) -> Reader:
    """Return a reader as people write it: its name, with the parameters that were stated."""
    if not isinstance(reader, Chosen):
        return "auto"
    name = reader.part.name.partition(".")[2]
    params = {} if reader.params is None else _given(reader.params)
    return {name: params} if params else name


def _given(params: Params, apart_from: Set[str] = frozenset()) -> dict[str, Any]:
    """Return the parameters that the recipe states, as it may write them."""
    stated = set(params.model_fields_set - apart_from)
    return params.model_dump(mode="json", include=stated)

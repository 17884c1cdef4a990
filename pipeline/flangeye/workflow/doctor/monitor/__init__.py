"""Monitoring: a series of checks whether a stored calibration is still valid."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from flangeye import types as t
from flangeye.devices import MotionAllowed
from flangeye.errors import StageError
from flangeye.files.yaml_lines import dumped, parse_yaml
from flangeye.plugin.registry import Registry
from flangeye.workflow.doctor.monitor.history import MonitorCheck, prints_of
from flangeye.workflow.doctor.monitor.stored import StoredCalibration
from flangeye.workflow.log.read import RunLog, log_of, read_run
from flangeye.workflow.recipe.load import parse_recipe
from flangeye.workflow.run.folder import CHECKS_FOLDER, RunFolder, recipe_of_log
from flangeye.workflow.run.runner import Runner
from flangeye.workflow.run.session import record_scans


def from_archive(
    path: Path, stored: StoredCalibration, registry: Registry, overrides: Sequence[str] = ()
) -> MonitorCheck:
    """Return one check: the flange as measured in an archive.

    Args:
        path: A later run's folder or ``run.mcap``, or recordings that a reader knows; those are
            segmented and fitted as the calibration's own recipe did.
        stored: The calibration.
        registry: The plugins on offer.
        overrides: Changes to the calibration's recipe for reading these recordings.

    Raises:
        StageError: The recordings cannot be read, are of another robot, contain scans of the
            calibration itself, or show no flange.
    """
    log = log_of(path)
    if log.suffix == ".mcap" and log.is_file():
        run = read_run(log)
        stored.refuse_another_arm(run)
        used = {o.id for o in stored.used}
        _refuse_own(path, _moments(run, set(run.poses)) & _moments(stored.log, used))
        return _checked(stored, path, *_of_log(run))
    if not path.exists():
        raise StageError(f"{path}: does not exist")
    recipe = parse_recipe(
        _from_archive(stored), stored.path.name, registry, overrides, stored.log.models
    )
    seen = Runner(recipe, registry, t.ArchivePath(path)).take(None)
    return _checked(stored, path, seen, path.stat().st_mtime_ns)


def from_arm(
    stored: StoredCalibration,
    registry: Registry,
    scans: int,
    move: bool,
    overrides: Sequence[str] = (),
) -> MonitorCheck:
    """Return one check from new scans, driving the arm as the calibration's recipe does.

    The scans are stored as a run in ``checks/<time>`` beside the calibration's log.

    Raises:
        NothingMoved: ``move`` is false; the message is the plan.
        StageError: The recipe drives no arm, or the flange is in none of the scans.
    """
    first = str(_recipe(stored)["steps"][0])
    if "acquire.live" not in first:
        raise StageError(
            f"{stored.path}: was not calibrated live; take scans yourself and name them with "
            "--archive"
        )
    recipe = recipe_of_log(stored.log, registry, overrides)
    folder = RunFolder.create("check", None, stored.path.parent / CHECKS_FOLDER)
    record_scans(recipe, registry, folder, MotionAllowed(move), scans)
    return _checked(stored, folder.path, *_of_log(read_run(folder.log)))


def _of_log(log: RunLog) -> tuple[list[t.Observation], int]:
    times = [int(meta["time_ns"]) for meta in log.poses.values()]
    return log.observations(), max([0, *times]) or log.path.stat().st_mtime_ns


def _from_archive(stored: StoredCalibration) -> str:
    """Return the calibration's recipe, made to read recordings."""
    data = _recipe(stored)
    first = data["steps"][0]
    # These steps read later recordings as they read the calibration's. One scan is a check,
    # though it would be no calibration: hence `fewest`
    reads_recordings = ("acquire.archive", "acquire.centres", "acquire.samples", "acquire.images")
    name = next((name for name in reads_recordings if name in first), None)
    params = first[name] if name and isinstance(first, dict) else None
    data["steps"][0] = {name or reads_recordings[0]: {**(params or {}), "fewest": 1}}
    return dumped(data)


def _recipe(stored: StoredCalibration) -> dict[str, Any]:
    data = parse_yaml(stored.recipe, stored.path.name).data if stored.recipe else None
    if not (isinstance(data, Mapping) and data.get("steps")):
        raise StageError(
            f"{stored.path}: holds no recipe with steps, so nothing says how to take or read scans"
        )
    return dict(data)


def _checked(
    stored: StoredCalibration, path: Path, seen: list[t.Observation], time_ns: int
) -> MonitorCheck:
    if not seen:
        raise StageError(
            f"{path}: the target was found in none of its scans, so nothing is checked"
        )
    if len({type(o.feature) for o in (*seen, *stored.used)}) > 1:
        raise StageError(
            f"{path}: shows another target than the calibration's, so nothing is checked"
        )
    _refuse_own(path, prints_of(seen) & prints_of(stored.used))
    return MonitorCheck(str(path), tuple(seen), time_ns)


def _refuse_own(path: Path, shared: Collection[Any]) -> None:
    """Refuse the scans that the calibration was estimated from: they cannot show a change."""
    if shared:
        raise StageError(
            f"{path}: {len(shared)} of its scans are the calibration's own, which check nothing; "
            "scan again, with another seed where the cell is simulated"
        )


def _moments(log: RunLog, ids: set[str]) -> set[tuple[int, str]]:
    """Return when and where scans were taken: they stay the same when they are fitted anew."""
    told = (log.poses[name] for name in ids & set(log.poses))
    return {(facts["time_ns"], str(facts["poses"])) for facts in told if facts["time_ns"]}

"""``reader.auto``: choose the reader that fits a path, among all installed ones."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from pydantic import ValidationError

from flangeye import StageError, part
from flangeye.files.recording import Archive, NotThisLayout
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import BoundPart, Part, Siblings
from flangeye_plugins.reader.ancorasir import ancorasir
from flangeye_plugins.reader.folder import folder

BUILT_IN: Siblings = {"ancorasir": ancorasir, "folder": folder}


@part("reader.auto")
def auto(
    path: Path, siblings: Siblings = BUILT_IN, kinematics: RobotModel | None = None
) -> Archive:
    """Detect the layout: try every installed reader and report the one that fits."""
    bound = {name: _bound(reader) for name, reader in siblings.items()}
    readers = {name: reader for name, reader in bound.items() if reader}
    found, missed = _tried(readers, path, kinematics)
    if len(found) == 1:
        ((name, archive),) = found.items()
        note = f"reader: {name}, chosen by what {archive.root} holds"
        return replace(archive, notes=(note, *archive.notes))
    if found:
        raise StageError(
            f"{path}: could be read by {' and '.join(found)}; choose one, for example "
            f"reader: {next(iter(found))}"
        )
    untried = [name for name, reader in bound.items() if reader is None]
    if untried:
        missed.append(
            f"not tried, because a recipe must give their parameters: {', '.join(untried)}"
        )
    raise NotThisLayout(
        f"{path}: no reader knows this layout; 'flangeye init {path}' writes a recipe for other "
        f"layouts; tried: {'; '.join(missed)}"
    )


def _bound(reader: Part) -> BoundPart | None:
    """Return a reader with its default parameters, or None if some have no default."""
    try:
        return reader.bind()
    except ValidationError:
        return None


def _tried(
    readers: Mapping[str, BoundPart], path: Path, kinematics: RobotModel | None
) -> tuple[dict[str, Archive], list[str]]:
    """Return the archives by readers that fit the path, and the other readers' reasons."""
    found: dict[str, Archive] = {}
    missed: list[str] = []
    for name, reader in readers.items():
        arm = {"kinematics": kinematics} if "kinematics" in reader.part.needs else {}
        try:
            found[name] = reader(path, **arm)
        except NotThisLayout as error:
            missed.append(f"{name} ({error.wrong.removeprefix(f'{path}: ')})")
    return found, missed

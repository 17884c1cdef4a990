"""Find out which reader knows a path: the built-in ones, and those of every installed plugin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pydantic import ValidationError

from flangeye import StageError, part
from flangeye.archive import Archive, NotThisLayout
from flangeye.stage import Part, Siblings
from flangeye_plugins.readers.ancorasir import ancorasir
from flangeye_plugins.readers.folder import folder

BUILT_IN: Siblings = {"ancorasir": ancorasir, "folder": folder}


@part("reader.auto")
def auto(path: Path, siblings: Siblings = BUILT_IN) -> Archive:
    """Try every reader that is installed and take the one that knows the path; says which."""
    found: dict[str, Archive] = {}
    missed: list[str] = []
    for name, reader in siblings.items():
        try:
            found[name] = _read(reader, path)
        except NotThisLayout as error:
            missed.append(f"{name} ({str(error).removeprefix(f'{path}: ')})")
    if len(found) == 1:
        ((name, archive),) = found.items()
        note = f"reader: {name}, chosen by what {archive.root} holds"
        return replace(archive, notes=(note, *archive.notes))
    if found:
        raise StageError(
            f"{path}: could be read by {' and '.join(found)}; choose one, for example "
            f"reader: {next(iter(found))}"
        )
    raise StageError(f"{path}: no reader knows this layout: {'; '.join(missed)}")


def _read(reader: Part, path: Path) -> Archive:
    """Read with a reader's default parameters.

    Raises:
        NotThisLayout: It does not know the path, or nothing of it without being told more.
    """
    try:
        chosen = reader.bind()
    except ValidationError:
        raise NotThisLayout("has parameters that a recipe must give") from None
    archive: Archive = chosen(path)
    return archive

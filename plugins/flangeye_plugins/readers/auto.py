"""Find out which of the built-in readers knows a path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from flangeye import StageError, part
from flangeye.archive import Archive, NotThisLayout
from flangeye.stage import Chosen
from flangeye_plugins.readers.ancorasir import ancorasir
from flangeye_plugins.readers.folder import folder

_READERS: Mapping[str, Chosen] = {"ancorasir": ancorasir.bind(), "folder": folder.bind()}


@part("reader.auto")
def auto(path: Path) -> Archive:
    """Try the built-in readers and take the one that knows the path; says which it was."""
    found: dict[str, Archive] = {}
    missed: list[str] = []
    for name, reader in _READERS.items():
        try:
            found[name] = reader(path)
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

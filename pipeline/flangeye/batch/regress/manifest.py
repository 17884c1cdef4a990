"""A manifest: where a recording lies, how it is read, what is expected of it, whose it is."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from flangeye.errors import RecipeError
from flangeye.models.model import Model, read_model
from flangeye.units import Length


class Expected(Model):
    """What a run of the recording came to when it was last believed."""

    status: Literal["verified", "unverified", "refused"] = "verified"
    closure: Length | None = Field(None, description="Median held-out error.")
    tolerance: Length | None = Field(None, description="How far the closure may be from that.")
    findings: tuple[str, ...] | None = Field(
        None,
        description="Names of what flangeye doctor finds, in any order; not asked if not given.",
    )


class Manifest(Model):
    """One recording."""

    title: str = Field(description="One line for people.")
    recording: str = Field(
        description="The folder or file, from the manifest's folder, or from ~; skipped if absent."
    )
    recipe: str = Field(description="A bundled recipe, or a file, from the manifest's folder.")
    reader: Any = Field(
        None, description="The reader and its conventions, as a recipe has them; the recipe's own "
        "if not given.",
    )  # fmt: skip
    overrides: tuple[str, ...] = Field((), description="As --set: fit.rim.inlier=0.2 mm.")
    expected: Expected
    source: str = Field(description="Where others find the recording.")
    licence: str = Field(description="Under which licence, or that none is stated.")


def read_manifests(folder: Path) -> dict[Path, Manifest]:
    """Return the manifests of a folder by their files.

    Raises:
        RecipeError: There are none, or one is wrong: names the line.
    """
    files = sorted(p for p in folder.glob("*.y*ml") if p.is_file())
    if not files:
        raise RecipeError(
            f"{folder}: holds no manifests; one is a .yaml file with title, recording, recipe, "
            "expected, source and licence"
        )
    return {file: _checked(file) for file in files}


def _checked(file: Path) -> Manifest:
    manifest = read_model(file, Manifest)
    if (manifest.expected.closure is None) != (manifest.expected.tolerance is None):
        raise RecipeError(f"{file}: expected.closure and expected.tolerance go together")
    return manifest

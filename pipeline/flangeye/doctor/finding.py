"""What a recipe's own steps find in an archive's scans, whatever is wrong with its poses.

It does not depend on the poses: they are found with stand-ins that no step can object to.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from flangeye import types as t
from flangeye.doctor.diagnosis import FEWEST
from flangeye.errors import StageError
from flangeye.files.recording import Archive
from flangeye.maths.geometry import rigid
from flangeye.plugin.registry import Registry
from flangeye.plugin.stage import BoundPart, Part
from flangeye.recipe.load import Recipe
from flangeye.recipe.steps import Step
from flangeye.run.runner import Runner

APART = 0.01
"""Between two stand-in poses [m]."""


def found_in(
    archive: Archive, first: Step, recipe: Recipe, registry: Registry
) -> tuple[dict[str, t.Feature], tuple[str, str] | None]:
    """Return what the recipe's steps find in the scans, in another unit if they find nothing.

    Returns:
        The features by id; the unit they were found in and why not in that of the recipe, if so.
    """
    stated = None if first.params is None else getattr(first.params, "unit", None)
    refused, found = None, dict[str, t.Feature]()
    try:
        found = _found_by(archive, first, recipe, registry)
    except StageError as error:
        refused = error
    if len(found) < FEWEST and stated is not None:
        for unit in _UNITS[stated]:
            others = _in_unit(archive, first, recipe, registry, unit)
            if len(others) >= FEWEST:
                few = f"{len(found)} of {len(archive.recordings)} scans show a target with unit: "
                seen = f"{few}{stated}, {len(others)} do with unit: {unit}"
                return others, (unit, seen if refused is None else f"{refused}; {seen}")
    if refused is not None:
        raise refused
    return found, None


_UNITS: Mapping[str, tuple[str, ...]] = {
    "auto": ("m", "mm", "in"), "m": ("auto", "mm", "in"), "mm": ("auto", "m", "in"),
    "in": ("auto", "m", "mm"),
}  # fmt: skip
"""What else clouds may be in, by what the recipe says."""


def _in_unit(
    archive: Archive, first: Step, recipe: Recipe, registry: Registry, unit: str
) -> dict[str, t.Feature]:
    """Return what is found in the scans in another unit; nothing where that is refused."""
    params = None if first.params is None else first.params.model_copy(update={"unit": unit})
    try:
        return _found_by(archive, replace(first, params=params), recipe, registry)
    except StageError:
        return {}


def _found_by(
    archive: Archive, first: Step, recipe: Recipe, registry: Registry
) -> dict[str, t.Feature]:
    """Return what the recipe's own steps find in the archive's scans, by id."""
    stand_in = BoundPart(
        Part("reader.stand_in", lambda _: _with_stand_in_poses(archive), None, {}, (Archive,)), None
    )
    params = first.params.model_copy(update={"reader": stand_in}) if first.params else None
    steps = (replace(first, params=params), *recipe.steps[1:])
    runner = Runner(replace(recipe, steps=steps), registry, t.ArchivePath(archive.root))
    return {o.id: o.feature for o in runner.observe()}


def _with_stand_in_poses(archive: Archive) -> Archive:
    recordings = [
        replace(
            recording,
            poses={t.FLANGE: rigid(np.eye(3), np.array([APART * i, 0.0, 0.5]))},
        )
        for i, recording in enumerate(archive.recordings)
    ]
    return replace(archive, recordings=recordings)

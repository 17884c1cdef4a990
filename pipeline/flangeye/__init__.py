"""flangeye: hand-eye calibration from the robot's own flange.

This package has the names that every plugin needs. Also public are the packages ``types``,
``units``, ``devices``, ``errors``, ``maths``, ``estimation``, ``models``, ``files``, ``motion``,
``plugin`` and ``testing``, the modules ``workflow.log.read``, ``workflow.recipe.header`` and
``workflow.result``, and those that hold contracts of parts; the rest may change without notice. The
last contract in pyproject.toml holds plugins to it.

A name is imported at its first use, so that ``--help`` loads no numerical library.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flangeye.errors import CalibrationRefused, FlangeyeError, RecipeError, StageError
    from flangeye.files.paths import VERSION as __version__  # noqa: N811
    from flangeye.files.paths import RecipePath
    from flangeye.plugin.hookspecs import hookimpl
    from flangeye.plugin.stage import BoundPart, Choose, Params, part, stage

__all__ = [
    "BoundPart",
    "CalibrationRefused",
    "Choose",
    "FlangeyeError",
    "Params",
    "RecipeError",
    "RecipePath",
    "StageError",
    "__version__",
    "hookimpl",
    "part",
    "stage",
]

_MODULES = {
    **dict.fromkeys(["CalibrationRefused", "FlangeyeError", "RecipeError", "StageError"], "errors"),
    **dict.fromkeys(["BoundPart", "Choose", "Params", "part", "stage"], "plugin.stage"),
    "RecipePath": "files.paths",
    "hookimpl": "plugin.hookspecs",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("flangeye.files.paths").VERSION
    if name not in _MODULES:
        raise AttributeError(f"module 'flangeye' has no attribute '{name}'")
    return getattr(importlib.import_module(f"flangeye.{_MODULES[name]}"), name)

"""flangeye: hand-eye calibration from the robot's own flange.

The names a plugin needs are here; everything else is internal.
"""

from flangeye.errors import CalibrationRefused, FlangeyeError, RecipeError, StageError
from flangeye.hookspecs import hookimpl
from flangeye.stage import Choose, Chosen, Params, RecipePath, part, stage

__version__ = "0.1.0"
__all__ = [
    "CalibrationRefused",
    "Choose",
    "Chosen",
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

"""One number from a pose error: the paper's ``||.||_cost`` (sections 2.1.4 and 4.2), in metres."""

from typing import Literal

import numpy as np
from pydantic import Field

from flangeye import Params, part
from flangeye.types import Floats, PoseError
from flangeye.types.geometry import rotation_log
from flangeye.units import Length, param

CostPlace = Literal["work", "camera"]


class TranslationParams(Params):
    """Parameters of ``cost.translation``."""

    at: CostPlace = "work"
    """Point whose translation counts: the work, or the camera's origin as in the paper."""


class AxesParams(TranslationParams):
    """Parameters of ``cost.axes``."""

    axes: tuple[Literal["x", "y", "z"], ...] = Field(("x", "y"), min_length=1)
    """Axes of the base to use."""


class WorkRadiusParams(TranslationParams):
    """Parameters of ``cost.work_radius``."""

    radius: Length = param("300 mm", ge=0)
    """Radius of the work about the point 'at'."""


@part("cost.translation")
def cost_translation(error: PoseError, params: TranslationParams) -> float:
    """The length of the translation error; the paper's cost."""
    return float(np.linalg.norm(displacement(error, params.at)))


@part("cost.axes")
def cost_axes(error: PoseError, params: AxesParams) -> float:
    """The translation error along axes of the base: x and y for a tool that yields along z."""
    moved = error.base_R_camera @ displacement(error, params.at)
    return float(np.linalg.norm([moved["xyz".index(axis)] for axis in params.axes]))


@part("cost.work_radius")
def cost_work_radius(error: PoseError, params: WorkRadiusParams) -> float:
    """Translation together with rotation times a radius: section 4.2, for small angles."""
    lever = params.radius * rotation_log(error.motion[:3, :3])
    return float(np.linalg.norm([*displacement(error, params.at), *lever]))


def displacement(error: PoseError, place: CostPlace) -> Floats:
    """Return the (3,) translation of the error at a place, in ``camera`` [m]."""
    return error.displacement(None if place == "work" else np.zeros(3))

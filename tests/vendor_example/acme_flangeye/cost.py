"""A cost of your own: what solve.iterative minimises, as cost: acme_largest_axis."""

import numpy as np

from flangeye import part
from flangeye.types import PoseError


@part("cost.acme_largest_axis")
def cost_largest_axis(error: PoseError) -> float:
    """The largest of the error's three components at the work, in the robot's base [m]."""
    off_in_camera = error.motion[:3, :3] @ error.at + error.motion[:3, 3] - error.at
    return float(np.abs(error.base_R_camera @ off_in_camera).max())

"""``check.*``: mistakes in recordings that ``flangeye doctor`` names. Add one: a new module."""

from flangeye_plugins.check.changes import moved, tool
from flangeye_plugins.check.motion import motion
from flangeye_plugins.check.order import clock, order
from flangeye_plugins.check.outliers import flips, outlier
from flangeye_plugins.check.pose_conventions import convention, direction, exchanged, mirrored
from flangeye_plugins.check.stale import identity, repeated
from flangeye_plugins.check.units import rounding, size, units

CHECKS = (
    identity,
    repeated,
    units,
    direction,
    convention,
    exchanged,
    mirrored,
    order,
    clock,
    flips,
    outlier,
    moved,
    tool,
    size,
    motion,
    rounding,
)

"""``check.*`` parts: detection of mistakes in recordings, for ``flangeye doctor``."""

from flangeye_plugins.check.order import clock, identity, moved, order, repeated, tool
from flangeye_plugins.check.outliers import flips, motion, outlier, scatter
from flangeye_plugins.check.pose_conventions import axes, convention, direction, exchanged, mirrored
from flangeye_plugins.check.units import rounding, size, units

CHECKS = (
    identity,
    repeated,
    units,
    direction,
    convention,
    exchanged,
    axes,
    mirrored,
    order,
    clock,
    flips,
    scatter,
    outlier,
    moved,
    tool,
    size,
    motion,
    rounding,
)

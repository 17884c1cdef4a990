"""Checks: mistakes in recordings that ``flangeye doctor`` can name."""

from flangeye_plugins.doctoring.changes import moved, tool
from flangeye_plugins.doctoring.conventions import convention, direction
from flangeye_plugins.doctoring.motion import motion
from flangeye_plugins.doctoring.order import clock, order
from flangeye_plugins.doctoring.outliers import flips, outlier
from flangeye_plugins.doctoring.size import size
from flangeye_plugins.doctoring.stale import identity, repeated
from flangeye_plugins.doctoring.units import units

CHECKS = (
    identity,
    repeated,
    units,
    direction,
    convention,
    order,
    clock,
    flips,
    outlier,
    moved,
    tool,
    size,
    motion,
)

"""What a recipe may say to ``fit.rim``."""

from __future__ import annotations

from typing import ClassVar

from flangeye.units import Length, param
from flangeye_plugins.fit.uncertainty import ScannerErrorParams


class RimParams(ScannerErrorParams):
    """Parameters of ``fit.rim``."""

    inlier: Length = param(
        "0.3 mm", gt=0, description="Largest distance of a rim point from the circle."
    )
    # Smallest share of the rim's circumference, and of the bore's, to be seen
    min_coverage: ClassVar[float] = 0.3
    radius_tolerance: Length = param(
        "1.5 mm",
        gt=0,
        description="Largest difference of a fitted radius from the flange's: room for chamfers "
        "and for what the scanner wears off an edge.",
    )
    # Standard deviation of what shifts a whole edge unseen (chamfer, shadow); added to the
    # centre's covariance in the face [m]
    edge_bias: ClassVar[float] = 0.05e-3
    # Width of the band the face lies in (ISO 9409-1: 0.04 mm), which no number of points averages
    # out; added to the covariance across the face [m]
    flatness: ClassVar[float] = 0.04e-3

"""What a recipe may say to ``fit.rim``."""

from __future__ import annotations

from pydantic import Field

from flangeye import Params
from flangeye.units import Length, param


class RimParams(Params):
    """Parameters of ``fit.rim``."""

    inlier: Length = param(
        "0.3 mm", gt=0, description="Largest distance of a rim point from the circle."
    )
    min_coverage: float = Field(
        0.3,
        gt=0,
        le=1,
        description="Smallest share of the rim's circumference, and of the bore's, to be seen.",
    )
    radius_tolerance: Length = param(
        "1.5 mm",
        gt=0,
        description="Largest difference of a fitted radius from the flange's: room for chamfers "
        "and for what the scanner wears off an edge.",
    )
    scanner_error: Length = param(
        "0.06 mm",
        ge=0,
        description="Standard deviation along each axis of the scanner's own distortion, which a "
        "single scan cannot show: its calibration accuracy over root 3; added to the centre's "
        "covariance.",
    )
    edge_bias: Length = param(
        "0.05 mm",
        ge=0,
        description="Standard deviation of what shifts a whole edge unseen (chamfer, shadow); "
        "added to the centre's covariance in the face.",
    )
    flatness: Length = param(
        "0.04 mm",
        ge=0,
        description="Width of the band the face lies in (ISO 9409-1: 0.04 mm), which no number of "
        "points averages out; added to the covariance across the face.",
    )

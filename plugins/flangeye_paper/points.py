"""``acquire.points_as_in_paper``: circle centres simulated point by point, without any scan."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from flangeye import Params, stage
from flangeye.maths.geometry import rigid
from flangeye.result import sha256
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    Box,
    CircleFeature,
    Observation,
    Observations,
    Seed,
    Source,
    Transform,
    Truth,
    by_frame,
)
from flangeye.units import Length, param
from flangeye_paper.paper_cell import (
    BASE_T_CAMERA,
    CENTRE,
    POSES,
    SIZE,
    Realisation,
    realise,
)


class PointsParams(Params):
    """Parameters of ``acquire.points_as_in_paper``."""

    noise: Length = param(
        "1 mm", gt=0, description="Standard deviation of each coordinate, equation (18)."
    )
    outliers: float = Field(0.0, ge=0, lt=1, description="Share of centres 50 to 150 mm off.")
    poses: int = Field(POSES, ge=3, le=POSES, description="Number of the grid's poses to use.")


@dataclass(frozen=True, eq=False)
class PointSource(Source):
    """Where simulated points come from: enough to draw them again with other noise.

    Attributes:
        noise: Standard deviation of each coordinate [m].
        outliers: Share of gross outliers.
        poses: How many poses.
        seed: The recipe's.
    """

    noise: float = 0.0
    outliers: float = 0.0
    poses: int = POSES
    seed: int = 0

    def draw(self, index: int) -> Realisation:
        """Return one of any number of realisations; the recipe itself runs on the first, 0.

        Every noise has draws of its own; poses, outliers and solvers meet the same draws.
        """
        nanometres = round(self.noise * 1e9)
        rng = np.random.default_rng([self.seed, nanometres, index])
        return realise(rng, self.noise, self.outliers, self.poses)


@stage("acquire.points_as_in_paper")
def acquire_points(seed: Seed, params: PointsParams) -> Observations:
    """Simulate flange centres as the paper's section 3.1 does: a grid, truth (17), noise (18)."""
    drawn = params.model_dump()
    source = PointSource(
        fingerprint=sha256(f"points_as_in_paper 1 {seed} {sorted(drawn.items())}"),
        notes=("simulated point by point as in the paper's section 3.1: no scan, no circle fit",),
        workspace=Box(CENTRE, SIZE),
        truth=Truth(Transform(BASE, CAMERA, BASE_T_CAMERA)),
        simulated=True,
        **drawn,
        seed=seed,
    )
    return Observations(observations_of(source.draw(0), source), source, total=params.poses)


def observations_of(drawn: Realisation, source: PointSource) -> Iterator[Observation]:
    """Yield a realisation's poses as a solver takes them."""
    for i, (tcp, rotation, centre) in enumerate(
        zip(drawn.tcps, drawn.rotations, drawn.centres, strict=True)
    ):
        circle = CircleFeature(
            centre=centre,
            normal=None,
            radii={},
            # What a fit would state, whatever the noise is in truth
            covariance=0.1e-3**2 * np.eye(3),
            normal_covariance=None,
            arc_coverage=0.0,
        )
        yield Observation(
            f"{i:02d}", circle, by_frame(Transform(BASE, FLANGE, rigid(rotation, tcp)))
        )

"""``acquire.points_as_in_paper``: circle centres simulated point by point, without any scan.

The cell of the paper's section 3.1, point by point: truth (17), grid, noise (18). Arrays only.

The paper gives the workspace's size but not its distance. 0.7 m below the camera is the distance
at which plain least squares shows the slope of the published figure 9, 0.62 mm of x per
millimetre of noise.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from flangeye import Params, stage
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    Box,
    CircleFeature,
    Floats,
    Mask,
    Observation,
    Observations,
    Seed,
    Source,
    Transform,
    Truth,
    by_frame,
)
from flangeye.types.geometry import covariance_at, kabsch_covariance, rigid, rotation_from_rpy
from flangeye.units import Length, param
from flangeye.workflow.result import sha256

BASE_T_CAMERA = np.array(
    [[0.0, -1.0, 0.0, 0.6], [-1.0, 0.0, 0.0, -0.0125], [0.0, 0.0, -1.0, 1.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Equation (17)."""

WORKSPACE = Box(np.array([0.6, -0.0125, 0.3]), np.array([0.3, 0.3, 0.2]))
"""In ``base`` [m]."""

POOL = 75


@dataclass(frozen=True, eq=False)
class Realisation:
    """One draw of poses and noise.

    Attributes:
        tcps: (N, 3) flange centres in ``base`` [m].
        rotations: (N, 3, 3) ``base_R_flange``.
        centres: (N, 3) measured centres in ``camera`` [m].
        gross: (N,) mask of gross outliers.
    """

    tcps: Floats
    rotations: Floats
    centres: Floats
    gross: Mask


def grid() -> Floats:
    """Return the (75, 3) grid of 5 x 5 x 3 flange centres in ``base`` [m]."""
    axes = [
        np.linspace(-0.5, 0.5, n) * size for n, size in zip((5, 5, 3), WORKSPACE.size, strict=True)
    ]
    corners = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(WORKSPACE.centre + corners)


def realise(rng: np.random.Generator, noise: float, outliers: float, poses: int) -> Realisation:
    """Return the grid's poses in random order, with measured centres by equation (18).

    The whole grid is always drawn, so that fewer poses are a prefix of more.

    Args:
        rng: Random generator.
        noise: Standard deviation of each coordinate [m].
        outliers: Share of gross outliers among the poses.
        poses: Number of the 75 poses that are used.
    """
    tcps = rng.permutation(grid())
    tilt = 0.3  # largest roll, pitch and yaw of a pose [rad]
    tilts = rng.uniform(-tilt, tilt, (POOL, 3))
    # The flange looks up at the camera, its axis along the camera's -z.
    facing = BASE_T_CAMERA[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    rotations = np.array([rotation_from_rpy(*tilt) for tilt in tilts]) @ facing
    exact = (tcps - BASE_T_CAMERA[:3, 3]) @ BASE_T_CAMERA[:3, :3]
    centres = exact + noise * rng.standard_normal((POOL, 3))
    away = rng.standard_normal((POOL, 3))
    # [m]: the three false segmentations of the published UR5 recording lie 82 to 84 mm off
    away *= rng.uniform(0.05, 0.15, POOL)[:, None] / np.linalg.norm(away, axis=1, keepdims=True)
    gross = np.zeros(POOL, dtype=bool)
    gross[rng.permutation(poses)[: round(outliers * poses)]] = True
    centres[gross] += away[gross]
    return Realisation(tcps[:poses], rotations[:poses], centres[:poses], gross[:poses])


def errors_of(base_T_camera: Floats) -> Floats:
    """Return an estimate's error as defined in the paper: ``camera'_T_camera`` (4, 4).

    It maps measured to predicted points in ``camera``.
    """
    estimate = rigid(base_T_camera[:3, :3].T, -base_T_camera[:3, :3].T @ base_T_camera[:3, 3])
    return np.asarray(estimate @ BASE_T_CAMERA)


def rms_over_workspace(base_T_camera: Floats, points: Floats) -> float:
    """Return the rms error of workspace points (N, 3) mapped by an estimate [m]."""
    error = base_T_camera @ np.linalg.inv(BASE_T_CAMERA)
    moved = points @ error[:3, :3].T + error[:3, 3] - points
    return float(np.sqrt((moved**2).sum(axis=1).mean()))


def bound(tcps: Floats, noise: float, points: Floats) -> dict[str, float]:
    """Return the Cramér-Rao bound: the smallest standard deviations of an unbiased estimate.

    Args:
        tcps: (N, 3) flange centres of the poses that are not outliers [m].
        noise: Standard deviation of each coordinate [m].
        points: (M, 3) workspace points for ``workspace_rms`` [m].
    """
    covariance, about = kabsch_covariance(tcps, noise), tcps.mean(axis=0)
    rotation, origin = BASE_T_CAMERA[:3, :3], BASE_T_CAMERA[None, :3, 3]
    at_camera = rotation.T @ covariance_at(covariance, about, origin)[0] @ rotation
    turn = rotation.T @ covariance[:3, :3] @ rotation
    over = np.trace(covariance_at(covariance, about, points), axis1=1, axis2=2)
    names = ("x", "y", "z", "roll", "pitch", "yaw")
    deviations = np.sqrt([*np.diag(at_camera), *np.diag(turn)])
    return {
        **dict(zip(names, deviations.tolist(), strict=True)),
        "workspace_rms": float(np.sqrt(over.mean())),
    }


class PointsParams(Params):
    """Parameters of ``acquire.points_as_in_paper``."""

    noise: Length = param("1 mm", gt=0)
    """Standard deviation of each coordinate, equation (18)."""
    outliers: float = Field(0.0, ge=0, lt=1)
    """Share of centres 50 to 150 mm off."""
    poses: int = Field(POOL, ge=3, le=POOL)
    """Number of the grid's poses to use."""


@dataclass(frozen=True, eq=False)
class PointSource(Source):
    """Provenance of simulated points, sufficient to draw them again with other noise.

    Attributes:
        noise: Standard deviation of each coordinate [m].
        outliers: Share of gross outliers.
        poses: Number of poses.
        seed: Seed of the recipe.
    """

    noise: float = 0.0
    outliers: float = 0.0
    poses: int = POOL
    seed: int = 0

    def draw(self, index: int) -> Realisation:
        """Return one of any number of realisations; the recipe itself runs on the first, 0.

        The draws depend on the noise, but are the same for all numbers of poses, outlier shares and
        solvers.
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
        workspace=WORKSPACE,
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

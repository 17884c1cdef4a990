"""The calibration of a cell of many cameras, arms, rails and targets, all of it at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from flangeye.errors import CalibrationRefused, StageError
from flangeye.handeye.calibration import TYPICAL_ARM
from flangeye.handeye.estimates import estimate_at
from flangeye.handeye.graph import Sighting, Solved, solve_graph
from flangeye.handeye.measurements import measured
from flangeye.maths.geometry import rigid
from flangeye.models.cell import Cell
from flangeye.models.configuration import mapped_and_expected
from flangeye.types import HandEye, Observation, Pair, Transform, TransformEstimate

NOWHERE = np.zeros((6, 0))


def calibrate_cell(
    observations: Sequence[Observation], cell: Cell, limits: tuple[float, float], method: str
) -> HandEye:
    """Return every unknown of a cell with its covariance; the first camera's pose comes first.

    What moves is measured with noise; its size is found from the residuals, and sightings beyond
    that are set aside. ``limits`` are the largest standard deviations of a rotation [rad] and of a
    translation [m].

    Raises:
        StageError: No sighting, or one without the pose of something that moves.
        CalibrationRefused: The sightings leave something unknown (it says what), or fewer than half
            of them agree.
    """
    found = solve_cell(observations, cell, limits)
    _require_agreement(found, len(observations))
    transforms = {
        cell.name_of(name): Transform.named(cell.name_of(name), found.places[name])
        for name in cell.unknown_frames
    }
    camera, *others = (
        _estimate(transform, found, observations) for transform in transforms.values()
    )
    pairs = _pairs(observations, cell, transforms, found)
    return HandEye(camera, pairs, method, _notes(observations, found), others=tuple(others))


def solve_cell(
    observations: Sequence[Observation], cell: Cell, limits: tuple[float, float]
) -> Solved:
    """Return the places of a cell's unknown frames, as its graph has them.

    Raises:
        StageError: No sighting, or one without the pose of something that moves.
        CalibrationRefused: The sightings leave something unknown: it says what.
    """
    if not observations:
        raise StageError("no sighting to solve with: every capture was set aside, for its reason")
    noise = {name: TYPICAL_ARM.covariance for name in cell.movers}
    sightings = [_sighting(i, o) for i, o in enumerate(observations)]
    return solve_graph(cell.graph(observations), sightings, noise, limits)


def _sighting(i: int, observation: Observation) -> Sighting:
    rotation, covariance, projector = measured(observation, normals=True)
    pose = rigid(rotation, observation.feature.centre)
    return Sighting(i, observation.camera, observation.target, pose, covariance, projector)


def _require_agreement(found: Solved, count: int) -> None:
    agree = int(found.inliers.sum())
    if 2 * agree < count:
        raise CalibrationRefused(
            f"only {agree} of {count} sightings agree with one another: check that each belongs to "
            "the poses beside it, and that the cell stands as the recipe says"
        )


def _estimate(
    transform: Transform, found: Solved, observations: Sequence[Observation]
) -> TransformEstimate:
    """Return an estimate: a camera's about the middle of what it saw, else about its origin."""
    seen = [o.feature.centre for o in observations if o.camera == transform.child]
    about = transform.apply(np.mean(seen, axis=0)) if seen else transform.translation
    return estimate_at(transform, found.covariances[transform.child], about, NOWHERE)


def _pairs(
    observations: Sequence[Observation],
    cell: Cell,
    transforms: dict[str, Transform],
    found: Solved,
) -> tuple[Pair, ...]:
    mapped, expected = mapped_and_expected(cell.ends(transforms, observations), observations)
    pairs = []
    for i, (o, used) in enumerate(zip(observations, found.inliers, strict=True)):
        turn, shift = np.linalg.norm(found.residuals[i].reshape(2, 3), axis=1)
        sigma = np.sqrt(found.squares[i])
        far = f"residual {shift * 1e3:.1f} mm and {np.degrees(turn):.1f} deg, {sigma:.0f} sigma"
        pairs.append(Pair(o, mapped[i] - expected[i], bool(used), None if used else far))
    return tuple(pairs)


def _notes(observations: Sequence[Observation], found: Solved) -> tuple[str, ...]:
    who = Counter((o.camera, o.target) for o in observations)
    sightings = ", ".join(f"{camera} saw {target} {n} times" for (camera, target), n in who.items())
    noise = np.sqrt(found.movers)
    return (
        f"solved at once: {sightings}",
        f"noise of what moves: {noise * TYPICAL_ARM.translation * 1e3:.3f} mm and "
        f"{noise * np.degrees(TYPICAL_ARM.rotation):.3f} deg per axis, as the residuals show it",
    )

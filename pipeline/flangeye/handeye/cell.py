"""The calibration of a cell of many cameras, arms, rails and targets, all of it at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from flangeye.errors import CalibrationRefused, FlangeyeError, StageError
from flangeye.handeye.arm import MovedFlange
from flangeye.handeye.calibration import TYPICAL_ARM
from flangeye.handeye.estimates import estimate_at
from flangeye.handeye.graph import Sighting, Solved, information_of, rows_of, solve_graph
from flangeye.handeye.measurements import measured
from flangeye.maths.geometry import rigid
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import chi2_quantile
from flangeye.models.cell import Axis, Cell
from flangeye.models.configuration import mapped_and_expected
from flangeye.models.robots import RobotModel
from flangeye.types import Floats, HandEye, Observation, Pair, Transform, TransformEstimate

NOWHERE = np.zeros((6, 0))
RATIOS = np.logspace(-1, 2.5, 71)
"""Sizes of joint zeros that are compared, in units of their files' and of the noise's scale."""
CERTAIN = 0.999
"""Probability with which zeros are not taken for larger than they are."""


def calibrate_cell(
    observations: Sequence[Observation],
    cell: Cell,
    limits: tuple[float, float],
    method: str,
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
    found, zeros = _considering_zeros(found, observations, cell)
    transforms = {
        cell.name_of(name): Transform.named(cell.name_of(name), found.places[name])
        for name in cell.unknown_frames
    }
    camera, *others = (
        _estimate(transform, found, observations) for transform in transforms.values()
    )
    pairs = _pairs(observations, cell, transforms, found)
    return HandEye(camera, pairs, method, _notes(observations, found, zeros), others=tuple(others))


def solve_cell(
    observations: Sequence[Observation],
    cell: Cell,
    limits: tuple[float, float],
    start: Mapping[str, Floats] | None = None,
) -> Solved:
    """Return the places of a cell's unknown frames, as its graph has them.

    Args:
        observations: The sightings.
        cell: What stands on what.
        limits: Largest standard deviations of a rotation [rad] and of a translation [m].
        start: The places, where most of the sightings were solved already.

    Raises:
        StageError: No sighting, or one without the pose of something that moves.
        CalibrationRefused: The sightings leave something unknown: it says what.
    """
    if not observations:
        raise StageError("no sighting to solve with: every capture was set aside, for its reason")
    sightings = [sighting_of(i, o) for i, o in enumerate(observations)]
    return solve_graph(cell.graph(observations), sightings, mover_noise(cell), limits, start)


def solve_so_far(
    observations: Sequence[Observation],
    cell: Cell,
    limits: tuple[float, float],
    before: Solved | None,
) -> Solved | None:
    """Return the solution, begun at that before; None as long as something stays unknown."""
    start = None if before is None else before.places
    with suppress(FlangeyeError, np.linalg.LinAlgError):
        return solve_cell(observations, cell, limits, start)
    return None


def _considering_zeros(
    found: Solved, observations: Sequence[Observation], cell: Cell
) -> tuple[Solved, float]:
    """Return the solution with what the zeros of the arms' joints may be off by in its covariance.

    They move neighbouring poses alike, so that the answer follows them where independent noise
    would average out. ("Consider" covariance, Schmidt 1966.) With it how many times as large they
    are as the robots' files say, as the sightings show it; at least once.
    """
    sightings = [sighting_of(i, o) for i, o in enumerate(observations)]
    noise = {name: found.movers * covariance for name, covariance in mover_noise(cell).items()}
    graph = cell.graph(observations), sightings, found.places, noise
    kept = found.inliers
    moves = [
        (rows_of(*graph, moved=[name])[0] @ zeros)[kept]
        for name, mover in cell.movers.items()
        if (zeros := _zeros(mover, np.asarray(graph[0][name].place))) is not None
    ]
    if not moves:
        return found, 1.0
    rows, errors = (each[kept] for each in rows_of(*graph))
    zeros = np.concatenate(moves, axis=2)
    freedom = sum(np.trace(s.projector) for s, used in zip(sightings, kept, strict=True) if used)
    size, share = size_of_zeros(rows, zeros, errors, float(freedom))
    followed = size * found.joint @ np.einsum("nij,nik->jk", rows, zeros)
    joint = share * found.joint + followed @ followed.T
    blocks = {n: joint[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i, n in enumerate(found.places)}
    return replace(found, joint=joint, covariances=blocks), size


def size_of_zeros(
    rows: Floats, zeros: Floats, errors: Floats, freedom: float
) -> tuple[float, float]:
    """Return by what factor joint zeros are larger than was said, and what that leaves of noise.

    The restricted likelihood of all sightings (Patterson & Thompson 1971) over the factor, the
    noise's own scale taken to be the likeliest; one and one where that says no more.

    Args:
        rows: (N, 6, P) what the sightings tell of the unknowns, whitened.
        zeros: (N, 6, k) what zeros of one standard deviation do to them.
        errors: (N, 6) their residuals.
        freedom: How many numbers those are.
    """
    p, k = rows.shape[2], zeros.shape[2]
    both = np.concatenate([rows, zeros], axis=2)
    information, told = information_of(both), np.einsum("nij,ni->j", both, errors)
    total, left = float((errors**2).sum()), max(freedom - p, 1.0)

    def likelihood(ratio: float) -> tuple[float, float]:
        """Return twice the logarithm, and the noise's scale, by the zeros' size against it."""
        known = information + np.diag(np.repeat([0.0, ratio**-2], [p, k]))
        scale = max((total - told @ np.linalg.solve(known, told)) / left, 1e-12)
        return -left * np.log(scale) - np.linalg.slogdet(known)[1] - 2 * k * np.log(ratio), scale

    ratio = max(RATIOS, key=lambda ratio: likelihood(float(ratio))[0])
    gain, scale = likelihood(float(ratio))
    size = float(ratio) * np.sqrt(scale)
    if size <= 1 or gain - likelihood(1.0)[0] < chi2_quantile(CERTAIN, 1):
        return 1.0, 1.0
    return float(size), min(scale, 1.0)


def _zeros(mover: RobotModel | Axis, poses: Floats) -> Floats | None:
    """Return (N, 6, n - 1) what zeros of one deviation do to the flange; None for what has none.

    The first joint's is right by definition: it fixes the base's x axis.
    """
    if isinstance(mover, Axis):
        return None
    arm = Arm(mover)
    joints = next(MovedFlange(poses, None, False, arm).branches(starts=12), None)
    return None if joints is None else mover.joint_accuracy * arm.jacobian(joints)[:, :, 1:]


def mover_noise(cell: Cell) -> dict[str, Floats]:
    """Return the (6, 6) covariance of what moves that is believed before anything is seen."""
    return {name: TYPICAL_ARM.covariance for name in cell.movers}


def sighting_of(i: int, observation: Observation) -> Sighting:
    """Return an observation as the graph takes it, at the i-th of its times."""
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


def _notes(observations: Sequence[Observation], found: Solved, zeros: float) -> tuple[str, ...]:
    who = Counter((o.camera, o.target) for o in observations)
    sightings = ", ".join(f"{camera} saw {target} {n} times" for (camera, target), n in who.items())
    noise = np.sqrt(found.movers)
    return (
        f"solved at once: {sightings}",
        f"noise of what moves: {noise * TYPICAL_ARM.translation * 1e3:.3f} mm and "
        f"{noise * np.degrees(TYPICAL_ARM.rotation):.3f} deg per axis, as the residuals show it",
        *_note_of_zeros(zeros),
    )


def _note_of_zeros(size: float) -> tuple[str, ...]:
    if size == 1.0:
        return ()
    return (
        f"the joints' zeros are {size:.1f} times as far off as the robots' files say "
        "(joint_accuracy), as the residuals show it; that is in the covariance",
    )

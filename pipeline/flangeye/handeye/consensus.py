"""The unknowns that most measurements agree on, when any of them may be wrong. Arrays only."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flangeye.errors import CalibrationRefused, StageError
from flangeye.handeye.components import SHIFT, TURN, Noise
from flangeye.handeye.inliers import find_inliers
from flangeye.handeye.likelihood import Solution, agreeing, first_noise, gates, settle, weigh
from flangeye.handeye.loop import LoopProblem, linearise
from flangeye.handeye.measurements import Seen
from flangeye.handeye.observability import FINEST_NOISE, require_observable, spread_of
from flangeye.handeye.starts import fewest, start_of
from flangeye.handeye.unknowns import Unknowns, weights_of
from flangeye.maths.geometry import invert, kabsch, rigid, rotation_log
from flangeye.types import Floats, Mask

SUBSETS = 60
"""Small sets drawn when not all measurements agree: 40 % of them wrong, four of five in a set right
once in eight draws."""
LARGEST_NOISE = (0.02, np.radians(5.0))
"""Measurements that agree no better than this [m, rad], nor than a share of the poses' extent,
belong to other poses."""
MIRROR = 0.1
"""A mirrored fit with this share of the residual or less is the right one."""
FIRST_TILT = 2e-3
"""Guess of an arm's orientation noise [rad], before it is estimated."""
LARGEST_SHARE = 0.2
"""Of the poses' extent: scans that belong to other poses show noise as large as the extent."""
LARGEST_TILT = np.radians(10.0)
"""Normals further than this from the target's axis, at the median, belong to another frame."""
CONFIGURED = (
    "that the recipe's configuration is the cell's (place: unknown, where nobody has measured "
    "where the target is mounted)"
)
"""What to look at, where poses agree with no one answer."""


@dataclass(frozen=True, eq=False)
class Consensus:
    """What the measurements agree on.

    Attributes:
        problem: What was given, less what of it cannot be used.
        found: The fit to those that agree.
        notes: For the person.
    """

    problem: LoopProblem
    found: Solution
    notes: tuple[str, ...] = ()


def find_consensus(problem: LoopProblem, rotation_limit: float) -> Consensus:
    """Return what most measurements agree on.

    Args:
        problem: What is given.
        rotation_limit: Largest standard deviation of a rotation about any axis [rad], where the
            camera's pose is all that is to be found.

    Raises:
        StageError: The measurements are those of a mirrored camera.
        CalibrationRefused: Fewer than half agree, or none of the starts can be computed.
    """
    if problem.loop.y or problem.loop.z or problem.measurements.are_poses:
        return Consensus(problem, _of_any(problem))
    return _of_points(problem, rotation_limit)


def again(consensus: Consensus, problem: LoopProblem) -> Consensus:
    """Return what the measurements agree on in another model, begun at what is known."""
    return replace(consensus, problem=problem, found=agreeing(problem, consensus.found))


def begun_at(consensus: Consensus, at: Unknowns) -> Consensus:
    """Return what the measurements agree on near other values of the unknowns."""
    problem = consensus.problem
    return replace(consensus, found=settle(problem, at, first_noise(problem, at)))


def _of_points(problem: LoopProblem, rotation_limit: float) -> Consensus:
    """Return the camera's pose alone, of centres whose places its carrier knows."""
    s = problem.measurements
    places, axes = targets_of(problem)
    inliers, sigma = find_inliers(s.centres, places, FINEST_NOISE)
    _require_half(inliers, sigma)
    _require_agreement(places, sigma)
    problem, notes = _with_plausible_normals(problem, places, axes, inliers)
    start = _start(problem, (places, axes), inliers, sigma)
    _require_rotation(problem, start, places, axes, rotation_limit)
    problem, found, dropped = _without_bad_normals(problem, agreeing(problem, start))
    _require_half(found.inliers, sigma)
    _require_rotation(problem, found, places, axes, rotation_limit)
    if dropped:
        notes = (*notes, f"normals left out, for they disagree with the others: {dropped}")
    return Consensus(problem, found, notes)


def targets_of(problem: LoopProblem) -> tuple[Floats, Floats]:
    """Return (N, 3) centres and axes of the target where the camera's carrier has them."""
    s = problem.measurements
    poses = invert(s.a) @ s.b @ problem.loop.place
    centres = (poses[:, :3, :3] @ s.offsets[..., None])[..., 0] + poses[:, :3, 3]
    return np.asarray(centres), poses[:, :3, 2]


def _start(
    problem: LoopProblem, targets: tuple[Floats, Floats], inliers: Mask, sigma: float
) -> Solution:
    """Return the closed-form pose of the inliers, and first guesses of the noise.

    Centres and normals are vectors to one rotation: a Kabsch fit takes both, weighted.
    """
    s, (places, axes) = problem.measurements, targets
    have = inliers & s.has_normal
    mean_c, mean_b = s.centres[inliers].mean(axis=0), places[inliers].mean(axis=0)
    own = np.trace(s.covariances[have, :3, :3], axis1=1, axis2=2)
    tilt = float(np.mean(own)) / 2 + FIRST_TILT**2 if have.any() else FIRST_TILT**2
    scale = sigma, np.sqrt(tilt)
    source = np.vstack(
        [(s.centres[inliers] - mean_c) / scale[0], s.rotations[have, :, 2] / scale[1]]
    )
    target = np.vstack([(places[inliers] - mean_b) / scale[0], axes[have] / scale[1]])
    # Mirroring every vector as well makes their mean zero, which is what Kabsch takes away.
    rotation, _ = kabsch(np.vstack([source, -source]), np.vstack([target, -target]))
    x = rigid(rotation, mean_b - rotation @ mean_c)
    at = Unknowns.of_loop(x, np.eye(4), problem.loop.place)
    pose = sigma**2 if problem.pose_noise is None else problem.pose_noise
    noise = Noise(0.0, 0.0) if problem.stated else Noise(pose, tilt)
    return weigh(problem, at, noise, inliers.astype(float))


def _without_bad_normals(
    problem: LoopProblem, found: Solution
) -> tuple[LoopProblem, Solution, int]:
    """Leave out normals that disagree where their centres do not, and fit again."""
    left = problem.measurements.has_normal & ~found.inliers
    if not left.any():
        return problem, found, 0
    without = replace(problem, measurements=problem.measurements.without_normals(left))
    again = agreeing(without, found)
    return without, again, int((left & again.inliers).sum())


def _require_rotation(
    problem: LoopProblem, found: Solution, places: Floats, axes: Floats, limit: float
) -> None:
    """Refuse a camera whose rotation about some axis, its place free, stays unknown."""
    kept = found.inliers
    s = problem.measurements.where(kept)
    own = found.noise.centre_scale * s.covariances[:, 3:, 3:]
    noise = float(np.sqrt(np.mean([np.trace(c) / 3 for c in own]) + found.noise.pose))
    require_observable(places[kept], axes[kept & problem.measurements.has_normal],
                       found.information, noise, limit)  # fmt: skip


def _require_half(inliers: Mask, sigma: float) -> None:
    agreeing, given = int(inliers.sum()), len(inliers)
    if agreeing < max(3, given / 2):
        raise CalibrationRefused(
            f"only {agreeing} of {given} poses agree with one camera pose "
            f"(to {sigma * 1e3:.2f} mm per axis): check that each scan belongs to its robot pose"
        )


def _require_agreement(places: Floats, sigma: float) -> None:
    extent = float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()))
    if sigma > LARGEST_SHARE * extent:
        raise CalibrationRefused(
            f"the poses agree with one camera pose to {sigma * 1e3:.1f} mm per axis only, and lie "
            f"{extent * 1e3:.0f} mm from their middle: check that each scan belongs to its robot "
            "pose"
        )


def _with_plausible_normals(
    problem: LoopProblem, places: Floats, axes: Floats, inliers: Mask
) -> tuple[LoopProblem, tuple[str, ...]]:
    """Leave out all normals when they belong to another frame than the target's axis."""
    s = problem.measurements
    used = inliers & s.has_normal
    if not used.any() or spread_of(places[inliers]).width < 1e-3:
        return problem, ()
    rotation, _ = kabsch(s.centres[inliers], places[inliers])
    cosines = (s.rotations[used, :, 2] @ rotation.T * axes[used]).sum(axis=1)
    tilt = float(np.median(np.arccos(np.clip(cosines, -1, 1))))
    if tilt <= LARGEST_TILT:
        return problem, ()
    if tilt < np.pi - LARGEST_TILT:  # a flange whose z points inwards is no mistake of its poses
        raise CalibrationRefused(
            f"the measured normals stand {np.degrees(tilt):.0f} deg from the robot's flange axis: "
            "the orientations of the poses are wrong, or belong to another tool frame; 'flangeye "
            "doctor' tries the orders of quaternions and angles"
        )
    note = (
        f"the measured normals stand {np.degrees(tilt):.0f} deg from the robot's flange axis, so "
        "they are left out: check the orientation of the poses, and the tool frame they are in"
    )
    return replace(problem, measurements=s.without_normals(s.has_normal)), (note,)


def _of_any(problem: LoopProblem) -> Solution:
    """Return what most measurements of any loop agree on.

    All of them give the first start. Where that leaves some beyond the gate, small sets drawn at
    random give others, and the one that explains the better half of the measurements best is taken
    (least median of squares, Rousseeuw 1984).
    """
    rng = np.random.default_rng(0)
    found = _from_all(problem, rng)
    if found is None or found.inliers.mean() < 0.7 or not plausible(problem.measurements, found):
        robust = _from_subsets(problem, rng)
        found = min(filter(None, (found, robust)), key=lambda s: _cost(problem, s), default=None)
    if found is None:
        raise CalibrationRefused(
            "no closed form gives a start for these poses: spread them, and turn the arm about two "
            "axes at least"
        )
    _require_right_handed(problem, found, rng)
    _require_majority(problem, found)
    return found


def _from_all(problem: LoopProblem, rng: np.random.Generator) -> Solution | None:
    try:
        start = start_of(problem.measurements, problem.loop, rng)
    except np.linalg.LinAlgError:
        return None
    return settle(problem, start, first_noise(problem, start))


def _from_subsets(problem: LoopProblem, rng: np.random.Generator) -> Solution | None:
    n = len(problem.measurements)
    size = min(fewest(problem.measurements, problem.loop) + 1, n)
    best, least = None, np.inf
    for _ in range(SUBSETS):
        chosen = rng.choice(n, size, replace=False)
        try:
            start = start_of(problem.measurements.where(chosen), problem.loop, rng, restarts=0)
        except (np.linalg.LinAlgError, CalibrationRefused):
            continue
        median = float(np.median(_distances(problem, start)))
        if median < least:
            best, least = start, median
    return None if best is None else settle(problem, best, first_noise(problem, best))


def _distances(problem: LoopProblem, at: Unknowns) -> Floats:
    """Return (N,) squared residuals, a degree weighing like 5 mm."""
    r = linearise(problem.measurements, problem.loop, at, None).residuals
    return np.asarray((r[:, :3] ** 2).sum(axis=1) * 0.3**2 + (r[:, 3:] ** 2).sum(axis=1))


def _cost(problem: LoopProblem, found: Solution) -> float:
    """Return the truncated cost, every measurement weighed by its stated covariance alone."""
    stated = Noise(pose=1e-8, tilt=1e-8)
    weights = weights_of(problem.measurements, found.linear, stated)
    r = found.linear.residuals
    squares = np.einsum("na,nab,nb->n", r, weights, r)
    kept = np.sort(squares)[: len(squares) // 2 + 1]
    limits = gates(problem, np.inf)
    return float(kept.sum() + np.minimum(squares / limits, 1.0).sum())


def spread(found: Solution) -> tuple[float, float]:
    """Return how well the measurements agree: [m] and [rad], rms over those that do."""
    if not found.inliers.any():
        return np.inf, np.inf
    r = found.linear.residuals[found.inliers]
    turn, shift = (np.sqrt((r[:, at] ** 2).sum(axis=1).mean()) for at in (TURN, SHIFT))
    return float(shift), float(turn)


def plausible(s: Seen, found: Solution) -> bool:
    """Whether most agree, and better than scans would that belong to other poses."""
    shift, turn = spread(found)
    extent = np.sqrt(s.centres.var(axis=0).sum())
    turns = rotation_log(s.rotations @ s.rotations[0].T)
    turned = np.sqrt(turns.var(axis=0).sum())
    return bool(
        shift < max(LARGEST_NOISE[0], 2 * LARGEST_SHARE * extent)
        and turn < max(LARGEST_NOISE[1], 2 * LARGEST_SHARE * turned)
    )


def _require_right_handed(problem: LoopProblem, found: Solution, rng: np.random.Generator) -> None:
    if plausible(problem.measurements, found):
        return
    mirrored = replace(problem, measurements=problem.measurements.mirrored())
    other = _from_all(mirrored, rng)
    if other is None:
        return
    ours = np.median(_distances(problem, found.at))
    theirs = np.median(_distances(mirrored, other.at))
    if theirs < MIRROR**2 * ours:
        raise StageError(
            "what the camera saw fits the poses only when mirrored "
            f"({np.sqrt(theirs) * 1e3:.1f} mm instead of {np.sqrt(ours) * 1e3:.1f} mm): flip one "
            "axis of the scanner's or the robot's frame"
        )


def _require_majority(problem: LoopProblem, found: Solution) -> None:
    agreeing, given = int(found.inliers.sum()), len(found.inliers)
    shift, turn = spread(found)
    if agreeing < max(3, given / 2):
        raise CalibrationRefused(
            f"only {agreeing} of {given} poses agree with one answer: check that each scan belongs "
            "to its robot pose, and " + CONFIGURED
        )
    if not plausible(problem.measurements, found):
        raise CalibrationRefused(
            f"the poses agree with one answer to {shift * 1e3:.1f} mm and {np.degrees(turn):.1f} "
            "deg only: check that each scan belongs to its robot pose, and " + CONFIGURED
        )

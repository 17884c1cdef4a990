"""Choose the target's pose among several that fit a scan equally well, by the arm's motion.

Every capture satisfies ``X C = W P``: ``X`` and ``P`` are the poses of camera and target in their
carriers, ``C`` is the target's pose in the scan, and ``W`` is the pose between the carriers that
the controllers report. If ``P`` is known, each pose in a scan gives a camera pose. If not, the
target's rotation angle between two captures must be the same in the scans and by the controllers.
True poses of all captures agree in this. False poses agree only while the arm merely turns about,
and moves along, the axis by which false and true poses differ.

Of a body of revolution a scan shows a point of the axis and the axis, which may point either way.
The angle between two captures' axes, and how far one point lies along the other's axis, do not
depend on ``X`` either.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flangeye.models.cell import Cell
from flangeye.types import (
    CircleFeature,
    Floats,
    Indices,
    Observation,
    PoseFeature,
    Rejected,
    Transform,
)
from flangeye.types.geometry import hat, invert, rotation_log

PosesOfCapture = Sequence[Observation]
"""One capture, once for each pose that explains its scan."""


def disambiguated(
    cell: Cell, sure: PosesOfCapture, held: Sequence[PosesOfCapture], last: bool
) -> list[Observation | None]:
    """Return for each capture the pose that the others support; None if it stays ambiguous.

    Args:
        cell: The frames and their carriers.
        sure: Captures with one possible pose.
        held: Captures with several possible poses.
        last: Whether no capture follows. If then the target's place is unknown and no capture is
            sure, the first capture's best pose defines the target's.
    """
    told = _supported(cell, sure, held)
    if last and held and not (sure or any(told)) and cell.frames[held[0][0].target].place is None:
        return [held[0][0], *_supported(cell, held[0][:1], held[1:])]
    return told


def ambiguous(poses: PosesOfCapture) -> Rejected:
    """Return the rejection of a capture that several poses explain: how they differ, what to do."""
    why = (
        f"{len(poses)} poses of the target explain the scan, and the arm's motion does not show "
        "which is right"
    )
    if isinstance(poses[0].feature, CircleFeature):
        return Rejected(
            why,
            "its axis may point either way",
            "state where the target is (at: flange), and between captures move it by 50 mm and "
            "more along its axis; or scan the end that differs",
        )
    one, other, *_ = (feature.camera_T_target.matrix for feature in _features(poses))
    turn = rotation_log((invert(one) @ other)[:3, :3])
    angle = float(np.linalg.norm(turn))
    x, y, z = turn / max(angle, 1e-9)
    return Rejected(
        why,
        f"they are {np.degrees(angle):.0f} deg apart about ({x:.2f}, {y:.2f}, {z:.2f}) of the "
        "target",
        "between captures turn the target by 20 deg or more about other axes than this one, and "
        "move it across this axis; or scan an asymmetric part of it",
    )


def _supported(
    cell: Cell, sure: PosesOfCapture, held: Sequence[PosesOfCapture]
) -> list[Observation | None]:
    if not held:
        return []
    each = [*held, *([o] for o in sure if isinstance(o.feature, type(held[0][0].feature)))]
    every = [pose for poses in each for pose in poses]
    ends = {end for pose in every for end in (pose.camera, pose.target)}
    if len(each) < 2 or not {*cell.unknown_frames} <= ends:
        return [None] * len(held)
    starts = np.cumsum([0, *map(len, each)])[:-1]
    own = np.repeat(np.arange(len(each)), [len(poses) for poses in each])
    # (poses, captures): from each pose to that of another capture which is nearest to it
    nearest = np.fmin.reduceat(_apart(cell, every), starts, axis=1)
    nearest[np.arange(len(own)), own] = np.nan
    costs = _costs(nearest, starts)
    return [_likeliest(poses, costs[own == k]) for k, poses in enumerate(held)]


def _apart(cell: Cell, every: PosesOfCapture) -> Floats:
    """Return (M, M) squared Mahalanobis distances of poses; NaN for other cameras or targets."""
    unknown = cell.unknown_frames
    at_once = [Transform(cell.frames[n].parent, n, np.eye(4)) for n in unknown]
    ends = cell.ends(dict(zip(cell.unknowns, at_once, strict=True)), every)
    carried = invert(ends.camera) @ ends.target
    placed = not {o.target for o in every} & {*unknown}
    pairs = [(one.camera, one.target) for one in every]
    same = np.array([[one == other for other in pairs] for one in pairs])
    if features := _features(every):
        seen = np.array([one.camera_T_target.matrix for one in features])
        spread = np.array([one.covariance for one in features])
        measure = _off_place if placed else _off_angle
        out = [measure(k, carried, seen, spread) for k in range(len(every))]
    else:
        circles = [one.circle for one in every]
        out = [_off_axis(k, carried, circles) for k in range(len(every))]
        same &= placed
    return np.where(same, out, np.nan)


def _features(poses: PosesOfCapture) -> list[PoseFeature]:
    return [pose.feature for pose in poses if isinstance(pose.feature, PoseFeature)]


def _off_place(k: int, carried: Floats, seen: Floats, spread: Floats) -> Floats:
    """Return (M,) distances of a target from where the other captures' cameras predict it."""
    there = seen @ invert(carried) @ carried[k]
    turn = rotation_log(there[:, :3, :3] @ seen[k, :3, :3].T)
    off = np.concatenate([turn, there[:, :3, 3] - seen[k, :3, 3]], axis=1)
    # An error phi of the other sighting's rotation moves the target here by phi x (here - there)
    moved = np.tile(np.eye(6), (len(seen), 1, 1))
    moved[:, 3:, :3] = hat(seen[:, :3, 3] - seen[k, :3, 3])
    spread = spread[k] + moved @ spread @ moved.transpose(0, 2, 1)
    return np.asarray(np.einsum("mi,mi->m", off, np.linalg.solve(spread, off[..., None])[..., 0]))


def _off_angle(k: int, carried: Floats, seen: Floats, spread: Floats) -> Floats:
    """Return (M,) differences of the target's rotation angle, scans against controllers."""
    # X C = W P: a turn of C and that of W between two captures are the same but for their frames,
    # so their angles agree whatever the unknown X and P are
    told, found = (
        np.linalg.norm(rotation_log((invert(all_[k]) @ all_)[:, :3, :3]), axis=1)
        for all_ in (carried, seen)
    )
    turns = np.trace(spread[:, :3, :3], axis1=1, axis2=2) / 3
    return np.asarray((told - found) ** 2 / (turns[k] + turns))


def _off_axis(k: int, carried: Floats, circles: Sequence[CircleFeature]) -> Floats:
    """Return (M,) differences of axes: their angles, and places along one, scans against arms."""
    centres, normals = (np.array([getattr(c, n) for c in circles]) for n in ("centre", "normal"))
    told_at = np.array([
        where[:3, :3] @ c.centre_in_flange + where[:3, 3]
        for where, c in zip(carried, circles, strict=True)
    ])  # fmt: skip
    axes, arms = carried[:, :3, 2], told_at - told_at[k]
    told, found = (np.arccos(np.clip(each @ each[k], -1.0, 1.0)) for each in (axes, normals))
    turns = np.array([np.trace(np.asarray(c.normal_covariance)) / 2 for c in circles])
    along = arms @ axes[k] - (centres - centres[k]) @ normals[k]
    spread = np.array([c.covariance for c in circles])
    shifts = np.einsum("i,mij,j->m", normals[k], spread + spread[k], normals[k])
    shifts += turns[k] * np.einsum("mi,mi->m", arms, arms)
    return np.asarray((told - found) ** 2 / (turns + turns[k]) + along**2 / shifts)


def _costs(nearest: Floats, starts: Indices) -> Floats:
    """Return (M,) negative log-likelihoods of poses, by their distances (M, N) to N captures.

    Distances have long tails, since any of the arm's poses may be wrong. Their scale is the
    session's, since arms err by more than scans.
    """
    known = np.isfinite(nearest).any(axis=1)
    typical = np.full(len(nearest), np.inf)
    typical[known] = np.nanmedian(nearest[known], axis=1)
    scale = max(1.0, float(np.median(np.minimum.reduceat(typical, starts))))
    # Cauchy's likelihood: a wrong pose of the arm adds a logarithm, not a square
    return np.asarray(np.nansum(np.log1p(nearest / scale), axis=1))


def _likeliest(poses: PosesOfCapture, costs: Floats) -> Observation | None:
    first, second = np.argsort(costs, kind="stable")[:2]
    # Times by which a pose must be likelier than any other
    odds = 1000.0
    return poses[first] if costs[second] - costs[first] > np.log(odds) else None

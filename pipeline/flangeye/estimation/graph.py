r"""A cell as a graph of frames, with the sightings its cameras should have. Arrays only.

Every frame stands on another, down to one root. A frame's place on its parent is known, unknown, or
reported by a controller at each time (a *carrier*: an arm's flange or link, a rail's carriage). A
sighting of a target by a camera closes a loop:

.. math:: {}^{root}T_{camera}(t)^{-1} \; {}^{root}T_{target}(t) = {}^{camera}T_{target}

One camera and one arm are such a graph as well: there is no other model of a cell. A frame moves by
(rotation, translation): R' = Exp(phi) R about its own origin in its parent's axes, t' = t + tau. A
residual is the (rotation, translation) from the predicted target in the camera to the measured one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.kinematics import Arm
from flangeye.models.cell import Frame, chain, composed
from flangeye.types import Floats, Indices, Mask
from flangeye.types.geometry import (
    each_applied,
    hat,
    invert,
    rotation_between,
    rotation_exp,
    rotation_log,
)

Places = Mapping[str, Floats]
"""(4, 4) parent_T_frame of each unknown frame."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """N measurements of targets by cameras: poses, with the directions that were measured.

    Attributes:
        times: (N,) index of the reported poses.
        pairs: (N,) which camera saw which target, an index of ``Problem.ends``.
        rotations: (N, 3, 3) camera_R_target; the turn of a circle about z, and all rotation of a
            centre, has no meaning.
        centres: (N, 3) measured centres in ``camera`` [m].
        covariances: (N, 6, 6) noise of the features, order (rotation, translation), in ``camera``.
        projectors: (N, 6, 6) onto the measured directions: rank 6 for a pose, 5 with a normal, 3
            for a centre.
        offsets: (N, 3) seen point, in the target's frame [m].
        by_depth: (N,) whether a scanner measured the feature by depth, not a camera in an image.
        shared: (N, 6, k) shift of the feature by one standard deviation of each error that all
            features of a camera share, such as its intrinsics.
    """

    times: Indices
    pairs: Indices
    rotations: Floats
    centres: Floats
    covariances: Floats
    projectors: Floats
    offsets: Floats
    by_depth: Mask
    shared: Floats

    def __len__(self) -> int:
        return len(self.centres)

    @property
    def ranks(self) -> Indices:
        """Rank (N,) of each measurement: 6 for a pose, 5 with a normal, 3 for a centre."""
        traces = np.trace(self.projectors, axis1=1, axis2=2)
        return np.asarray(traces.round(), dtype=np.intp)

    @property
    def poses(self) -> Floats:
        """Measured poses (N, 4, 4) ``camera_T_target``."""
        out = np.zeros((len(self), 4, 4))
        out[:, :3, :3], out[:, :3, 3], out[:, 3, 3] = self.rotations, self.centres, 1.0
        return out

    def where(self, chosen: Mask | NDArray[np.intp]) -> Sightings:
        """Return a subset of the sightings."""
        return Sightings(**{each.name: getattr(self, each.name)[chosen] for each in fields(self)})


@dataclass(frozen=True, eq=False)
class Carrier:
    """A frame that a controller moves: a flange or link of an arm, or a rail or positioner.

    Attributes:
        frame: Name of the moved frame.
        arm: Arm that moves it; carriers of one arm share its errors.
        kinematics: The arm's kinematics; None if unknown, or for a rail.
        joints: (T, n) joint angles at each time [rad]; None if unknown.
        accuracy: Median deviation of a joint's zero, from the robot's file [rad].
        link: Name of the link; None for the flange.
        rates: (T, 6) twist rate at each time [rad/s, m/s], in the base, about the frame's origin;
            None if its motion was not recorded.
        axis: Whether the carrier is a rail or a positioner.
    """

    frame: str
    arm: str
    kinematics: Arm | None = None
    joints: Floats | None = None
    accuracy: float = 0.0
    link: int | None = None
    rates: Floats | None = None
    axis: bool = False


@dataclass(frozen=True, eq=False)
class Problem:
    """The estimation problem: the frame graph, its carriers, and the sightings.

    Attributes:
        frames: Frames by name, without the root frame.
        ends: Frame names (camera, target); the sightings' ``pairs`` are indices into this.
        seen: N sightings.
        carriers: Frames that a controller moves.
        walk: Shares of a sighting's turn and shift that stay in the next ones; above 0 if what the
            camera reports drifts like a random walk, as visual odometry does.
    """

    frames: Mapping[str, Frame]
    ends: Sequence[tuple[str, str]]
    seen: Sightings
    carriers: Sequence[Carrier] = ()
    walk: Sequence[float] = (0.0, 0.0)

    @property
    def unknown(self) -> list[str]:
        """Names of frames whose places are to be estimated."""
        return [name for name, frame in self.frames.items() if frame.place is None]

    @property
    def moving(self) -> list[str]:
        """Names of frames whose places were reported at each time."""
        return [n for n, f in self.frames.items() if f.place is not None and f.place.ndim == 3]

    def where(self, chosen: Mask | NDArray[np.intp]) -> Problem:
        """Return the problem with a subset of the sightings."""
        return replace(self, seen=self.seen.where(chosen))

    def at(self, times: Indices) -> Problem:
        """Return the problem restricted to some times, in order, with their sightings."""
        seen = self.seen.where(np.isin(self.seen.times, times))
        frames = {n: f.at(times) for n, f in self.frames.items()}
        carriers = [
            replace(
                c,
                joints=None if c.joints is None else c.joints[times],
                rates=None if c.rates is None else c.rates[times],
            )
            for c in self.carriers
        ]
        # Times are indices of poses, which are now counted anew
        seen = replace(seen, times=np.searchsorted(times, seen.times))
        return replace(self, frames=frames, carriers=carriers, seen=seen)

    def without_normals(self, which: Mask) -> Problem:
        """Return the problem with some circles reduced to their centres."""
        projectors = self.seen.projectors.copy()
        # The rank of each sighting is read from its projector's trace
        projectors[which, :3, :3] = 0.0
        return replace(self, seen=replace(self.seen, projectors=projectors))

    def with_joints(self, arm: str, joints: Floats | None) -> Problem:
        """Return the problem with an arm's joint angles (T, n) [rad]."""
        carriers = [replace(c, joints=joints) if c.arm == arm else c for c in self.carriers]
        return replace(self, carriers=carriers)

    def placed(self, places: Places) -> Problem:
        """Return the problem with some unknown places fixed at given values."""
        frames = {n: replace(f, place=places.get(n, f.place)) for n, f in self.frames.items()}
        return replace(self, frames=frames)

    def predicted(self, places: Places) -> Floats:
        """Return the predicted poses (N, 4, 4) ``camera_T_target``."""
        out = np.zeros((len(self.seen), 4, 4))
        for k, (camera, target) in enumerate(self.ends):
            rows = self.seen.pairs == k
            frames = self.frames_at(places, self.seen.times[rows])
            out[rows] = invert(composed(frames, camera)) @ composed(frames, target)
        return out

    def residuals(self, places: Places) -> Floats:
        """Return (N, 6) measured minus predicted, zero in unmeasured directions [rad, m]."""
        left = _residuals(self.predicted(places), self.seen)
        return np.asarray((self.seen.projectors @ left[..., None])[..., 0])

    def moved(self, places: Places, step: Floats) -> Places:
        """Return the places moved by (6 K,), in the order of ``unknown``."""
        out = {}
        for name, (turn, shift) in zip(self.unknown, step.reshape(-1, 2, 3), strict=True):
            place = np.array(places[name])
            # On the left: the move is in the parent's axes, about the frame's own origin
            place[:3, :3] = rotation_exp(turn) @ place[:3, :3]
            place[:3, 3] += shift
            out[name] = place
        return out

    def moves(self, places: Places, there: Places) -> Floats:
        """Return the (6 K,) that move places to others: the inverse of :meth:`moved`."""
        each = []
        for name in self.unknown:
            before, after = np.asarray(places[name]), np.asarray(there[name])
            turn = rotation_log(after[:3, :3] @ before[:3, :3].T)
            each += [turn, after[:3, 3] - before[:3, 3]]
        return np.concatenate([np.zeros(0), *each])

    def linearised(self, places: Places) -> Linear:
        """Return the sightings predicted at some places, with their derivatives by each frame."""
        s, moved = self.seen, [*self.unknown, *self.moving]
        predicted = self.predicted(places)
        blocks = {name: np.zeros((len(s), 6, 6)) for name in moved}
        for k, ends in enumerate(self.ends):
            rows = s.pairs == k
            if rows.any():
                frames = self.frames_at(places, s.times[rows])
                for name, block in _blocks(frames, ends, s.offsets[rows], moved).items():
                    blocks[name][rows] = block
        return Linear(_residuals(predicted, s), predicted[:, :3, :3], blocks)

    def following(self, carrier: Carrier) -> Linear:
        """Return the linearisation by the twists (N, 6) of one carrier's frame, all else fixed."""
        eye = np.tile(np.eye(6), (len(self.seen), 1, 1))
        blocks = {c.frame: eye * (c is carrier) for c in self.carriers}
        return Linear(np.zeros(0), np.zeros(0), blocks)

    def frames_at(self, places: Places, times: Indices | int) -> dict[str, Frame]:
        """Return the frames at some times or at one, all places known."""
        out = {}
        for name, frame in self.frames.items():
            place = np.asarray(places[name] if frame.place is None else frame.place)
            out[name] = replace(frame, place=place if place.ndim == 2 else place[times])
        return out


@dataclass(frozen=True, eq=False)
class Linear:
    """Predicted sightings at given places, and their derivatives.

    Attributes:
        residuals: (N, 6) measured minus predicted, in ``camera`` [rad, m].
        turns: (N, 3, 3) camera_R_target, predicted.
        blocks: (N, 6, 6) how each unknown or reported frame moves the prediction.
    """

    residuals: Floats
    turns: Floats
    blocks: Mapping[str, Floats] = field(default_factory=dict)


def _residuals(predicted: Floats, s: Sightings) -> Floats:
    rotations = predicted[:, :3, :3]
    centres = each_applied(predicted, s.offsets)
    # A circle's rotation about its axis was not measured: the shortest turn between the axes
    turns = rotation_between(rotations[:, :, 2], s.rotations[:, :, 2])
    whole = s.ranks == 6
    turns[whole] = rotation_log(s.rotations[whole] @ np.swapaxes(rotations[whole], 1, 2))
    return np.concatenate([turns, s.centres - centres], axis=1)


def _blocks(
    frames: Mapping[str, Frame], ends: tuple[str, str], offsets: Floats, moved: Sequence[str]
) -> dict[str, Floats]:
    """Return (N, 6, 6) derivatives of the prediction by each frame between camera and target."""
    camera, target = (composed(frames, end) for end in ends)
    back = np.swapaxes(camera[..., :3, :3], -1, -2)
    tip = (target[..., :3, :3] @ offsets[..., None])[..., 0] + target[..., :3, 3]
    blocks: dict[str, Floats] = {}
    # What moves the camera moves what it sees the other way
    for end, sign in zip(ends, (-1.0, 1.0), strict=True):
        before = np.eye(4)
        for name in chain(frames, end):
            after = before @ np.asarray(frames[name].place)
            if name in moved:
                # A turn about the frame's own origin, in its parent's axes, and a shift of it.
                turns = np.broadcast_to(sign * back @ before[..., :3, :3], (len(offsets), 3, 3))
                lever = (back @ (tip - after[..., :3, 3])[..., None])[..., 0]
                block = np.zeros((len(offsets), 6, 6))
                block[:, :3, :3] = block[:, 3:, 3:] = turns
                block[:, 3:, :3] = -hat(lever) @ turns
                blocks[name] = blocks.get(name, 0.0) + block
            before = after
    return blocks

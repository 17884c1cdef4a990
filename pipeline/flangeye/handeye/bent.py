"""An arm that is not quite as its controller has it: what each kind of error does to its poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flangeye.maths.geometry import rotation_log
from flangeye.maths.kinematics import Arm
from flangeye.maths.smooth_field import effects, field_over
from flangeye.types import Floats

LENGTH, TWIST, WAVE, SAG = 0.2, 0.2, 0.4, 2.0
"""Of an arm whose zeros are off by 1 rad: how far its lengths [m], twists [rad] and encoders once a
turn [rad], are, and by what a joint gives way for a metre of lever [rad]. Zeros and twists are as
``refine.arm`` expects them of each other, lengths twice that, for most of them are taken up by
places and stay unseen; each kind may be larger or smaller beside them."""
FIELD = 0.1
"""Likewise what none of these explains, smooth over the workspace [m]."""
KINDS = "encoders", "sag", "lengths", "twists", "what is smooth over the workspace"
"""Errors beside those of the zeros; each has a size of its own."""
UP = np.array([0.0, 0.0, 1.0])
"""Of an arm's base that is level."""
DELTA = 1e-6
"""For differences of the flange's pose by a length [m] or a twist [rad]."""


@dataclass(frozen=True, eq=False)
class Bent:
    """An arm whose joints are not quite where its controller says.

    Attributes:
        name: Frame that it moves.
        kinematics: As its controller believes.
        joints: (N, n) by which it is where the controller has it [rad].
        deviation: Standard deviation of a zero, by the robot's file [rad].
        offsets: (n,) to add to the joints [rad].
        link: Which of its links what is moved is fixed to; None for the flange.
    """

    name: str
    kinematics: Arm
    joints: Floats
    deviation: float
    offsets: Floats
    link: int | None = None

    @property
    def poses(self) -> Floats:
        """(N, 4, 4) of the flange, or the link, in the arm's base, with the offsets."""
        return self.kinematics.pose(self.joints + self.offsets, self.link)

    @property
    def twists(self) -> Floats:
        """(N, 6, n - 1) what zeros of one deviation do to it, in its base.

        The first joint's is right by definition: it fixes the base's x axis.
        """
        return self.deviation * self._columns[:, :, 1:]

    @property
    def others(self) -> tuple[Floats, ...]:
        """(N, 6, m) what each of :data:`KINDS` does to it where zeros are off by one deviation."""
        joints, n = self.joints + self.offsets, self.kinematics.n
        columns = self._columns[:, :, None, :]
        waves = WAVE * np.stack([np.sin(joints), np.cos(joints)], axis=1)
        sag = columns[:, :, 0] * (SAG * _levers(self.kinematics, joints))[:, None]
        kinds = (
            (columns * waves[:, None]).reshape(len(joints), 6, -1),
            # Weight pulls all joints the same way: most of what they give way they do together.
            np.concatenate([sag, sag.sum(axis=2, keepdims=True)], axis=2),
            self._by_links(LENGTH, [3 * i + k for i in range(n) for k in (0, 1)]),
            self._by_links(TWIST, [3 * i + 2 for i in range(n)]),
            self._by_place,
        )
        return tuple(self.deviation * kind for kind in kinds)

    @property
    def _columns(self) -> Floats:
        """(N, 6, n) what a turn of each joint does to it."""
        return self.kinematics.jacobian(self.joints + self.offsets, self.link)

    @property
    def _by_place(self) -> Floats:
        """(N, 6, m) an error that is smooth over the workspace, less what moves the base."""
        places = self.poses[:, :3, 3]
        moves = FIELD * effects(field_over(places), places)
        return np.concatenate([np.zeros_like(moves), moves], axis=1)

    def _by_links(self, size: float, which: list[int]) -> Floats:
        """Return (N, 6, m) what some of the links' (3 n) lengths and twists do."""
        steps = size * np.eye(3 * self.kinematics.n)[which].reshape(len(which), -1, 3)
        return np.stack([self._by_lengths(step) for step in steps], axis=2)

    def _by_lengths(self, step: Floats) -> Floats:
        """Return (N, 6) how a change (n, 3) of lengths and twists moves it, by its size."""
        arm, joints = self.kinematics, self.joints + self.offsets
        before, after = (x.pose(joints, self.link) for x in (arm, arm.altered(DELTA * step)))
        turned = rotation_log(after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], 1, 2))
        moved = after[:, :3, 3] - before[:, :3, 3]
        return np.concatenate([turned, moved], axis=1) / DELTA

    def moved(self, deviations: Floats) -> Bent:
        """Return the arm with (n - 1,) more added to its offsets, in units of the deviation."""
        return replace(self, offsets=self.offsets + self.deviation * np.pad(deviations, (1, 0)))


@dataclass(frozen=True, eq=False)
class BentArm:
    """All that an arm moves, its flange and links that carry something: its errors move all of it.

    Attributes:
        parts: F of them, the flange first.
    """

    parts: Sequence[Bent]

    @property
    def name(self) -> str:
        """Frame of the flange."""
        return self.parts[0].name

    @property
    def deviation(self) -> float:
        """Standard deviation of a zero, by the robot's file [rad]."""
        return self.parts[0].deviation

    @property
    def joints(self) -> Floats:
        """(N, n) by which it is where the controller has it [rad]."""
        return self.parts[0].joints

    @property
    def offsets(self) -> Floats:
        """(n,) to add to the joints [rad]."""
        return self.parts[0].offsets

    @property
    def poses(self) -> dict[str, Floats]:
        """(N, 4, 4) of each frame in the arm's base, with the offsets."""
        return {part.name: part.poses for part in self.parts}

    @property
    def twists(self) -> Floats:
        """(N, 6 F, n - 1) what zeros of one deviation do to the frames."""
        return np.concatenate([part.twists for part in self.parts], axis=1)

    @property
    def others(self) -> list[Floats]:
        """(N, 6 F, m) what each of :data:`KINDS` does; what is smooth, to each frame by itself."""
        *kinds, smooth = zip(*(part.others for part in self.parts), strict=True)
        nothing = [0 * each for each in smooth]
        each_alone = [
            np.concatenate([*nothing[:i], each, *nothing[i + 1 :]], axis=1)
            for i, each in enumerate(smooth)
        ]
        common = [np.concatenate(kind, axis=1) for kind in kinds]
        return [*common, np.concatenate(each_alone, axis=2)]

    def moved(self, deviations: Floats) -> BentArm:
        """Return the arm with (n - 1,) more added to its offsets, in units of the deviation."""
        return BentArm([part.moved(deviations) for part in self.parts])


def _levers(arm: Arm, joints: Floats) -> Floats:
    """Return (N, n) the horizontal lever about each joint of what hangs on it [m].

    Its weight is taken to be spread evenly over the links' origins beyond the joint.
    """
    origins, (axes, places) = arm.frames(joints)[..., :3, 3], arm.axes(joints)
    beyond = [origins[:, i + 1 :].mean(axis=1) - places[:, i] for i in range(arm.n)]
    return np.asarray(np.cross(axes, np.stack(beyond, axis=1)) @ UP)

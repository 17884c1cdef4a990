"""A cell: any number of arms, rails, positioners, cameras and targets, and what stands on what.

What moves has two frames: ``NAME_base``, which stands somewhere, and ``NAME``, which its controller
places in that base: an arm's flange, a rail's carriage, a positioner's plate. Cameras and targets
stand on these, or on the root of the cell, ``base``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from flangeye.errors import StageError
from flangeye.maths.frame_graph import Frame, chain, composed
from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.models.configuration import Ends
from flangeye.models.robots import RobotModel
from flangeye.types import Array, Floats, HandEye, Motion, Observation, Transform

if TYPE_CHECKING:
    from flangeye.maths.kinematics import Arm


@dataclass(frozen=True, eq=False)
class Axis:
    """A rail or a positioner: one axis.

    Attributes:
        direction: (3,) unit vector in its base.
        turns: Whether the plate turns about it; else the carriage slides along it.
        travel: Lowest and highest value [rad or m].
    """

    direction: Array
    turns: bool
    travel: tuple[float, float]

    @property
    def freedoms(self) -> Floats:
        """(6, 1) the unit twist of its motion, rotation before translation."""
        along, still = np.asarray(self.direction), np.zeros(3)
        return np.concatenate([along, still] if self.turns else [still, along])[:, None]

    def place(self, value: float) -> Floats:
        """Return (4, 4) of carriage or plate in its base, at a value [rad or m]."""
        moved = value * np.asarray(self.direction)
        if self.turns:
            return rigid(rotation_exp(moved), np.zeros(3))
        return rigid(np.eye(3), moved)


@dataclass(frozen=True, eq=False)
class Cell:
    """What stands on what.

    Attributes:
        frames: By name. The place of what moves is None here: observations have it.
        movers: What moves which frame.
        cameras: Frames of cameras, in the recipe's order.
        targets: Frames of targets.
    """

    frames: Mapping[str, Frame]
    movers: Mapping[str, RobotModel | Axis]
    cameras: tuple[str, ...]
    targets: tuple[str, ...]

    is_default = False

    @property
    def unknown_frames(self) -> tuple[str, ...]:
        """Frames whose place is to be found, the cameras' first."""
        unknown = [n for n, f in self.frames.items() if f.place is None and n not in self.movers]
        return tuple(sorted(unknown, key=lambda name: name not in self.cameras))

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Names of the transforms to find, the cameras' first."""
        return tuple(map(self.name_of, self.unknown_frames))

    @property
    def freedoms(self) -> dict[str, Floats]:
        """(6, k) unit twists that each thing can be moved by, in its base; see ``solve_graph``."""
        return {
            name: mover.freedoms if isinstance(mover, Axis) else _freedoms_of(mover)
            for name, mover in self.movers.items()
        }

    def passing(self, motion: Motion) -> Motion:
        """Return how everything passed: rails and positioners where their recorded values say."""
        axes = {n: mover for n, mover in self.movers.items() if isinstance(mover, Axis)}
        placed = {
            name: np.array([axes[name].place(float(value)) for value in values[:, 0]])
            for name, values in motion.joints.items()
            if name in axes
        }
        return replace(motion, others={**motion.others, **placed})

    def name_of(self, frame: str) -> str:
        """Return ``parent_T_frame``."""
        return f"{self.frames[frame].parent}_T_{frame}"

    def describe(self) -> str:
        """Return one line: where each camera and target stands, and what is unknown."""
        ends = (*self.cameras, *self.targets)
        chains = (" - ".join(("base", *chain(self.frames, end))) for end in ends)
        return f"cell: {'; '.join(chains)}; to be found: {', '.join(self.unknowns)}"

    def graph(
        self,
        observations: Sequence[Observation],
        transforms: Mapping[str, Transform] | None = None,
    ) -> dict[str, Frame]:
        """Return the frames with the places that N observations have of them.

        Args:
            observations: Their controllers' poses.
            transforms: The unknowns by name, where they were found.

        Raises:
            StageError: An observation lacks the pose of something that moves.
        """
        found = {x.child: x.matrix for x in (transforms or {}).values()}
        measured = {name: _measured(name, observations) for name in self.movers}
        places = found | measured
        return {
            name: replace(frame, place=places.get(name, frame.place))
            for name, frame in self.frames.items()
        }

    def corrected(
        self, observations: Sequence[Observation], calibration: HandEye, arm: Arm | None = None
    ) -> list[Observation]:
        """Return observations with the flanges where corrected arms have them; see ``Layout``."""
        from flangeye.maths.arm_correction import corrected_observation
        from flangeye.maths.kinematics import Arm

        moved = list(observations)
        for name, correction in calibration.arms.items():
            mover = self.movers[name]
            model = None if isinstance(mover, Axis) else Arm(mover)
            moved = [corrected_observation(o, correction, model, name) for o in moved]
        return moved

    def ends(
        self,
        transforms: Mapping[str, Transform],
        observations: Sequence[Observation],
        arm: Arm | None = None,
    ) -> Ends:
        """Return where camera and target of each observation are; see ``Layout``."""
        frames = self.graph(observations, transforms)
        return Ends(
            _of_each(frames, [o.camera for o in observations]),
            _of_each(frames, [o.target for o in observations]),
        )


def _freedoms_of(robot: RobotModel) -> Floats:
    """Return (6, k) unit twists: those axes of ``base`` that it can turn about, and all shifts.

    An arm of four joints turns about one.
    """
    from flangeye.maths.kinematics import Arm

    arm = Arm(robot)
    bent = np.linspace(0.3, 0.7, arm.n)
    axes = arm.axes(bent)[0][~arm.slides]
    reached = np.linalg.lstsq(axes.T, np.eye(3), rcond=1e-9)[0]
    able = np.linalg.norm(axes.T @ reached - np.eye(3), axis=0) < 1e-6
    return np.eye(6)[:, [*able, True, True, True]]


def _measured(name: str, observations: Sequence[Observation]) -> Floats:
    for observation in observations:
        if name not in observation.poses:
            raise StageError(
                f"observation {observation.id} has no pose of '{name}', which moves in this cell; "
                f"it has {', '.join(observation.poses) or 'none'}"
            )
    return np.array([o.poses[name].matrix for o in observations]).reshape(-1, 4, 4)


def _of_each(frames: Mapping[str, Frame], names: Sequence[str]) -> Floats:
    """Return (N, 4, 4): of each observation the frame that it names."""
    count = len(names)
    poses = {n: np.broadcast_to(composed(frames, n), (count, 4, 4)) for n in set(names)}
    return np.array([poses[name][i] for i, name in enumerate(names)]).reshape(-1, 4, 4)

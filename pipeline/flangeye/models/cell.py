"""A cell as a tree of frames: arms, rails, positioners, cameras and targets.

A moving device has two frames: a fixed ``NAME_base``, and ``NAME``, whose pose in that base its
controller reports: an arm's flange, a rail's carriage, a positioner's plate. Cameras and targets
stand on these, on a link of an arm (``NAME_link3``), whose place in the arm's base follows from its
joints, or on the root of the cell, ``base``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from flangeye.errors import StageError
from flangeye.models.configuration import DEFAULT, LINK, Configuration, Ends
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.types import (
    BASE,
    BASE2,
    CAMERA,
    FLANGE,
    FLANGE2,
    TARGET,
    Array,
    Floats,
    HandEye,
    Indices,
    Mask,
    Motion,
    Observation,
    Poses,
    Transform,
)
from flangeye.types.geometry import rigid, rotation_exp


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of the graph: its parent and its place there.

    Attributes:
        parent: Name of the parent frame.
        place: parent_T_frame: (4, 4) if fixed and known; (M, 4, 4) if measured at M times; None if
            fixed and unknown.
    """

    parent: str
    place: Floats | None = None

    def at(self, times: Indices | int) -> Frame:
        """Return the frame at some of the times only, or at one."""
        if self.place is None or self.place.ndim == 2:
            return self
        return replace(self, place=self.place[times])


def chain(frames: Mapping[str, Frame], name: str) -> list[str]:
    """Return the frames from the root to one, without the root.

    Raises:
        StageError: A frame is its own parent.
    """
    path: list[str] = []
    while name in frames:
        if name in path:
            raise StageError(f"frame '{name}' is its own parent; every frame leads to one root")
        # A recipe from another hand may let frames stand on each other: without this check the walk
        # to the root would never end.
        path.insert(0, name)
        name = frames[name].parent
    return path


def composed(frames: Mapping[str, Frame], name: str) -> Floats:
    """Return root_T_frame, (4, 4) or (M, 4, 4), if every place on the path is known.

    The root itself is the identity.
    """
    pose = np.eye(4)
    for each in chain(frames, name):
        pose = pose @ np.asarray(frames[each].place)
    return pose


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
        """Unit twist (6, 1) of the axis's motion, rotation before translation."""
        along, still = np.asarray(self.direction), np.zeros(3)
        return np.concatenate([along, still] if self.turns else [still, along])[:, None]

    def place(self, value: float) -> Floats:
        """Return the pose (4, 4) of carriage or plate in its base, at a value [rad or m]."""
        moved = value * np.asarray(self.direction)
        if self.turns:
            return rigid(rotation_exp(moved), np.zeros(3))
        return rigid(np.eye(3), moved)


@dataclass(frozen=True)
class Link:
    """A link of an arm that carries a camera or a target.

    Attributes:
        arm: The arm's frame.
        number: Which of its links, from 1; its frame is that of Denavit and Hartenberg.
    """

    arm: str
    number: int

    @property
    def frame(self) -> str:
        """Name of the link's frame."""
        return f"{self.arm}_link{self.number}"


@dataclass(frozen=True, eq=False)
class Cell:
    """The frames of a cell, its carriers, cameras and targets.

    Attributes:
        frames: Frames by name. A moving frame's place is None here; observations have it.
        movers: The arm or axis that moves a frame; None for an arm without a model.
        cameras: Frames of cameras, in the recipe's order.
        targets: Frames of targets.
        links: By frame, the links that carry something. Their places are None, too: they follow
            from the joints.
    """

    frames: Mapping[str, Frame]
    movers: Mapping[str, RobotModel | Axis | None]
    cameras: tuple[str, ...]
    targets: tuple[str, ...]
    links: Mapping[str, Link] = field(default_factory=dict)

    @property
    def measured(self) -> tuple[str, ...]:
        """Frames whose poses controllers report: of carriers and of links."""
        return (*self.movers, *self.links)

    @property
    def unknown_frames(self) -> tuple[str, ...]:
        """Frames whose places are to be estimated, cameras first."""
        unknown = [n for n, f in self.frames.items() if f.place is None and n not in self.measured]
        return tuple(sorted(unknown, key=lambda name: name not in self.cameras))

    @property
    def unknowns(self) -> tuple[str, ...]:
        """Names of the transforms to find, the cameras' first."""
        return tuple(map(self.name_of, self.unknown_frames))

    @property
    def freedoms(self) -> dict[str, Floats]:
        """Unit twists (6, k) in which each carrier can move, in its base; see ``solve_graph``."""
        # An arm without a model may move in any way, so it is missing here and no motion is ruled
        # out.
        able = {
            name: mover.freedoms if isinstance(mover, Axis) else _freedoms_of(mover)
            for name, mover in self.movers.items()
            if mover is not None
        }
        links = {name: _freedoms_of_link(link, self.arms) for name, link in self.links.items()}
        return able | links

    @property
    def arms(self) -> dict[str, RobotModel]:
        """The models of the arms."""
        return {n: mover for n, mover in self.movers.items() if isinstance(mover, RobotModel)}

    def passing(self, motion: Motion) -> Motion:
        """Return the recorded motion of rails, positioners and links about each capture."""
        axes = {n: mover for n, mover in self.movers.items() if isinstance(mover, Axis)}
        placed = {
            name: np.array([axes[name].place(float(value)) for value in values[:, 0]])
            for name, values in motion.joints.items()
            if name in axes
        }
        placed |= {
            name: self.link_poses(name, motion.joints[link.arm])
            for name, link in self.links.items()
            if link.arm in motion.joints
        }
        # Recorded poses of other carriers win over the flange's, and computed ones over both: a
        # rail's stream holds values, not poses.
        own = {FLANGE: motion.poses} if FLANGE in self.movers else {}
        return replace(motion, others={**own, **motion.others, **placed})

    def reported(self, poses: Mapping[str, Floats], axes: Mapping[str, float]) -> Poses:
        """Return each carrier's pose in its base, from recorded poses (4, 4) and axis values."""
        places = dict(poses)
        for name, mover in self.movers.items():
            if isinstance(mover, Axis) and name in axes:
                places[name] = mover.place(axes[name])
        return {n: Transform(f"{n}_base", n, places[n]) for n in self.movers if n in places}

    def joints(self, observations: Sequence[Observation]) -> dict[str, Floats]:
        """Return joint angles (N, n) [rad] of each arm that reported them at all N observations."""
        each = {name: [joints_of(o, name) for o in observations] for name in self.arms}
        return {n: np.array(q) for n, q in each.items() if all(x is not None for x in q)}

    def link_poses(self, name: str, joints: Floats) -> Floats:
        """Return the poses (N, 4, 4) of a link in its arm's base at joint angles (N, n)."""
        from flangeye.maths.kinematics import Arm

        link = self.links[name]
        return Arm(self.arms[link.arm]).pose(joints, link.number)

    def with_links(self, links: Sequence[Link]) -> Cell:
        """Return the cell with a moving frame added for each of some links."""
        frames = {link.frame: Frame(f"{link.arm}_base") for link in links}
        return replace(
            self,
            frames={**self.frames, **frames},
            links={**self.links, **{link.frame: link for link in links}},
        )

    def name_of(self, frame: str) -> str:
        """Return the name ``parent_T_frame`` of a frame's transform."""
        return f"{self.frames[frame].parent}_T_{frame}"

    def describe(self) -> str:
        """Return one line: where each camera and target is mounted, and what is unknown."""
        ends = (*self.cameras, *self.targets)
        chains = (" - ".join(("base", *chain(self.frames, end))) for end in ends)
        return f"cell: {'; '.join(chains)}; to be found: {', '.join(self.unknowns)}"

    def graph(
        self,
        observations: Sequence[Observation],
        transforms: Mapping[str, Transform] | None = None,
    ) -> dict[str, Frame]:
        """Return the frame graph with the places reported in N observations.

        Args:
            observations: Observations with the poses that controllers report.
            transforms: The unknowns by name, where they were found.

        Raises:
            StageError: An observation lacks the pose of something that moves, or the joint angles
                from which a link's pose is computed.
        """
        found = {x.child: x.matrix for x in (transforms or {}).values()}
        measured = {name: _measured(name, observations) for name in self.movers}
        links = {
            name: self.link_poses(name, self._joints(name, link, observations))
            for name, link in self.links.items()
        }
        places = found | measured | links
        return {
            name: replace(frame, place=places.get(name, frame.place))
            for name, frame in self.frames.items()
        }

    def _joints(self, name: str, link: Link, observations: Sequence[Observation]) -> Floats:
        joints = [joints_of(o, link.arm) for o in observations]
        arm = self.arms.get(link.arm)
        for observation, each in zip(observations, joints, strict=True):
            if each is None or arm is None or len(each) != len(arm.joints):
                raise StageError(
                    f"where {name} was at observation {observation.id} is computed from the joint "
                    f"angles of '{link.arm}', which are missing: record them, and name the robot's "
                    f"model in the recipe"
                )
        return np.array(joints)

    def corrected(
        self, observations: Sequence[Observation], calibration: HandEye
    ) -> list[Observation]:
        """Return observations with every flange where a calibration's correction has it.

        The errors that all poses share are also removed from the features. Without a correction the
        observations are unchanged.
        """
        from flangeye.maths.arm_correction import corrected_observation
        from flangeye.maths.kinematics import Arm
        from flangeye.maths.statistics import without_shared

        alone = {FLANGE: calibration.correction} if calibration.correction else {}
        # Shared errors first: they are of the camera's measurements, which no flange correction
        # changes.
        moved = [without_shared(o, calibration.shared) for o in observations]
        for name, correction in {**alone, **calibration.arms}.items():
            mover = self.movers[name]
            model = Arm(mover) if isinstance(mover, RobotModel) else None
            moved = [corrected_observation(o, correction, model, name) for o in moved]
        return moved

    def ends(
        self, transforms: Mapping[str, Transform], observations: Sequence[Observation]
    ) -> Ends:
        """Return the poses of each observation's camera and target.

        Args:
            transforms: The unknowns, by name.
            observations: Observations whose poses are corrected already.

        Raises:
            StageError: A carrier's pose is missing.
        """
        frames = self.graph(observations, transforms)
        return Ends(
            _of_each(frames, [o.camera for o in observations]),
            _of_each(frames, [o.target for o in observations]),
        )


def _freedoms_of(robot: RobotModel) -> Floats:
    """Return unit twists (6, k): the axes of ``base`` that an arm can turn about, and all shifts.

    An arm of four joints turns about one.
    """
    from flangeye.maths.kinematics import Arm

    arm = Arm(robot)
    # Not at zero, where axes may be parallel that are not so in general
    # All shifts are kept: an arm of four joints still reaches along every axis of its base.
    axes = arm.axes(np.linspace(0.3, 0.7, arm.n))[0][~arm.slides]
    return np.eye(6)[:, [*_spanned(axes), True, True, True]]


def _freedoms_of_link(link: Link, arms: Mapping[str, RobotModel]) -> Floats:
    """Return unit twists (6, k): axes of ``base`` that a link can turn about, or move along.

    Only the joints before the link move it, so the first link just turns about one axis. The
    Jacobians at several postures are combined, as one posture may be singular.
    """
    from flangeye.maths.kinematics import Arm

    arm = Arm(arms[link.arm])
    # Three postures of which none is straight: a direction that one of them lacks, another shows.
    bent = np.multiply.outer([1.0, -1.0, 2.0], np.linspace(0.3, 0.7, arm.n))
    moves = np.concatenate(np.swapaxes(arm.jacobian(bent, link.number), 1, 2))
    return np.eye(6)[:, [*_spanned(moves[:, :3]), *_spanned(moves[:, 3:])]]


def _spanned(directions: Floats) -> Mask:
    """Return the mask (3,) of the coordinate axes that lie in the span of directions (N, 3)."""
    # An axis is in the span where least squares reproduce it
    reached = np.linalg.lstsq(directions.T, np.eye(3), rcond=1e-9)[0]
    return np.asarray(np.linalg.norm(directions.T @ reached - np.eye(3), axis=0) < 1e-6)


def _measured(name: str, observations: Sequence[Observation]) -> Floats:
    for observation in observations:
        if name not in observation.poses:
            raise StageError(
                f"observation {observation.id} has no pose of '{name}', which moves in this cell; "
                f"it has {', '.join(observation.poses) or 'none'}"
            )
    return np.array([o.poses[name].matrix for o in observations]).reshape(-1, 4, 4)


def joints_of(observation: Observation, arm: str) -> Array | None:
    """Return the (n,) joint angles of an arm at an observation [rad]; None if not recorded."""
    # Recordings of one arm store its angles without a name.
    own = observation.joints if arm == FLANGE else None
    return observation.arm_joints.get(arm, own)


def cell_of(
    configuration: Configuration, robot: RobotModel | None, second: RobotModel | None = None
) -> Cell:
    """Return the cell of one camera and one target that a configuration names.

    Args:
        configuration: Mountings of camera and target.
        robot: The arm's model, where it is known.
        second: Model of a second arm that carries the target.
    """
    # Every standard configuration is such a graph, so that solvers know one model of a cell only.
    frames = {FLANGE: Frame(BASE), CAMERA: Frame(configuration.camera)}
    movers: dict[str, RobotModel | Axis | None] = {FLANGE: robot}
    links: dict[str, Link] = {}
    if configuration.other_base:
        frames |= {BASE2: Frame(BASE), FLANGE2: Frame(BASE2)}
        movers[FLANGE2] = second
    frames[TARGET] = Frame(configuration.target, configuration.place)
    for carrier in (configuration.camera, configuration.target):
        if carrier.startswith(LINK):
            frames[carrier] = Frame(BASE)
            links[carrier] = Link(FLANGE, int(carrier.removeprefix(LINK)))
    return Cell(frames, movers, (CAMERA,), (TARGET,), links)


def cell_in(context: Mapping[Any, Any]) -> Cell:
    """Return the cell of a recipe's context: its own, or that of its configuration."""
    configuration, second = context.get(Configuration), context.get(SecondRobot)
    return context.get(Cell) or cell_of(
        configuration or DEFAULT, context.get(RobotModel), second.model if second else None
    )


def _of_each(frames: Mapping[str, Frame], names: Sequence[str]) -> Floats:
    """Return the poses (N, 4, 4) in the root of the frame that each observation names."""
    count = len(names)
    poses = {n: np.broadcast_to(composed(frames, n), (count, 4, 4)) for n in set(names)}
    return np.array([poses[name][i] for i, name in enumerate(names)]).reshape(-1, 4, 4)

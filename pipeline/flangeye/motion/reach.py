"""Flange poses that a cell allows: in view, reachable, with the arm out of the view; and plans."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from flangeye.devices import DeviceError, RobotDriver, RobotState
from flangeye.errors import FlangeyeError
from flangeye.maths.kinematics import Arm
from flangeye.models.bodies import TargetBody, carrying
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel, middle_of_view
from flangeye.motion.clearance import ArmVolume, BodyView
from flangeye.motion.limits import MotionLimits
from flangeye.types import Floats, Mask
from flangeye.types.geometry import rigid, rotation_from_rpy


class Margins(NamedTuple):
    """Safety margins of poses to limits, singularities and collisions.

    Attributes:
        limits: The arm's motion limits.
        joints: Margin to the joints' limits [rad].
        singularity: Smallest singular value of the Jacobian, lengths in units of the reach.
    """

    limits: MotionLimits
    joints: float
    singularity: float


class RefusedPose(NamedTuple):
    """A pose of the flange that is impossible.

    Attributes:
        place: (3,) position of the flange, in ``base`` [m].
        reason: Why the pose is impossible.
    """

    place: Floats
    reason: str


class Reach:
    """The poses at which an arm can show its flange, a body on it, or itself to a scanner.

    Attributes:
        arm: The arm's kinematics.
        shown: (3,) axis of the flange that faces the scanner: z, or where a body is broadest.
        refusals: Requested poses that are impossible.
        home: (n,) joint angles of the pose that faces the scanner best [rad]; see
            :meth:`facing_rotation`.
    """

    def __init__(
        self,
        robot: RobotModel,
        scanner: ScannerModel,
        base_T_camera: Floats,
        target: float | TargetBody,
        margins: Margins | None = None,
    ) -> None:
        """Prepare the search.

        Args:
            robot: The arm.
            scanner: The scanner.
            base_T_camera: (4, 4) pose of the scanner.
            target: Radius of the disc that must be in view [m]; or the body, on the flange or the
                arm itself, of which enough must be in view.
            margins: Safety margins of a real arm.

        Raises:
            StageError: The arm's collision shape is unknown, so no clearance can be checked.
        """
        body = target if isinstance(target, TargetBody) else None
        self.arm = Arm(robot)
        self._volume = ArmVolume(carrying(robot, body))
        self._body = None if body is None else BodyView(body, self.arm)
        self._radius = 0.0 if isinstance(target, TargetBody) else target
        self.shown = np.array([0.0, 0.0, 1.0])
        self._scanner = scanner
        self.look_from(base_T_camera)
        self._margins = margins
        self._reach = robot.length
        self.home = np.zeros(self.arm.n)
        self._start: Floats | None = None
        self.refusals: list[RefusedPose] = []

    def look_from(self, base_T_camera: Floats) -> None:
        """Set the scanner's pose (4, 4) ``base_T_camera``."""
        self._base_T_camera = base_T_camera
        lean = self._scanner.convergence
        projector = self._scanner.baseline * np.array([np.cos(lean), 0.0, np.sin(lean)])
        self._eyes = np.stack([np.zeros(3), projector]) @ base_T_camera[:3, :3].T
        self._eyes += base_T_camera[:3, 3]

    def why_refused(self) -> str:
        """Return the reasons why poses were impossible, with counts; empty if all were possible."""
        counts = Counter(refusal.reason for refusal in self.refusals).most_common()
        return ", ".join(f"{count} {reason}" for reason, count in counts)

    def facing_rotation(self, centre: Floats) -> Floats | None:
        """Return the rotation (3, 3) of a flange at ``centre`` that faces along the view.

        Its z is opposite to the camera's; a body instead shows its broadest side. About that axis
        the flange turns to the best manipulability, or to the nearest good posture if the arm's
        present one is known. The joints of that pose become the home that later poses stay near to.
        """
        found = [
            (float(self.arm.manipulability(joints)) * self._seen(joints)[0], pose[:3, :3], joints)
            for pose in self._rolls(centre)
            for joints in self._possible(pose)
        ]
        if not found:
            return None
        best = max(score for score, *_ in found)
        start = self._start
        if start is None:
            # The first of equals: rounding must not choose between mirrored postures
            chosen = next(each for each in found if each[0] >= best * (1 - 1e-9))
        else:
            # Share of the best manipulability that is good enough for a posture that is near
            good = [each for each in found if each[0] >= 0.5 * best]
            chosen = min(good, key=lambda each: _turn(each[2], start))
        self.home = chosen[2]
        if self._body:
            self.shown = -chosen[1].T @ self._base_T_camera[:3, 2]
        return chosen[1]

    def middle(self) -> Floats:
        """Return (3,) the place on the camera's axis to work at, in ``base`` [m].

        It is at the working distance. For a body it is the nearest place to that at which the arm
        can show the body.
        """
        scanner, base_T_camera = self._scanner, self._base_T_camera
        usual = middle_of_view(scanner, base_T_camera)
        if self._body is None:
            return usual
        eye, axis = base_T_camera[:3, 3], base_T_camera[:3, 2]
        # Steps of 10 cm, the nearest to the working distance first: each costs an inverse
        # kinematics per roll
        depths = np.arange(scanner.near, scanner.far, 0.1)
        places = eye + depths[np.argsort(np.abs(depths - axis @ (usual - eye)))][:, None] * axis
        for place in places:
            if self.facing_rotation(place) is not None:
                self.refusals.clear()
                return np.asarray(place)
        return usual

    def start_from(self, joints: Floats) -> None:
        """Prefer IK solutions near (n,) joint angles, the arm's present ones [rad]."""
        self._start = self.home = joints

    def _rolls(self, centre: Floats) -> list[Floats]:
        """Return poses (4, 4) at a point that face the scanner, rotated about the line of sight."""
        poses = []
        # Directions of the flange's x axis that are tried, to find where the arm moves best
        rolls = 8
        for side in _sides() if self._body else [np.eye(3)]:
            for step in range(rolls):
                turn = rotation_from_rpy(np.pi, 0.0, 2 * np.pi * step / rolls) @ side
                poses.append(rigid(self._base_T_camera[:3, :3] @ turn, centre))
        return poses

    def joints(self, base_T_flange: Floats) -> Floats | None:
        """Return the joint angles of a pose (4, 4) that are nearest to home; None if unreachable.

        None means: out of view or range, out of reach or limits, touching the table or itself, or
        with a link between scanner and target.
        """
        if self._body is None and not self.in_view(base_T_flange):
            self._refuse(base_T_flange, "out of the scanner's view")
            return None
        reachable = self._unwound(self.arm.inverse(base_T_flange))
        turns = [_turn(joints, self.home) for joints in reachable]
        nearby = reachable[np.argsort(turns, kind="stable")]
        # What a posture touches takes longest to find out: no more are asked than have to be.
        nearest: Floats | None = next((each for each in nearby if self._allowed(each)), None)
        if nearest is None:
            self._refuse(base_T_flange, self._why_not(reachable))
            return None
        # An arm that is under way does not turn a joint farther from home: it would fold over
        fold = np.radians(120.0)
        if self._start is not None and _turn(nearest, self.home) > fold:
            self._refuse(base_T_flange, "only with a joint more than 120 deg from home")
            return None
        return nearest

    def _refuse(self, base_T_flange: Floats, reason: str) -> None:
        self.refusals.append(RefusedPose(base_T_flange[:3, 3], reason))

    def in_view(self, base_T_flange: Floats) -> bool:
        """Return whether camera and projector see the whole disc, within the scanner's range."""
        angle = 2 * np.pi * np.arange(16) / 16
        rim = self._radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        return bool(self._inside(rim @ base_T_flange[:3, :3].T + base_T_flange[:3, 3]).all())

    def _inside(self, in_base: Floats) -> Mask:
        """Return the mask (N,) of points (N, 3) in the fields and range of camera and projector."""
        in_camera = (in_base - self._base_T_camera[:3, 3]) @ self._base_T_camera[:3, :3]
        scanner, depth = self._scanner, in_camera[:, 2]
        # Camera and projector are each tilted towards the other by the convergence
        turn = rotation_from_rpy(0.0, -2 * scanner.convergence, 0.0)
        from_projector = (in_base - self._eyes[1]) @ self._base_T_camera[:3, :3] @ turn
        inside = _within(in_camera, scanner.field_of_view)
        inside &= (depth >= scanner.near) & (depth <= scanner.far)
        if scanner.projection is not None:
            inside &= _within(from_projector, scanner.projection)
        return inside

    def _seen(self, joints: Floats) -> tuple[float, float]:
        """Return the solid angle of a body that is seen, and its share of what faces the camera."""
        if self._body is None:
            return 1.0, 1.0
        body = self._body.placed(joints)
        faces = body.faces(self._eyes[0])
        seen = self._inside(body.points) & (body.faces(self._eyes[1]) > 0)
        if not self._body.is_arm:
            axes = self._volume.axes(self.arm.frames(joints))
            for eye in self._eyes:
                sight = np.stack([np.broadcast_to(eye, body.points.shape), body.points], axis=1)
                seen &= ~self._volume.hides(axes, sight)
        return float(faces[seen].sum()), float(faces[seen].sum() / faces.sum())

    def _possible(self, base_T_flange: Floats) -> list[Floats]:
        reachable = self._unwound(self.arm.inverse(base_T_flange))
        possible = [joints for joints in reachable if self._allowed(joints)]
        if not possible:
            self._refuse(base_T_flange, self._why_not(reachable))
        return possible

    def _allowed(self, joints: Floats) -> bool:
        if not self._clear(joints) or self._too_near(joints):
            return False
        # Least share of a body in view: twice what finds it, for what may stand before it
        return self._seen(joints)[1] >= 0.6

    def _why_not(self, reachable: Floats) -> str:
        """Return the reason why none of the postures (K, n) is allowed."""
        clear = next((joints for joints in reachable if self._clear(joints)), None)
        if clear is not None:
            return self._too_near(clear) or "with too little of the body in view"
        return "with the arm in the way" if len(reachable) else "out of the arm's reach"

    def _unwound(self, joints: Floats) -> Floats:
        """Take (K, n) angles by whole turns as near to home as the limits allow."""
        if self._start is None:
            return joints
        # Inverse kinematics gives each angle once; a joint of two turns has it again 2 pi away
        nearer = joints + 2 * np.pi * np.round((self.home - joints) / (2 * np.pi))
        allowed = (nearer >= self.arm.lower) & (nearer <= self.arm.upper)
        return np.where(allowed, nearer, joints)

    def _too_near(self, joints: Floats) -> str | None:
        """Return the name of an obstacle too near to a posture; None if there is none."""
        if self._margins is None:
            return None
        limits, room, singularity = self._margins
        if limits.outside(self.arm.flange(joints)[:3, 3]):
            return "outside robot.limits.box"
        if limits.beyond(joints, room):
            return "near the limits of the joints"
        # Lengths in units of the reach: singular values of metres and radians do not compare
        # Rows 0 to 2 are rotations, 3 to 5 translations
        jacobian = self.arm.jacobian(joints)
        jacobian[3:] /= self._reach
        smallest = np.linalg.svd(jacobian, compute_uv=False)[-1]
        return "near a singularity" if smallest < singularity else None

    def _clear(self, joints: Floats) -> bool:
        volume = self._volume
        axes = volume.axes(self.arm.frames(joints))
        # Half the width of a scanner's housing about the line from camera to projector [m]
        housing = 0.1
        # The table the arm stands on
        above, apart = volume.above(axes, 0.0), volume.apart(axes)
        if not (above and apart and volume.away(axes, self._eyes, housing)):
            return False
        if self._body:
            return True
        towards = self._eyes - self.arm.flange(joints)[:3, 3]
        # As wide as the flange up to where that width ends at its face
        away = np.linalg.norm(towards, axis=1, keepdims=True)
        sight = np.stack([self._eyes, self._eyes - (1 - self._radius / away) * towards], axis=1)
        return volume.leaves_free(axes, sight, self._radius)


def _sides() -> list[Floats]:
    """Return rotations (3, 3) that take each axis of the flange, either way, to its z."""
    turns = [(0.0, 0.0), (np.pi, 0.0), *((t, 0.0) for t in (-np.pi / 2, np.pi / 2))]
    return [rotation_from_rpy(*turn, 0.0) for turn in (*turns, (0.0, np.pi / 2), (0.0, -np.pi / 2))]


def _turn(first: Floats, second: Floats) -> float:
    """Return the largest turn of a joint from one posture to another [rad]."""
    # Rounded, so that equal postures are ordered alike on every processor
    return float(np.abs(first - second).max().round(6))


def _within(points: Floats, field: tuple[float, float]) -> Mask:
    """Return the mask (N,) of points (N, 3) in a pinhole's field of view, with a margin."""
    # Share of the field of view, to either side, that a planned target keeps to
    view_share = 0.95
    half = np.tan(np.asarray(field) / 2) * view_share
    return np.asarray((np.abs(points[:, :2]) <= half * points[:, 2:]).all(axis=1))


@dataclass(frozen=True, eq=False)
class Site:
    """Arm, scanner and obstacles that a plan is made for.

    Attributes:
        centre: (3,) default centre of the workspace in ``base`` [m].
        eye: (3,) position of the scanner in ``base`` [m].
        facing_rotation: Returns the rotation (3, 3) of a flange at a point (3,) that faces the
            scanner; None if the arm cannot reach it.
        joints: Returns the joint angles for a flange pose (4, 4); None if it is unreachable or not
            allowed.
        lost: Returns the indices, in visiting order, of the poses without a capture.
        shown: Returns the axis (3,) of the flange that faces the scanner when the target does.
    """

    centre: Floats
    eye: Floats
    facing_rotation: Callable[[Floats], Floats | None]
    joints: Callable[[Floats], Floats | None]
    lost: Callable[[], Collection[int]] = frozenset
    shown: Callable[[], Floats] = lambda: np.array([0.0, 0.0, 1.0])


class PlannedPose(NamedTuple):
    """A pose to visit: (4, 4) ``base_T_flange``, and (n,) joint angles that reach it.

    ``why`` is a text that says what the pose is good for, where the plan knows.
    """

    base_T_flange: Floats
    joints: Floats
    why: str = ""


class Plan(NamedTuple):
    """Poses to visit, in their order.

    Attributes:
        poses: Poses in the order of their visit; a plan may choose each when it is asked for.
        wanted: Number of poses if the arm could reach them all.
        centre: (3,) centre of the box for the poses, in ``base`` [m].
        size: (3,) edges of that box [m].
    """

    poses: Iterable[PlannedPose]
    wanted: int
    centre: Floats
    size: Floats


class Planner(Protocol):
    """How a ``plan`` part is called."""

    def __call__(self, site: Site, rng: np.random.Generator) -> Plan:
        """Return the poses to visit; ``rng`` is the only randomness."""


def poses_near(
    place: Floats,
    count: int,
    site: Site,
    rng: np.random.Generator,
    spread: tuple[Any, float] = (0.02, 0.2),
) -> list[PlannedPose]:
    """Return up to so many reachable poses drawn around a point (3,).

    Args:
        place: (3,) point in ``base`` [m].
        count: Number of poses.
        site: The arm's reachable poses.
        rng: Random generator.
        spread: Largest distance from the point, (3,) or equal along each axis [m], and largest
            roll, pitch and yaw [rad].
    """
    found: list[PlannedPose] = []
    facing, (near, tilt) = site.facing_rotation(place), spread
    # Poses tried for each of them
    for _ in range(50 * count):
        if facing is None or len(found) == count:
            break
        pose = tilted(place + rng.uniform(-near, near, 3), facing, tilt, rng)
        joints = site.joints(pose)
        found += [] if joints is None else [PlannedPose(pose, joints)]
    return found


def tilted(place: Floats, facing: Floats, tilt: float, rng: np.random.Generator) -> Floats:
    """Return a pose (4, 4) at a point, its roll, pitch and yaw from facing below ``tilt``."""
    roll, pitch, yaw = rng.uniform(-tilt, tilt, 3)
    return rigid(rotation_from_rpy(roll, pitch, yaw) @ facing, place)


def read_state(driver: RobotDriver) -> tuple[str, RobotState]:
    """Return an arm's name and state without starting or commanding anything.

    Raises:
        DeviceError: The driver has no way to read alone, or the arm cannot be read: why.
    """
    if driver.read is None:
        raise DeviceError(f"{driver.name} cannot read the arm without taking control of it")
    try:
        with driver.read() as robot:
            return robot.name, robot.state()
    except FlangeyeError:
        raise
    except Exception as error:  # a vendor's client may fail in any way
        raise DeviceError(
            f"{driver.name} failed with {type(error).__name__}: {' '.join(str(error).split())}"
        ) from error

"""``plan.*``: where the arm is sent to be scanned. Add a plan: a new module here.

``plan.grid`` takes the corners of a box, in random orientations that face the scanner;
``plan.next_best`` the pose that reduces the expected error at the work most.
"""

from collections.abc import Iterator
from typing import ClassVar

import numpy as np
from pydantic import Field

from flangeye.estimation.observability import in_base
from flangeye.motion.reach import Plan, PlannedPose, Site, tilted
from flangeye.plugin.stage import Params, part
from flangeye.types import Box, Floats
from flangeye.types.geometry import angle_between, hat, levers, rigid, rotation_from_rpy
from flangeye.units import Angle, Length, param

LengthTriple = tuple[Length, Length, Length]


class PlanParams(Params):
    """The region in which plans look for poses."""

    centre: LengthTriple | None = None
    """Centre of the work; before the scanner if not given."""
    size: LengthTriple = param(("300 mm", "300 mm", "200 mm"))
    """Edges of the work along the base's axes: where the matrix has to be right."""
    tilt: Angle = param("0.3 rad", ge=0)
    """Largest roll, pitch and yaw away from facing the scanner."""
    facing: Angle = param("35 deg", gt=0)
    """Largest angle between the view and the flange's normal; for a body, the flange's axis along
    which the body is shown."""


class GridParams(PlanParams):
    """Parameters of ``plan.grid``."""

    counts: tuple[int, int, int] = (3, 3, 2)
    """Grid points along each edge."""


@part("plan.grid")
def grid(site: Site, rng: np.random.Generator, params: GridParams) -> Plan:
    """Visit a grid of points in random order, each in a random orientation facing the scanner.

    This is the paper's plan: 5 x 5 x 3 points over 0.3 x 0.3 x 0.2 m (section 3.1), with roll,
    pitch and yaw below 0.3 rad (3.2.1). Grid points without a possible orientation are left out.

    Args:
        site: The place.
        rng: Draws order and orientations.
        params: The grid.
    """
    centre = site.centre if params.centre is None else np.asarray(params.centre)
    size = np.asarray(params.size)
    nodes = rng.permutation(centre + size * _unit_grid(params.counts))
    facing = site.facing_rotation(centre)
    found = [] if facing is None else [_pose_at(n, facing, site, rng, params) for n in nodes]
    return Plan([pose for pose in found if pose is not None], len(nodes), centre, size)


def _unit_grid(counts: tuple[int, int, int]) -> Floats:
    ticks = [np.linspace(-0.5, 0.5, n) if n > 1 else np.zeros(1) for n in counts]
    return np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)


def _pose_at(
    place: Floats, facing: Floats, site: Site, rng: np.random.Generator, params: GridParams
) -> PlannedPose | None:
    for _ in range(25):
        pose = tilted(place, facing, params.tilt, rng)
        if angle_between(pose[:3, :3] @ site.shown(), site.eye - place) > params.facing:
            continue
        joints = site.joints(pose)
        if joints is not None:
            return PlannedPose(pose, joints)
    return None


class NextBestParams(PlanParams):
    """Parameters of ``plan.next_best``."""

    count: int = Field(30, ge=3, le=10_000)
    """Number of poses."""
    # Candidate poses compared for each choice
    candidates: ClassVar[int] = 400
    # Expected standard deviation of a centre per axis: scanner, fit and arm [m]
    noise: ClassVar[float] = 0.15e-3


@part("plan.next_best")
def next_best(site: Site, rng: np.random.Generator, params: NextBestParams) -> Plan:
    """Choose each next pose to reduce the expected error at the work most.

    This is greedy A-optimal design (Pukelsheim 1993). Of many random poses in the region it takes
    the one with the smallest expected square error over the work, given the poses visited before.
    Poses without a measurement do not count. Candidates are checked best first, so that inverse
    kinematics is solved for a few only.
    """
    centre = site.centre if params.centre is None else np.asarray(params.centre)
    size = np.asarray(params.size)
    chooser = Chooser(site, rng, params, Box(centre, size))
    return Plan(chooser.poses(), params.count, centre, size)


class Chooser:
    """Chooses poses one by one."""

    def __init__(
        self, site: Site, rng: np.random.Generator, params: NextBestParams, work: Box
    ) -> None:
        self._site, self._rng, self._params, self._work = site, rng, params, work
        # Poses are chosen beyond the work too: levers are long there.
        self._region = Box(work.centre, 1.6 * work.size)
        self._moved_by = levers(work.grid(3) - work.centre)
        self._visited: list[Floats] = []

    def poses(self) -> Iterator[PlannedPose]:
        """Yield reachable poses, at each step the most informative one."""
        facing = self._site.facing_rotation(self._work.centre)
        while facing is not None and len(self._visited) < self._params.count:
            chosen = self._choose(facing)
            if chosen is None:
                return
            self._visited.append(chosen.base_T_flange)
            yield chosen

    def _choose(self, facing: Floats) -> PlannedPose | None:
        candidates = self._candidates(facing)
        for index in np.argsort(self._expected_errors(candidates), kind="stable"):
            joints = self._site.joints(candidates[index])
            if joints is not None:
                return PlannedPose(candidates[index], joints, self._why(candidates[index]))
        return None

    def _candidates(self, facing: Floats) -> Floats:
        """Draw (M, 4, 4) poses of the region that face the scanner."""
        region, params = self._region, self._params
        places = region.centre + region.size * self._rng.uniform(-0.5, 0.5, (params.candidates, 3))
        turns = self._rng.uniform(-params.tilt, params.tilt, (params.candidates, 3))
        drawn = np.array([
            rigid(rotation_from_rpy(*turn) @ facing, place)
            for turn, place in zip(turns, places, strict=True)
        ])  # fmt: skip
        off = angle_between(drawn[:, :3, :3] @ self._site.shown(), self._site.eye - places)
        return np.asarray(drawn[off <= params.facing])

    def _expected_errors(self, candidates: Floats) -> Floats:
        """Return the (M,) expected square error over the work after each candidate [m^2]."""
        covariance = np.linalg.inv(self._known() + self._information(candidates))
        moved = self._moved_by
        return np.asarray(np.einsum("pai,mij,paj->m", moved, covariance, moved))

    def _known(self) -> Floats:
        """Return the (6, 6) information of the poses that were visited and measured."""
        lost = self._site.lost()
        counted = [pose for i, pose in enumerate(self._visited) if i not in lost]
        told = self._information(np.array(counted).reshape(-1, 4, 4)).sum(axis=0)
        # Known before the first pose: standard deviations, rotation [rad], translation [m]
        return np.asarray(np.diag(np.array([0.2, 0.2, 0.2, 0.1, 0.1, 0.1]) ** -2.0) + told)

    def _why(self, pose: Floats) -> str:
        """Describe a pose's benefit: the error reduction, and the direction it informs most."""
        known, told = self._known(), self._information(pose[None])[0]
        before, after = np.linalg.inv(known), np.linalg.inv(known + told)
        weight = np.einsum("pai,paj->ij", self._moved_by, self._moved_by) / len(self._moved_by)
        errors = [1e3 * np.sqrt(np.trace(weight @ of)) for of in (before, after)]
        less = before - after
        turn = np.trace(weight[:3, :3] @ less[:3, :3]) > np.trace(less[3:, 3:])
        part, word = (less[:3, :3], "turn about") if turn else (less[3:, 3:], "shift along")
        axis = np.linalg.eigh(part)[1][:, -1]
        axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
        return (
            f"expected error at the work from {errors[0]:.2f} to {errors[1]:.2f} mm rms, mostly in "
            f"the "
            f"{word} base {in_base(axis, 2)}"
        )

    def _information(self, poses: Floats) -> Floats:
        """Return the (M, 6, 6) Fisher information of poses (M, 4, 4), about the work's centre."""
        of_centre = levers(poses[:, :3, 3] - self._work.centre)
        axes = poses[:, :3, 2]
        of_normal = np.concatenate([-hat(axes), np.zeros((len(axes), 3, 3))], axis=2)
        return np.asarray(
            np.einsum("mai,maj->mij", of_centre, of_centre) / self._params.noise**2
            + np.einsum("mai,maj->mij", of_normal, of_normal) / np.radians(0.1) ** 2
        )

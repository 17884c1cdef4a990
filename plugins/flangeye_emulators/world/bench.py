"""A workpiece on a bench among other objects, and a registry of the simulated arms.

Controllers read an arm's reported pose, but a simulated finger or scanner on it needs the true one.
Simulated arms of this process therefore register here, and simulated sensors look them up without
going through the controller.
"""

from typing import Protocol
from weakref import WeakSet, ref

import numpy as np
from pydantic import Field

from flangeye.devices import DeviceError, RobotState
from flangeye.maths.seam_geometry import distances_to_line
from flangeye.models.workpiece import Workpiece, WorkpiecePath
from flangeye.plugin.stage import Params
from flangeye.types import BASE, FLANGE, Floats, Transform
from flangeye.types.geometry import rigid, rotation_from_rpy
from flangeye.units import Angle, Length, param
from flangeye_emulators.world.mesh import MATERIALS, Mesh, box, capsule
from flangeye_emulators.world.raycast import SolidBody

BENCH_MARGIN = 0.25
"""Distance from the workpiece's box to the bench's edge on each side [m]."""


CLUTTER = 6
"""Clutter on the bench."""


class LaidParams(Params):
    """The true pose of a workpiece."""

    workpiece: WorkpiecePath = param("v-straight")
    """One of data/workpieces, or a .yaml file of your own."""
    position: tuple[Length, Length, Length] = param(("600 mm", "0 mm", "250 mm"))
    """Position of the workpiece's CAD origin in the base."""
    rpy: tuple[Angle, Angle, Angle] = param(("0 deg", "0 deg", "20 deg"))
    """Roll, pitch, yaw of the workpiece's CAD frame in the base."""

    @property
    def base_T_part(self) -> Floats:
        """True pose (4, 4) of the workpiece [m]."""
        return rigid(rotation_from_rpy(*self.rpy), np.asarray(self.position))


class BenchParams(LaidParams):
    """Parameters of a workpiece on a bench."""

    covered: float = Field(0.0, ge=0, lt=1)
    """Share of the workpiece covered by a sheet, at one end."""

    def true_seams(self, workpiece: Workpiece) -> dict[str, Floats]:
        """Return the workpiece's true seams by name, (N, 3) in ``base`` [m]."""
        pose = self.base_T_part
        return {
            name: np.asarray(seam.points @ pose[:3, :3].T + pose[:3, 3])
            for name, seam in workpiece.seams.items()
        }


def bench_with(
    workpiece: Workpiece, base_T_part: Floats, covered: float, rng: np.random.Generator
) -> list[SolidBody]:
    """Return the bodies of a bench with a workpiece, in ``base``.

    Args:
        workpiece: The workpiece.
        base_T_part: (4, 4) pose of the workpiece; the bench is directly below it.
        covered: Share of the workpiece under a sheet, from the end with the largest x.
        rng: Random generator of other objects; some of them touch the workpiece.
    """
    part = Mesh(workpiece.vertices, workpiece.triangles).moved(base_T_part)
    low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
    top = float(low[2])
    bench = box([*(low[:2] - BENCH_MARGIN), top - 0.04], [*(high[:2] + BENCH_MARGIN), top])
    bodies = [SolidBody(bench, MATERIALS["table"]), SolidBody(part, MATERIALS["metal"])]
    seams = [
        s.points @ base_T_part[:3, :3].T + base_T_part[:3, 3] for s in workpiece.seams.values()
    ]
    for _ in range(CLUTTER):
        bodies.append(_thing(_free_place(low, high, seams, rng), top, rng))
    return bodies + ([_sheet(workpiece, base_T_part, covered)] if covered > 0 else [])


def _free_place(low: Floats, high: Floats, seams: list[Floats], rng: np.random.Generator) -> Floats:
    """Return a random place (2,) around the workpiece, away from the seams."""
    for _ in range(200):
        place = rng.uniform(low[:2] - BENCH_MARGIN / 2, high[:2] + BENCH_MARGIN / 2)
        flat = [seam * [1.0, 1.0, 0.0] for seam in seams]
        at = np.array([[*place, 0.0]])
        # From a seam to the middle of anything that lies about: it may touch the part, not the
        # groove
        if all(distances_to_line(at, seam)[0] > 0.045 for seam in flat):
            break
    return np.asarray(place)


def _thing(place: Floats, floor: float, rng: np.random.Generator) -> SolidBody:
    """Return a random block or rod on the bench."""
    size = rng.uniform(0.01, 0.03, 3)
    pose = rigid(rotation_from_rpy(0.0, 0.0, rng.uniform(0, np.pi)), np.array([*place, floor]))
    if rng.random() < 0.6:
        block = box([-size[0], -size[1], 0.0], [size[0], size[1], 2 * size[2]])
        return SolidBody(block.moved(pose), MATERIALS["painted"])
    radius = float(size[0]) / 2
    ends = np.array([[-size[1] - 0.02, 0, radius], [size[1] + 0.02, 0, radius]])
    return SolidBody(capsule(ends[0], ends[1], radius).moved(pose), MATERIALS["rubber"])


def _sheet(workpiece: Workpiece, base_T_part: Floats, covered: float) -> SolidBody:
    """Return a sheet that hides one end of the workpiece."""
    low, high = workpiece.vertices.min(axis=0), workpiece.vertices.max(axis=0)
    edge = high[0] - covered * (high[0] - low[0])
    above = high[2] + 0.03
    sheet = box([edge, low[1] - 0.02, above], [high[0] + 0.02, high[1] + 0.02, above + 0.002])
    return SolidBody(sheet.moved(base_T_part), MATERIALS["matt"])


class StandingArm(Protocol):
    """Interface of a simulated arm that the bench's scanner can see."""

    def state(self) -> RobotState:
        """Return the arm's reported state."""

    def true_flange(self) -> Floats:
        """Return the true ``base_T_flange`` (4, 4)."""


_ARMS: WeakSet[StandingArm] = WeakSet()
_NEWEST: list[ref[StandingArm]] = []


def enter(arm: StandingArm) -> None:
    """Register a simulated arm for its lifetime."""
    _ARMS.add(arm)
    _NEWEST[:] = [ref(arm)]


def newest() -> StandingArm | None:
    """Return the arm registered last, which carries all mounted sensors; None without one."""
    return _NEWEST[0]() if _NEWEST else None


def true_flange(reported: RobotState) -> Transform:
    """Return the true flange pose of the arm with this reported state.

    For an arm that is not simulated in this process it is the reported pose.
    """
    for arm in _ARMS:
        try:
            state = arm.state()
        except DeviceError:  # of another session, gone by now: it reported nothing
            continue
        same = len(state.joints) == len(reported.joints) and state.time_ns == reported.time_ns
        if same and np.array_equal(state.joints, reported.joints):
            return Transform(BASE, FLANGE, arm.true_flange())
    return reported.base_T_flange

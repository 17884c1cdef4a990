"""The true state of a simulated weld: tip, tag, torch and seam."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from flangeye.motion.seam_following import Command, ToolPose, turned
from flangeye.types import Floats
from flangeye_emulators.weld_world.groove import (
    TICK,
    Groove,
    GrooveSection,
    Relief,
    Tip,
    TipContact,
)
from flangeye_emulators.weld_world.truth import (
    ArmTruth,
    ClockTruth,
    FingerTruth,
    HeatTruth,
    ToolTruth,
    WeldTruth,
    WorkpieceTruth,
)
from flangeye_plugins.weld.frame import leaning
from flangeye_plugins.weld.path import Path

GRAIN = 1e-3
"""Correlation length of spatter along the seam [m]."""


@dataclass(frozen=True, eq=False)
class Nominal:
    """Nominal values from the files, from which the true world differs.

    Attributes:
        seam: The CAD's seam in the plane of the work.
        section: The CAD's cross-section.
        tip: The finger's tip.
        torch: (3,) vector from the tip to the torch in the tool's axes [m].
        level_R_tool: (3, 3) nominal rotation from the tool's axes to level axes.
    """

    seam: Path
    section: GrooveSection
    tip: Tip
    torch: Floats
    level_R_tool: Floats


class WeldWorld:
    """The true arm, tool, finger, workpiece and heat.

    Attributes:
        groove: The true groove.
        tip: (3,) position of the tip in the plane of the work [m].
        torch: (3,) position of the torch [m].
        torch_s: Arc length of the torch on the true seam [m].
        off: Offset of the torch to the left of the seam's present position [m].
    """

    def __init__(
        self,
        nominal: Nominal,
        truth: WeldTruth,
        seed: int | list[int],
        flattened: Callable[[Floats, Floats], Floats] = lambda tip, torch: torch,
    ) -> None:
        """Construct a world from nominal and true values.

        Args:
            nominal: Values that the files state.
            truth: True values of the world.
            seed: Seed of its random values.
            flattened: Maps tip (3,) and torch (3,), both in the tangent plane at the tip, to the
                torch (3,) in the flattened plane; the default is a flat surface.
        """
        rng = np.random.default_rng(seed)
        self.groove: Groove = true_groove(nominal.seam, nominal.section, truth.workpiece, rng)
        tip, finger = nominal.tip, truth.finger
        stiff = tip.lateral * finger.lateral, tip.axial * finger.axial
        self.contact = TipContact(self.groove, Tip(tip.radius, *stiff, finger.friction))
        self._arm = ArmError(truth.arm, rng)
        self._tool, self._stands = TrueTool(truth.tool, nominal.torch), nominal.level_R_tool
        self._finger = TrueFinger(truth.finger)
        self._heat = SeamDistortion(truth.heat, self.groove.root.length)
        self._flattened = flattened
        self.tip, self.torch = np.zeros(3), np.zeros(3)
        self._behind = float(nominal.torch[0])
        self.torch_s, self.off = self._behind, 0.0

    def held(self, pose: ToolPose, level_R_tool: Floats) -> tuple[Floats, Floats]:
        """Return the finger's axes (3, 3) in the plane, and the undeformed tip (3,) [m]."""
        return self._tool.axes(pose, level_R_tool), self._tool.rest(pose, level_R_tool)

    def settle(self, reported: ToolPose, level_R_tool: Floats | None = None) -> Floats:
        """Simulate the tip's equilibrium; return its displacement as shown by the tag (3,) [m].

        Args:
            reported: Pose of the tool by the arm's report and the files.
            level_R_tool: (3, 3) true rotation of the tool at present; the nominal one if not given.
        """
        stands = self._stands if level_R_tool is None else level_R_tool
        pose = self._arm.true_pose(reported)
        self.torch = self._flattened(pose.position, self._tool.torch(pose, stands))
        root = self.groove.root
        # The plane of a round seam may lie on itself: the torch is where it follows the tip.
        behind = self.contact.s + self._behind
        near = self.torch_s if abs(self.torch_s - behind) < abs(self._behind) else behind
        self.torch_s = root.foot(self.torch[:2], near)
        place = root.at(self.torch_s)
        moved = self._heat.at(self.torch_s, self.torch_s)
        self.off = float((self.torch[:2] - place.point) @ place.normal) - moved
        rest, axes = self._tool.rest(pose, stands), self._tool.axes(pose, stands)
        moved = self._heat.at(self.contact.s, self.torch_s)
        self.tip = self.contact.settle(rest, moved, axes)
        return self._finger.shown(pose.time, axes.T @ (self.tip - rest))


class SeamDistortion:
    """Thermal displacement of the seam, as a function of the torch's position."""

    def __init__(self, truth: HeatTruth, length: float) -> None:
        self._truth, self._length = truth, length

    def at(self, s: float, torch: float) -> float:
        """Return the seam's displacement to the left at ``s``, with the torch at ``torch`` [m]."""
        truth = self._truth
        if torch <= 0.0:
            return 0.0
        whole = truth.shift * min(torch / self._length, 1.0)
        near = (s - torch) / 15e-3  # standard deviation of a Gaussian [m]
        return whole + truth.local * math.exp(-0.5 * near**2)


class TrueTool:
    """True tip and torch of a tool whose file is wrong."""

    def __init__(self, truth: ToolTruth, torch: Floats) -> None:
        """Construct the tool from the true errors and the nominal torch (3,) from the tip [m]."""
        self._tip = turned(np.asarray(truth.tip, dtype=np.float64), truth.yaw)
        aside = np.array([*truth.torch, truth.tip[2]])
        self._leans = leaning(truth.work, 0.0)
        self._torch = turned(self._leans @ torch + aside, truth.yaw)

    def axes(self, pose: ToolPose, level_R_tool: Floats) -> Floats:
        """Return the finger's true axes (3, 3) in the plane."""
        c, s = np.cos(pose.angle), np.sin(pose.angle)
        heading = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(heading @ level_R_tool @ self._leans)

    def rest(self, pose: ToolPose, level_R_tool: Floats) -> Floats:
        """Return the true position of the undeformed tip (3,) [m]."""
        return pose.position + turned(level_R_tool @ self._tip, pose.angle)

    def torch(self, pose: ToolPose, level_R_tool: Floats) -> Floats:
        """Return the true position of the torch (3,) [m]."""
        return pose.position + turned(level_R_tool @ self._torch, pose.angle)


class TrueFinger:
    """Chain of the finger's errors: play, hysteresis, creep and a drifting gain."""

    def __init__(self, truth: FingerTruth) -> None:
        self._truth = truth
        self._played, self._lagging, self._crept = (np.zeros(3) for _ in range(3))
        self._time: float | None = None
        self._age = 0.0

    def shown(self, time: float, displacement: Floats) -> Floats:
        """Return the displacement (3,) that the tag shows for a true displacement of the tip (3,).

        Both are in the tool's axes [m]. Calls must be in order of time [s], as the errors have
        memory.
        """
        truth = self._truth
        elapsed = 0.0 if self._time is None else time - self._time
        self._time, self._age = time, self._age + elapsed
        self._played = _follow(self._played, displacement, truth.play / 2)
        # Displacement over which the lagging share comes along [m]
        self._lagging = _follow(self._lagging, self._played, 1e-3)
        moved = self._played + truth.hysteresis * (self._lagging - self._played)
        share = 1.0 - math.exp(-elapsed / 10.0)  # time constant [s]
        self._crept = self._crept + share * (moved - self._crept)
        gain = 1.0 + truth.gain + truth.drift * self._age / 60.0
        return np.asarray(truth.rest) + gain * (moved + truth.creep * self._crept)


def _follow(behind: Floats, ahead: Floats, half: float) -> Floats:
    """Return the output of a backlash of half width ``half``, driven by ``ahead``."""
    return np.clip(behind, ahead - half, ahead + half)


def true_groove(
    seam: Path, section: GrooveSection, truth: WorkpieceTruth, rng: np.random.Generator
) -> Groove:
    """Return the true groove.

    Args:
        seam: The CAD's seam in the plane of the work, with its height.
        section: The CAD's cross-section.
        truth: Differences from the CAD.
        rng: Random generator of spatter and of the waves' phases.
    """
    root = _wandered(seam, truth, rng.uniform(0.0, 2 * np.pi))
    real = GrooveSection(
        section.half_angle + truth.half_angle, section.depth, section.lean + truth.lean
    )
    return Groove(root, real, truth.gaps, _relief(root.length, real, truth, rng))


def _wandered(path: Path, truth: WorkpieceTruth, phase: float) -> Path:
    if not (truth.wave or truth.bow):
        return path
    s = np.linspace(path.first, path.last, len(path.points))
    waves = path.length / truth.wave_length
    waves = max(round(waves), 1) if path.closed else waves  # around, it comes back to itself
    aside = truth.wave * np.sin(2 * np.pi * waves * s / path.length + phase)
    aside += truth.bow * np.sin(np.pi * np.mod(s, path.length) / path.length)
    points = path.points.copy()
    points[:, :2] += aside[:, None] * np.stack([-path.tangents[:, 1], path.tangents[:, 0]], axis=1)
    return Path(points, -path.first)


def _relief(
    length: float, section: GrooveSection, truth: WorkpieceTruth, rng: np.random.Generator
) -> Relief:
    s = np.arange(0.0, length + TICK, TICK)
    fill = _grains(s, truth.spatter, rng) - truth.root_gap / 2 / np.tan(section.half_angle)
    for tack in truth.tacks:
        inside = np.clip(np.minimum(s - tack.start, tack.start + 8e-3 - s) / GRAIN, 0.0, 1.0)
        fill = fill + tack.height * inside
    # Period with which the half angle varies along the seam [m]
    wider = truth.half_angle_wave * np.sin(2 * np.pi * s / 60e-3 + rng.uniform(0.0, 2 * np.pi))
    aside = _grains(s, truth.spatter, rng)
    return Relief(tuple(fill.tolist()), tuple(aside.tolist()), tuple(wider.tolist()))


def _grains(s: Floats, sigma: float, rng: np.random.Generator) -> Floats:
    knots = np.arange(0.0, s[-1] + 2 * GRAIN, GRAIN)
    return np.interp(s, knots, sigma * rng.standard_normal(len(knots)))


class ArmError:
    """Model of the arm's pose error, applied to successive reported poses."""

    def __init__(self, truth: ArmTruth, rng: np.random.Generator) -> None:
        self._truth, self._rng = truth, rng
        self._phase = rng.uniform(0.0, 2 * np.pi, 2)
        self._origin: Floats | None = None
        self._slack = 0.0

    def true_pose(self, reported: ToolPose) -> ToolPose:
        """Return the tool's true pose for a reported one."""
        truth, position = self._truth, reported.position
        self._origin = position.copy() if self._origin is None else self._origin
        way = position - self._origin
        turns = 2 * np.pi * way[:2] / truth.wave_length + self._phase
        wave = truth.wave * np.array([math.sin(turns[1]), math.sin(turns[0])])
        error = np.array([*(wave + truth.scale * way[:2]), -truth.sag * float(way[0]) / 0.1])
        error[1] += self._lost(float(way[1]))
        if truth.repeatability:
            error += truth.repeatability * self._rng.standard_normal(3)
        return ToolPose(reported.time, position + error, reported.angle)

    def _lost(self, way: float) -> float:
        """Return the part of a travel that is lost in backlash."""
        half = self._truth.backlash / 2
        self._slack = min(max(self._slack, way - half), way + half)
        return self._slack - way


class ArmResponse:
    """An arm in the plane of the work that follows velocities with dead time and lag."""

    def __init__(self, truth: ArmTruth, pose: ToolPose, period: float) -> None:
        """Start at rest at a pose; a cycle lasts ``period`` [s]."""
        self.pose = pose
        self._period = period
        self._commands: deque[Floats] = deque([np.zeros(4)] * round(truth.dead_time / period))
        self._share = 1.0 - math.exp(-period / truth.lag) if truth.lag else 1.0
        self._speed = np.zeros(4)

    def go(self, command: Command) -> None:
        """Simulate one cycle under a command."""
        self._commands.append(np.array([*command.velocity, command.turn]))
        self._speed = self._speed + self._share * (self._commands.popleft() - self._speed)
        step, pose = self._speed * self._period, self.pose
        self.pose = ToolPose(
            pose.time + self._period, pose.position + step[:3], pose.angle + float(step[3])
        )


Item = TypeVar("Item")


class TimestampedExposure(NamedTuple, Generic[Item]):
    """An exposure with its reported timestamp [s]."""

    stamp: float
    item: Item


class ImageQueue(Generic[Item]):
    """Queue of exposures in transit from the camera to the reader."""

    def __init__(self, truth: ClockTruth, rng: np.random.Generator) -> None:
        self._truth, self._rng = truth, rng
        self._under_way: deque[tuple[float, TimestampedExposure[Item]]] = deque()
        self._count = 0

    def due(self, age: float) -> bool:
        """Return whether an image is due at this age of the camera [s], and count it."""
        if age * self._truth.rate < self._count:
            return False
        self._count += 1
        return True

    def expose(self, time: float, item: Item) -> None:
        """Add an exposure at ``time`` [s]; it may be lost in transit."""
        truth = self._truth
        late = max(0.0, truth.latency + truth.jitter * float(self._rng.standard_normal()))
        if self._rng.uniform() < truth.dropped:
            return
        self._under_way.append((time + late, TimestampedExposure(time + truth.stamp, item)))

    def hidden(self, age: float) -> bool:
        """Return whether the tag is covered at this age of the camera [s]."""
        hidden = self._truth.hidden
        return hidden is not None and hidden[0] <= age < hidden[1]

    def arrived(self, time: float) -> TimestampedExposure[Item] | None:
        """Return the next image that has arrived by ``time`` [s]; None without one."""
        if not self._under_way or self._under_way[0][0] > time:
            return None
        return self._under_way.popleft()[1]

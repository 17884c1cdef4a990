"""A weld in the plane of the work: a controller against a world, without images and joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.motion.seam_following import Command, Controller, ToolPose, Touch
from flangeye.types import Floats
from flangeye_emulators.finger.profiler import BeadProfiler
from flangeye_emulators.weld_world.truth import ProfilerTruth, WeldTruth
from flangeye_emulators.weld_world.world import ArmResponse, ImageQueue, Nominal, WeldWorld
from flangeye_plugins.weld.following.follower import Follower


@dataclass(frozen=True, eq=False)
class Trial:
    """What happened.

    Attributes:
        controller: As it ended.
        rows: K cycles as :func:`_row` has them.
        phases: K names.
        length: Length of the true seam [m].
    """

    controller: Controller
    rows: list[dict[str, float]]
    phases: tuple[str, ...]
    length: float

    def column(self, name: str) -> Floats:
        """Return a number of all cycles (K,) by its name."""
        return np.array([row[name] for row in self.rows], dtype=np.float64)

    @property
    def beside(self) -> Floats:
        """(K,) whether the torch was between the ends of the seam, and could weld."""
        s, welds = self.column("torch_s"), np.array(self.phases) != "returning"
        return np.asarray((self.column("arc_on") > 0.0) & welds & (s > 0.0) & (s < self.length))

    @property
    def errors(self) -> Floats:
        """Return the torch's distances (M,) from its target, within the seam's extent [m]."""
        return np.asarray(np.abs(self.column("torch") - self.column("aim"))[self.beside])

    @property
    def bounded(self) -> bool:
        """Whether every one of them was within the controller's bound."""
        return bool((self.errors <= self.column("bound")[self.beside]).all())

    @property
    def share_welded(self) -> float:
        """Share of the true seam on which the torch welded within its bound, ends included.

        Parts that were not welded count as outside the bound.
        """
        s = np.clip(self.column("torch_s"), 0.0, self.length)
        off = np.abs(self.column("torch") - self.column("aim"))
        fine = (self.column("arc_on") > 0.0) & (off <= self.column("bound"))
        ticks = np.linspace(0.0, self.length, 2001)
        welded = np.zeros(len(ticks), dtype=bool)
        for before, here, ok in zip(s[:-1], s[1:], fine[:-1] & fine[1:], strict=True):
            welded |= (ticks >= min(before, here)) & (ticks <= max(before, here)) & ok
        return float(welded.mean())

    @property
    def done(self) -> bool:
        """Whether the weld was reported done."""
        return self.controller.phase == "done"


@dataclass(frozen=True)
class Start:
    """Start and timing of a trial.

    Attributes:
        position: (3,) reported position of the undeformed tip [m].
        angle: Angle of the tool [rad].
        period: Period of a cycle [s].
        longest: Time limit [s].
        look: Profile sensor behind the torch; None without one.
    """

    position: tuple[float, float, float]
    angle: float = 0.0
    period: float = 8e-3
    longest: float = 240.0
    look: ProfilerTruth | None = None


def run_trial(
    controller: Controller, nominal: Nominal, truth: WeldTruth, start: Start, seed: int
) -> Trial:
    """Run a controller in a simulated world, and record the true torch."""
    world = WeldWorld(nominal, truth, [seed, 0])
    rng = np.random.default_rng([seed, 1])
    shutter: ImageQueue[Floats] = ImageQueue(truth.clock, rng)
    pose = ToolPose(1.0, np.asarray(start.position, dtype=np.float64), start.angle)
    arm = ArmResponse(truth.arm, pose, start.period)
    noise = truth.finger.noise * np.array([1.0, 1.0, 6.0])
    look = (
        None if start.look is None else BeadProfiler(start.look, np.random.default_rng([seed, 2]))
    )
    rows: list[dict[str, float]] = []
    phases: list[str] = []
    while arm.pose.time < start.longest and controller.phase not in ("done", "stopped"):
        age = arm.pose.time - pose.time
        shown = world.settle(arm.pose)
        if shutter.due(age) and not shutter.hidden(age):
            shutter.expose(arm.pose.time, shown + noise * rng.standard_normal(3))
        seen = shutter.arrived(arm.pose.time)
        if look is not None and isinstance(controller, Follower):
            look.watch(arm.pose.time, world)
            if (profile := look.profile(arm.pose.time)) is not None:
                controller.looked(profile)
        command = controller.step(arm.pose, [Touch(*seen)] if seen else [])
        rows.append(_row(world, arm.pose, controller, command))
        phases.append(controller.phase)
        arm.go(command)
    return Trial(controller, rows, tuple(phases), world.groove.root.length)


def _row(
    world: WeldWorld, pose: ToolPose, controller: Controller, command: Command
) -> dict[str, float]:
    """Return one cycle; lengths [m], angles [rad], times [s]. Offsets are to the seam's left."""
    root, s = world.groove.root, world.contact.s
    place = root.at(s)
    return {
        "time": pose.time,
        # Arc lengths on the true seam, and true offsets, of torch, tip and reported end point
        "torch_s": world.torch_s,
        "torch": world.off,
        "tip_s": s,
        "tip": float((world.tip[:2] - place.point) @ place.normal),
        "robot": float((pose.position[:2] - place.point) @ place.normal),
        # What the controller commands, and states: the tip's progress, the torch's bound, the bound
        # that holds for 95 % of the seam, its target, and 1 once the torch could weld
        "turn": command.turn,
        "advance": controller.tip,
        "bound": controller.bound,
        "band": controller.band,
        "aim": getattr(controller, "aim", 0.0),
        "arc_on": getattr(controller, "arc_from", 0.0) is not None,
    }

"""Following by touch: one step each cycle, measurements in, velocities out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flangeye.devices import WeldProfile
from flangeye.motion.arc import OFF
from flangeye.motion.seam_following import STILL, Command, Phase, ToolPose, Touch
from flangeye.types import Floats
from flangeye_plugins.weld.following.belief import Learned
from flangeye_plugins.weld.following.contact import LOST, STRAINED, STRIDE
from flangeye_plugins.weld.following.response import Response
from flangeye_plugins.weld.following.sensing import SeamEstimate, SeamReading, Sensing
from flangeye_plugins.weld.following.steering import SLOWEST, TorchLead
from flangeye_plugins.weld.following.task import ResumePoint, WeldTask
from flangeye_plugins.weld.following.tip import Pressing, Progress, within
from flangeye_plugins.weld.following.welding import Welding
from flangeye_plugins.weld.settings import INSIDE

WAITING = 0.2
"""Minimum speed fraction, so that a wall that has ended is noticed."""


class Follower:
    """Follows a seam by touch; see :class:`flangeye.motion.seam_following.Controller`.

    Attributes:
        phase: Present phase.
        reason: Why it stopped.
        task: The seam to follow.
        progress: Progress of tip and torch.
        pressing: Pressing force of the tip.
        sensing: Measurements of the finger.
        seam: Estimate of the seam.
        lead: Motion of the torch along the seam.
        welding: Uncertainty of the torch, and whether it welds.
        arm: Delay of the arm.
        now: The time [s]; None before the first cycle.
    """

    def __init__(self, task: WeldTask) -> None:
        """Prepare to follow a seam."""
        self.phase: Phase = "seeking" if task.touch else "following"
        self.reason, self.task = "", task
        self.progress, self.pressing = Progress(task), Pressing(task)
        self.sensing = Sensing(task, self.progress, self.pressing)
        self.seam, self.lead, self.arm = SeamEstimate(task), TorchLead(task), Response()
        self.welding = Welding(
            task, self.progress, self.pressing, self.sensing, self.seam, self.lead
        )
        self.now: float | None = None

    def step(self, pose: ToolPose, touches: Sequence[Touch]) -> Command:
        """Return the command for this cycle; ``touches`` are the measurements not yet given."""
        elapsed = self._begin_cycle(pose)
        pose = self.sensing.true(pose)
        self.sensing.watch(pose)
        self.seam.renew(self.torch)
        for touch in touches:
            self._feel(touch)
        coming = self.arm.ahead(pose)
        self._judge(coming)
        waiting = self.phase == "seeking" and self.sensing.search.resting
        if self.phase in ("done", "stopped") or self.sensing.felt is None or waiting:
            return STILL
        silent = self._silence > self.task.settings.still
        elapsed = 0.0 if silent else elapsed  # sweep and ramp wait too
        if self.phase == "probing":
            command = self._probe(pose, elapsed)
        else:
            command = self._lead(pose, coming, elapsed)
        command = STILL if silent else command
        self.arm.record(pose.time, command)
        return command

    def looked(self, profile: WeldProfile) -> None:
        """Process a profile of the bead behind the torch."""
        if self.phase not in ("done", "stopped"):
            self._stop(self.welding.look(profile))

    def kept(self) -> ResumePoint | None:
        """Return the state from which to resume; None before the torch was on the seam."""
        if self.arc_from is None:
            return None
        return ResumePoint(self.seam.refined.samples(), self.torch, self.sensing.learned)

    # --- what others read -------------------------------------------------------------------------

    @property
    def mode(self) -> str:
        """Name shown in messages and reports."""
        return "tactile" if self.task.touch else "vision"

    @property
    def side(self) -> float:
        """The pressed wall, 1 for the left one."""
        return self.pressing.side

    @property
    def tip(self) -> float:
        """Arc length of the tip's progress on the plan [m]."""
        return self.progress.tip

    @property
    def torch(self) -> float:
        """Arc length of the torch's progress [m]."""
        return self.progress.torch

    @property
    def wanted(self) -> float:
        """Deflection asked of the tip at present [m]."""
        return self.pressing.wanted

    @property
    def sigma(self) -> float:
        """Standard deviation of the torch's place across the seam [m]."""
        return self.welding.sigma

    @property
    def bound(self) -> float:
        """Upper bound of the torch's distance from the seam [m]."""
        return self.welding.bound

    @property
    def band(self) -> float:
        """The bound that holds for 95 % of the seam [m]."""
        return self.welding.band

    @property
    def aim(self) -> float:
        """Target of the torch, to the left of the seam [m]."""
        return self.lead.aim

    @property
    def arc_from(self) -> float | None:
        """Arc length at which the torch first was within ``max_error``, and so may weld [m]."""
        return self.welding.arc_from

    @property
    def arc(self) -> float:
        """Commanded state of the arc: OFF, GAS or BURN of :mod:`flangeye.motion.arc`."""
        over = self.phase in ("done", "stopped") or not self.task.touch
        return OFF if over else self.welding.striking.level(self.now or 0.0)

    # --- what the finger measures -----------------------------------------------------------------

    def _begin_cycle(self, pose: ToolPose) -> float:
        """Take the time; return how much has passed since the last cycle [s]."""
        if self.now is None:
            self.sensing.begin(pose.time)
            self.now = pose.time
        elapsed, self.now = pose.time - self.now, pose.time
        return elapsed

    def _feel(self, touch: Touch) -> None:
        """Take a measurement, with the tool's pose at its image's time; equation (13)."""
        sensing = self.sensing
        taken = sensing.take(touch, self.now or 0.0)
        if taken is None:
            return
        found = sensing.locate(*taken, self.phase)
        if self.phase == "seeking":
            sensing.seek(taken[1], found)
        elif self.phase == "probing":
            sensing.sweep(*taken, found, self.seam.refined.noise)
        else:
            self.seam.weigh(touch.time, found, sensing.learned, self.side)
            if self.phase in ("bridging", "entering"):
                self.seam.contact.forget()
            elif self.seam.contact.free < 0.5:
                sensing.smooth(found.seam, self.seam.refined.noise)
                self._stop(self.seam.moved(found))
            self.seam.keep(touch.time - self.task.settings.sure)

    @property
    def _silence(self) -> float:
        """For how long no image of the tag has come, where one is needed [s]."""
        needed = self.task.touch and self.phase != "ending"
        return self.sensing.silence(self.now or 0.0) if needed else 0.0

    # --- what follows from it ---------------------------------------------------------------------

    def _judge(self, pose: ToolPose) -> None:
        """Change the phase where what was felt asks for it."""
        sensing, pressing = self.sensing, self.pressing
        if self.phase in ("following", "bridging") and self.tip >= pressing.ends:
            self.phase = "ending"
        elif self.phase == "seeking" and sensing.search.seats(pressing.most):
            sensing.probing.begin(float(sensing.search.sigma[1]))
            self.phase = "probing"
        elif self.phase == "probing" and sensing.probing.over:
            self._learn()
        elif self.phase == "entering":
            self._enter(pose)
        elif self.phase == "following" and self._lost():
            self.phase = "bridging"
            pressing.lose(self.tip)
        elif self.phase == "bridging" and self.seam.regained(pressing):
            self.phase = "following"
        elif self.phase == "bridging" and pressing.since_turned(self.tip) > STRIDE:
            pressing.turn_over(self.tip)
        self.seam.leave(self.phase, self.now or 0.0)
        if self.torch >= self.welding.ends and self.phase != "stopped":
            self._finish()
        if self.phase not in ("done", "stopped"):
            self._stop(self._blind(pose))

    def _enter(self, pose: ToolPose) -> None:
        """Begin to follow where the tip rests in the seam again; farther in where it does not."""
        if not self._inside:
            return
        seam, pressing, preload = self.seam, self.pressing, self.task.settings.preload
        if seam.bears and seam.contact.deflection > 0.9 * pressing.most:
            seam.contact.seat(self.sensing.seen, self.wanted, preload)
            self.phase = "following"
            return
        # Images are late: it may rest there already.
        hangs = not seam.bears and seam.contact.compression < preload / 3.0
        fell = seam.lost is not None and hangs and self._over(pose) < -0.9 * preload
        room = pressing.most + pressing.feeler(seam.refined.variance(self.tip))
        aside = self.side * (self.progress.lateral(pose) - seam.refined.offset(self.tip))
        if fell or aside > room:
            seam.start = (seam.start or 0.0) + INSIDE
            if seam.start > self.task.start.tip:
                self._stop("the tip fell off the seam's start and found no way back into it")

    def _lost(self) -> bool:
        """Return whether no wall holds the tip while it follows."""
        contact = self.seam.contact
        if self.seam.backs or not self.task.touch:
            return False
        if self.pressing.slack_for(self.tip, contact.deflection, contact.play) > STRIDE:
            contact.lose()
        return contact.free > LOST

    def _learn(self) -> None:
        """Take over what the sweep found of finger, clock and arm."""
        found = self.sensing.probing.learned()
        if isinstance(found, str):
            self._stop(found)
        elif found is not None:
            scatter = float(self.sensing.search.sigma[1])
            self._follow(replace(found, noise=max(found.noise, scatter)))

    def _follow(self, found: Learned) -> None:
        """Begin to follow with what was found: how the finger shows, how hard to press."""
        sensing, seam, task = self.sensing, self.seam, self.task
        sensing.learned = found
        self.arm.dead_time, self.arm.lag = found.dead_time, found.lag
        self.welding.begin(self.now or 0.0)
        self.pressing.learn(found, seam.stands(found))
        swept = [
            sensing.locate(sensing.true(pose), touch, self.phase)
            for pose, touch in sensing.swept_last()
        ]
        seam.begin(found, float(sensing.search.sigma[2]), swept, self.torch)
        if swept:
            sensing.felt, self.pressing.wanted = swept[-1].seam, swept[-1].deflection
        seam.contact.seat(sensing.seen, self.wanted, task.settings.preload)
        self.phase = "following"
        if task.before is None and task.feels_ends:
            seam.back()

    def _finish(self) -> None:
        """End the weld, if there was one."""
        if self.arc_from is not None and not self.welding.striking.filled(self.now or 0.0):
            return
        if self.task.touch and self.arc_from is None:
            self._stop(f"not begun: {self.welding.too_uncertain(self.bound)}")
        else:
            self.phase = "done"

    def _blind(self, pose: ToolPose) -> str:
        """Return why going on would be blind, or nothing."""
        settings, plan, sensing = self.task.settings, self.task.plan, self.sensing
        # Before the arc burns the arm may stand for longer.
        patience = settings.blind if self.arc_from is not None else 4.0 * settings.blind
        unseen = pose.time - sensing.seen
        if self.task.touch and self.phase != "ending" and unseen > patience:
            return f"no tag was seen for {patience * 1e3:.0f} ms"
        if self.phase == "bridging" and (self.pressing.since_lost(self.tip) > settings.longest_gap):
            return f"no contact for {settings.longest_gap * 1e3:.0f} mm of the seam"
        # There, at 70 % of the radius, all places of a curve are nearly as near.
        if self.phase in ("following", "bridging") and self._aside(pose) > 0.7:
            return (
                f"the plan curves with a radius of {1e3 / abs(plan.bend(self.tip)):.1f} mm "
                "and the arm is off towards its centre: the tip's place along it is not "
                "observable; plan better, or raise 'corner_radius'"
            )
        if sensing.search.bent:
            return "the tip is displaced though nothing should touch it"
        below = self.progress.place.height - float(pose.position[2])
        if self.phase == "seeking" and (sensing.search.over or below > settings.reach):
            return f"no groove within {settings.reach * 1e3:.0f} mm of the plan's start"
        return ""

    def _aside(self, pose: ToolPose) -> float:
        """Return how far the arm is off to the inside of the plan's curve, in radii."""
        place = self.progress.place
        off = float((pose.position[:2] - place.point) @ place.normal)
        return off * self.task.plan.bend(self.tip)

    def _stop(self, reason: str) -> None:
        """Stop for a reason; go on where there is none."""
        if reason:
            self.phase, self.reason = "stopped", reason

    # --- where the tool goes ----------------------------------------------------------------------

    def _probe(self, pose: ToolPose, elapsed: float) -> Command:
        """Return the next piece of the sweep."""
        probing, normal = self.sensing.probing, self.progress.place.normal
        speed, turn = probing.velocity(elapsed)
        slant = float(pose.direction @ normal)
        probing.note(pose.time, speed, self.progress.lateral(pose), slant)
        up = self._rising(pose) if probing.rests else 0.0
        return Command(np.array([*(speed * normal), up]), turn)

    def _lead(self, pose: ToolPose, coming: ToolPose, elapsed: float) -> Command:
        """Return the command that leads the tip along the seam and the torch behind it.

        Args:
            pose: Where the tool is.
            coming: Where it will be when it has carried out all commands sent.
            elapsed: Time since the last cycle [s].
        """
        self.pressing.ramp(self.phase, self._press(), elapsed)
        self._progress(pose, coming)
        point, normal = self.seam.refined.frame(self.progress.coming)
        pace = self._pace(coming, normal)
        if self.seam.backs:
            if self.seam.lost is not None:
                return STILL
            back = 0.0 if self.seam.contact.free > 0.5 else min(pace, self._backwards())
            return Command(self._velocity(coming, -back), 0.0)
        velocity = self._velocity(coming, pace)
        sway = self.lead.swing(coming.time, self.progress.coming, self.arm)
        off = float((self.progress.torch_at(coming) - point) @ normal) + self.welding.bias.value
        self._estimate(pose)
        return Command(velocity, self.lead.turn(velocity[:2], coming, normal, off, sway))

    def _estimate(self, pose: ToolPose) -> None:
        """Judge whether the torch may weld where it is now."""
        reason = self.welding.estimate(pose) if self.task.touch else ""
        if reason and self.welding.complete:
            self._finish()
        else:
            self._stop(reason)

    def _press(self) -> float:
        """Return the deflection that the phase asks for [m]."""
        seeking = self.phase == "seeking" and not self.sensing.search.found
        if self.phase == "ending" or seeking or not self.task.touch:
            return 0.0
        if self.phase == "entering" and not self._inside:
            return 0.0
        if self.phase == "bridging":
            return self.pressing.feeler(self.seam.refined.variance(self.tip))
        return self.pressing.most

    def _progress(self, pose: ToolPose, coming: ToolPose) -> None:
        """Find out how far tip and torch have come."""
        if not self.seam.backs:
            self.progress.advance(pose, coming)
            return
        self.progress.back(pose, coming)
        contact, lost = (
            self.seam.contact,
            self.seam.lost_for(self.now or 0.0) > self.task.settings.sure,
        )
        # Where the joint is felt farther back than the seam may begin, it goes on there.
        on = contact.at < -self.task.beyond - INSIDE and self.seam.bears
        if lost or on:
            self.seam.arrive(self.sensing.learned, self.torch, lost)
            if self.seam.start is not None:
                self.phase, self.pressing.wanted = "entering", 0.0

    def _pace(self, pose: ToolPose, normal: Floats) -> float:
        """Return the tip's speed along the seam: less where blind or crooked."""
        if self.phase == "seeking" or self.welding.striking.stands(pose.time):
            return 0.0
        if self.phase == "entering" and (
            self._inside or self._over(pose) < 0.5 * self.task.settings.over
        ):
            return 0.0
        settings, silence = self.task.settings, self._silence
        sight = 1.0
        if settings.stale < silence <= settings.still:
            sight = (settings.still - silence) / (settings.still - settings.stale)
        speed = min(settings.speed, self._agility())
        along = self.progress.place.tangent
        steered = self.lead.steering.pace(speed, pose.direction, normal, along)
        return steered * sight * self._firmness()

    @property
    def _delay(self) -> float:
        """Of images and arm together [s]."""
        return self.sensing.latency + self.arm.delay

    def _agility(self) -> float:
        """Return the speed at which the arm swerves little in the time in which it is blind.

        During the delay of images and arm together it goes on straight where the seam curves.
        """
        # The tip slows down 10 mm before a curve.
        sharpest = self.task.plan.sharpest(self.torch, self.tip + 10e-3)
        if self._delay <= 0.0 or sharpest <= 0.0:
            return math.inf
        # The arm may swerve from it by 0.3 mm, s = v^2 t^2 k / 2.
        swerving = math.sqrt(2.0 * 0.3e-3 / sharpest) / self._delay
        return max(swerving, SLOWEST * self.task.settings.speed)

    def _backwards(self) -> float:
        """Return the speed at which the tip goes back, so as not to go far beyond the start."""
        return INSIDE / max(2.0 * self._delay, self.task.settings.sure)

    def _firmness(self) -> float:
        """Return the share of its speed that the tip may keep by how firmly it is on the wall.

        Where the seam turns away faster than the servo follows, the tip waits for it.
        """
        if self.phase == "bridging" and self.task.belief.two_walls:
            return WAITING
        if self.phase not in ("following", "ending") or not self.task.touch:
            return 1.0
        contact = self.seam.contact
        # The tip slows down below 70 % of the wanted deflection.
        firm = contact.deflection / (0.7 * max(self.wanted, self.task.settings.probe))
        held = (STRAINED - contact.strained) / 0.4
        firm = held if self.phase == "ending" else min(firm, held)
        return min(max(firm, WAITING), 1.0)

    def _velocity(self, pose: ToolPose, pace: float) -> Floats:
        """Return V_r (3,): along the plan; the servo (14) across it and in height."""
        settings, place, felt = self.task.settings, self.progress.place, self._seam_at_tip()
        lateral = self.progress.lateral(pose)
        deflection = self.side * (lateral - felt.offset)
        if self.phase == "entering" and self._inside and self.seam.bears:
            deflection = self.seam.contact.deflection
        most = settings.lateral_speed
        # Equation (14): pressed too hard the end point gives way, too softly it goes on to the wall
        across = -self.side * settings.servo_gain * (deflection - self.wanted)
        search = self.sensing.search
        if self.phase == "seeking" and not search.found:
            across = settings.servo_gain * search.step(lateral)
        # The seam's known slope is fed forward: the servo has only what it is wrong by
        across += pace * self._drifting()
        planar = pace * place.tangent + within(across, most) * place.normal
        climb = pace * self.task.plan.climb(self.tip)
        return np.array([*planar, climb + self._rising(pose)])

    def _rising(self, pose: ToolPose) -> float:
        """Return how fast to go up for the preload to be right [m/s]."""
        settings = self.task.settings
        preload = settings.preload if self.task.touch else 0.0
        if self.phase == "entering" and not self._inside:
            preload = -settings.over
        return within(-settings.height_gain * (self._over(pose) + preload), settings.lateral_speed)

    def _over(self, pose: ToolPose) -> float:
        """Return how far above a seated tip the end point is [m]."""
        return float(pose.position[2]) - self.progress.place.height - self._seam_at_tip().height

    @property
    def _inside(self) -> bool:
        """Whether the tip is back in the seam beyond the start that it has felt."""
        return self.tip >= (self.seam.start or 0.0) + INSIDE

    def _drifting(self) -> float:
        """Return the slope of the seam against the plan at the tip, positive to the left."""
        refined = self.seam.refined
        if self.phase != "following" or refined.empty or self.seam.backs:
            return 0.0
        return within(refined.slope(self.tip), 1.0)

    def _seam_at_tip(self) -> SeamReading:
        """Return the seam at the tip: as felt, or as predicted while nothing is felt."""
        felt = self.sensing.felt
        if felt is None:
            return SeamReading(0.0, 0.0)
        seam = self.seam
        if self.phase in ("entering", "bridging", "ending") and not seam.refined.empty:
            # What was smoothed while the tip fell off the start is too low.
            height = seam.height if self.phase == "entering" else felt.height
            return SeamReading(seam.refined.offset(self.tip), height)
        return felt

"""Controller that follows a seam by touch: measurements in, velocities out, once each cycle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flangeye.devices import WeldProfile
from flangeye.motion.arc import OFF
from flangeye.motion.seam_following import STILL, Command, Phase, ToolPose, Touch
from flangeye.types import Floats
from flangeye_plugins.weld.following.contact import (
    LOSS_PROBABILITY,
    STRAINED,
    STRIDE,
    SeamReading,
)
from flangeye_plugins.weld.following.model_prior import SweepFit
from flangeye_plugins.weld.following.response import Response
from flangeye_plugins.weld.following.sensing import SeamEstimate, Sensing
from flangeye_plugins.weld.following.steering import SLOWEST, TorchLead
from flangeye_plugins.weld.following.task import ResumePoint, WeldTask
from flangeye_plugins.weld.following.tip import DeflectionTarget, SeamProgress, within
from flangeye_plugins.weld.following.welding import Welding
from flangeye_plugins.weld.settings import INSIDE

WAITING = 0.2
"""Share of its speed at which the tip seeks a lost wall."""


class Follower:
    """Follows a seam by touch; see :class:`flangeye.motion.seam_following.Controller`.

    Attributes:
        phase: Present phase of the weld.
        reason: Why the weld stopped; "" unless it did.
        task: The seam to follow.
        progress: Progress of tip and torch.
        pressing: Deflection by which the tip is pressed against its wall.
        sensing: Measurements of the finger.
        seam: Estimate of the seam.
        lead: Steering of the torch along the seam.
        welding: Error bound of the torch, and whether it may weld.
        arm: Model of the arm's delay.
        now: Time of the present cycle [s]; None before the first.
    """

    def __init__(self, task: WeldTask) -> None:
        """Prepare to follow a seam."""
        self.phase: Phase = "seeking" if task.touch else "following"
        self.reason, self.task = "", task
        self.progress, self.pressing = SeamProgress(task), DeflectionTarget(task)
        self.sensing = Sensing(task, self.progress, self.pressing)
        self.seam, self.lead, self.arm = SeamEstimate(task), TorchLead(task), Response()
        self.welding = Welding(
            task, self.progress, self.pressing, self.sensing, self.seam, self.lead
        )
        self.now: float | None = None

    def step(self, pose: ToolPose, touches: Sequence[Touch]) -> Command:
        """Return the command for this cycle, given the measurements since the last one."""
        elapsed = self._begin_cycle(pose)
        pose = self.sensing.true(pose)
        self.sensing.track.add(pose)
        if not self.seam.backs:
            self.seam.refined.renew(self.torch)
        for touch in touches:
            self._feel(touch)
        coming = self.arm.ahead(pose)
        self._judge(pose, coming)
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
        """Name of the mode in messages and reports."""
        return "tactile" if self.task.touch else "vision"

    @property
    def side(self) -> float:
        """Side of the pressed wall: 1 left, -1 right."""
        return self.pressing.side

    @property
    def tip(self) -> float:
        """Position of the tip, as arc length of the plan [m]."""
        return self.progress.tip

    @property
    def torch(self) -> float:
        """Position of the torch, as arc length of the plan [m]."""
        return self.progress.torch

    @property
    def wanted(self) -> float:
        """Present set point of the tip's deflection [m]."""
        return self.pressing.wanted

    @property
    def sigma(self) -> float:
        """Standard deviation of the torch's position across the seam [m]."""
        return self.welding.sigma

    @property
    def bound(self) -> float:
        """Upper bound of the torch's distance from the seam [m]."""
        return self.welding.bound

    @property
    def band(self) -> float:
        """Bound of the torch's distance that holds for 95 % of the seam [m]."""
        return self.welding.band

    @property
    def aim(self) -> float:
        """Target position of the torch, to the left of the seam [m]."""
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
        """Store the cycle's time; return the time since the last cycle [s]."""
        if self.now is None:
            self.now = self.sensing.seen = self.sensing.heard = pose.time
        elapsed, self.now = pose.time - self.now, pose.time
        return elapsed

    def _feel(self, touch: Touch) -> None:
        """Process a measurement, with the tool's pose at its image's time (equation 13)."""
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
            self.seam.weigh(found, sensing.learned, self.side)
            if self.phase in ("bridging", "entering"):
                self.seam.contact.forget()
            elif self.seam.contact.free < 0.5:
                sensing.smooth(found.seam, self.seam.refined.noise)
                self._stop(self.seam.moved(found))
            sure = touch.time - self.task.settings.sure
            # What is felt while the tip may have lost its wall waits until a wall holds it again.
            waits = self.phase == "following" and not self.seam.backs
            self.seam.keep(min(sure, self.pressing.firm) if waits else sure)

    @property
    def _silence(self) -> float:
        """Time since the last image of the tag [s]; 0 in a phase that needs none."""
        needed = self.task.touch and self.phase != "ending"
        return (self.now or 0.0) - self.sensing.heard if needed else 0.0

    # --- what follows from it ---------------------------------------------------------------------

    def _judge(self, pose: ToolPose, coming: ToolPose) -> None:
        """Change the phase of the weld according to the measurements."""
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
            self.phase, pressing.firm = "following", sensing.seen
        elif self.phase == "bridging" and self.tip - pressing.turned > STRIDE:
            pressing.turn_over(self.tip)
        self.seam.leave(self.phase)
        if self.torch >= self.welding.ends and self.phase != "stopped":
            self._finish()
        if self.phase not in ("done", "stopped"):
            self._stop(self._blind(coming))

    def _enter(self, pose: ToolPose) -> None:
        """Start to follow once the tip, set down inside the seam's start, is seated.

        If the tip finds no seat there, the start is moved farther into the seam.
        """
        if not self._inside:
            return
        seam, pressing, preload = self.seam, self.pressing, self.task.settings.preload
        if seam.contact.bears and seam.contact.deflection > 0.9 * pressing.most:
            seam.contact.seat(self.sensing.seen, self.wanted, preload)
            self.phase, pressing.firm = "following", self.sensing.seen
            return
        # Images are late: it may rest there already.
        hangs = not seam.contact.bears and seam.contact.compression < preload / 3.0
        fell = hangs and self._over(pose) < -0.9 * preload
        room = pressing.most + pressing.feeler(seam.refined.variance(self.tip))
        aside = self.side * (self.progress.lateral(pose) - seam.refined.offset(self.tip))
        if fell or aside > room:
            seam.start = (seam.start or 0.0) + INSIDE
            if seam.start > self.task.start.tip:
                self._stop("the tip fell off the seam's start and found no way back into it")

    def _lost(self) -> bool:
        """Return whether the tip has lost its wall."""
        contact = self.seam.contact
        if self.seam.backs or not self.task.touch:
            return False
        doubt = self.pressing.doubt(contact.deflection, contact.play, self.sensing.seen)
        # A tip that waits for its wall feels it within three time constants of the servo.
        if doubt > 3.0 / self.task.settings.servo_gain + self._delay:
            contact.lose()
        return contact.free > LOSS_PROBABILITY

    def _learn(self) -> None:
        """Evaluate the sweep: start to follow, stop, or let the sweep repeat."""
        found = self.sensing.probing.learned()
        if isinstance(found, str):
            self._stop(found)
        elif found is not None:
            scatter = float(self.sensing.search.sigma[1])
            self._follow(replace(found, noise=max(found.noise, scatter)))

    def _follow(self, found: SweepFit) -> None:
        """Start to follow with the sweep's calibration."""
        sensing, seam, task = self.sensing, self.seam, self.task
        sensing.learned = found
        self.arm.dead_time, self.arm.lag = found.dead_time, found.lag
        self.pressing.learn(found, seam.stands(found))
        self.welding.swept = self.now or 0.0
        swept = [
            sensing.locate(sensing.true(pose), touch, self.phase) for pose, touch in sensing.swept
        ]
        seam.begin(found, float(sensing.search.sigma[2]), swept, self.torch)
        if swept:
            sensing.felt, self.pressing.wanted = swept[-1].seam, swept[-1].deflection
        seam.contact.seat(sensing.seen, self.wanted, task.settings.preload)
        self.phase, self.pressing.firm = "following", sensing.seen
        if task.before is None and task.feels_ends:
            seam.back()

    def _finish(self) -> None:
        """End the weld: fill the crater, then set the phase."""
        if self.arc_from is not None and not self.welding.striking.filled(self.now or 0.0):
            return
        if self.task.touch and self.arc_from is None:
            self._stop(f"not begun: {self.welding.too_uncertain(self.bound)}")
        else:
            self.phase = "done"

    def _blind(self, pose: ToolPose) -> str:
        """Return the reason why measurements no longer allow welding; "" if they do."""
        settings, plan, sensing = self.task.settings, self.task.plan, self.sensing
        # Before the arc burns the arm may stand for longer.
        patience = settings.blind if self.arc_from is not None else 4.0 * settings.blind
        unseen = pose.time - sensing.seen
        if self.task.touch and self.phase != "ending" and unseen > patience:
            return f"no tag was seen for {patience * 1e3:.0f} ms"
        if self.phase == "bridging" and self.tip - self.pressing.lost > settings.longest_gap:
            return f"no contact for {settings.longest_gap * 1e3:.0f} mm of the seam"
        # There, at 70 % of the radius, all places of a curve are nearly as near.
        if self.phase in ("following", "bridging") and self._aside(pose) > 0.7:
            return (
                f"the plan curves with a radius of {1e3 / abs(plan.bend(self.tip)):.1f} mm "
                "and the arm is off towards its centre: the tip's position along the seam is not "
                "observable; plan the seam more accurately, or raise 'corner_radius'"
            )
        if sensing.search.bent:
            return "the tip is displaced though nothing should touch it"
        below = self.progress.place.height - float(pose.position[2])
        missed = self.phase == "seeking" and (sensing.search.over or below > settings.reach)
        # On the plate beside its groove friction may hold a tip as two walls do.
        high = sensing.felt is not None and sensing.felt.height > settings.reach
        if missed or (self.phase == "probing" and high):
            return f"no groove within {settings.reach * 1e3:.0f} mm of the plan's start"
        return ""

    def _aside(self, pose: ToolPose) -> float:
        """Return the arm's offset towards the plan's centre of curvature, over the radius."""
        place = self.progress.place
        off = float((pose.position[:2] - place.point) @ place.normal)
        return off * self.task.plan.bend(self.tip)

    def _stop(self, reason: str) -> None:
        """Stop if there is a reason."""
        if reason:
            self.phase, self.reason = "stopped", reason

    # --- where the tool goes ----------------------------------------------------------------------

    def _probe(self, pose: ToolPose, elapsed: float) -> Command:
        """Return the command of the sweep for this cycle."""
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
            coming: Where the tool will be when it has carried out all commands sent.
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
        """Update the torch's error bound; stop if the torch may not weld on."""
        reason = self.welding.estimate(pose) if self.task.touch else ""
        if reason and self.welding.complete:
            self._finish()
        else:
            self._stop(reason)

    def _press(self) -> float:
        """Return the phase's set point of the deflection [m]."""
        seeking = self.phase == "seeking" and not self.sensing.search.found
        if self.phase == "ending" or seeking or not self.task.touch:
            return 0.0
        if self.phase == "entering" and not self._inside:
            return 0.0
        if self.phase == "bridging":
            return self.pressing.feeler(self.seam.refined.variance(self.tip))
        return self.pressing.most

    def _progress(self, pose: ToolPose, coming: ToolPose) -> None:
        """Update the positions of tip and torch along the plan."""
        if not self.seam.backs:
            self.progress.advance(pose, coming)
            return
        self.progress.back(pose, coming)
        contact = self.seam.contact
        since = self.seam.lost
        lost = since is not None and (self.now or 0.0) - since > self.task.settings.sure
        # Where the joint is felt farther back than the seam may begin, it goes on there.
        on = contact.at < -self.task.beyond - INSIDE and contact.bears
        if lost or on:
            self.seam.arrive(self.sensing.learned, self.torch, lost)
            if self.seam.start is not None:
                self.phase, self.pressing.wanted = "entering", 0.0

    def _pace(self, pose: ToolPose, normal: Floats) -> float:
        """Return the tip's speed along the seam [m/s].

        It is reduced while images are late, the tool is at a large angle to the seam, the seam is
        curved or the tip is pressed weakly.
        """
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
        ease = min(max(self.welding.ease, SLOWEST), 1.0)
        return steered * sight * min(self._firmness(), ease)

    @property
    def _delay(self) -> float:
        """Delay of images and arm together [s]."""
        return self.sensing.latency + self.arm.delay

    def _agility(self) -> float:
        """Return the speed at which the delay causes a small error in a curve [m/s].

        During the delay of images and arm the tip goes on straight while the seam curves.
        """
        # The tip slows down 10 mm before a curve.
        sharpest = self.task.plan.sharpest(self.torch, self.tip + 10e-3)
        if self._delay <= 0.0 or sharpest <= 0.0:
            return math.inf
        # Going straight for a time t leaves a curve of curvature k by v^2 t^2 k / 2: 0.3 mm are
        # allowed
        swerving = math.sqrt(2.0 * 0.3e-3 / sharpest) / self._delay
        return max(swerving, SLOWEST * self.task.settings.speed)

    def _backwards(self) -> float:
        """Return the speed for going back to the start without overrunning it far [m/s]."""
        return INSIDE / max(2.0 * self._delay, self.task.settings.sure)

    def _firmness(self) -> float:
        """Return the share of its speed that the tip may keep, given how firmly it is pressed.

        The tip slows down where the seam turns away faster than the deflection servo follows.
        """
        if self.phase == "bridging" and self.task.prior.two_walls:
            return WAITING
        if self.phase not in ("following", "ending") or not self.task.touch:
            return 1.0
        contact = self.seam.contact
        # Full speed at 70 % of the wanted deflection; at half of it the wall is in doubt.
        wanted = max(self.wanted - contact.play, self.task.settings.probe)
        firm = (contact.deflection - contact.play) / wanted / 0.2 - 2.5
        held = (STRAINED - contact.strained) / 0.4
        firm = held if self.phase == "ending" else min(firm, held)
        return min(max(firm, SLOWEST), 1.0)

    def _velocity(self, pose: ToolPose, pace: float) -> Floats:
        """Return the velocity V_r of the end point (3,) [m/s].

        Along the plan it is ``pace``; across the plan and in height it is set by the servos,
        equation (14) of the paper.
        """
        settings, place, felt = self.task.settings, self.progress.place, self._seam_at_tip()
        lateral = self.progress.lateral(pose)
        deflection = self.side * (lateral - felt.offset)
        if self.phase == "entering" and self._inside and self.seam.contact.bears:
            deflection = self.seam.contact.deflection
        most = settings.lateral_speed
        # Equation (14): pressed too hard the end point backs off, too softly it approaches the wall
        across = -self.side * settings.servo_gain * (deflection - self.wanted)
        search = self.sensing.search
        if self.phase == "seeking" and not search.found:
            across = settings.servo_gain * search.step(lateral)
        # The seam's known slope is fed forward: the servo corrects only the error of that slope
        across += pace * self._drifting()
        planar = pace * place.tangent + within(across, most) * place.normal
        climb = pace * self.task.plan.climb(self.tip)
        return np.array([*planar, climb + self._rising(pose)])

    def _rising(self, pose: ToolPose) -> float:
        """Return the upward speed that regulates the preload [m/s]."""
        settings = self.task.settings
        preload = settings.preload if self.task.touch else 0.0
        if self.phase == "entering" and not self._inside:
            preload = -settings.over
        return within(-settings.height_gain * (self._over(pose) + preload), settings.lateral_speed)

    def _over(self, pose: ToolPose) -> float:
        """Return the height of the end point above that of a seated tip [m]."""
        return float(pose.position[2]) - self.progress.place.height - self._seam_at_tip().height

    @property
    def _inside(self) -> bool:
        """Whether the tip is past the felt start of the seam by a safe distance."""
        return self.tip >= (self.seam.start or 0.0) + INSIDE

    def _drifting(self) -> float:
        """Return the slope of the seam relative to the plan at the tip, positive to the left."""
        refined = self.seam.refined
        if self.phase != "following" or refined.empty or self.seam.backs:
            return 0.0
        return within(refined.slope(self.tip), 1.0)

    def _seam_at_tip(self) -> SeamReading:
        """Return the seam at the tip: measured in contact, otherwise predicted."""
        felt = self.sensing.felt
        if felt is None:
            return SeamReading(0.0, 0.0)
        seam = self.seam
        if self.phase in ("entering", "bridging", "ending") and not seam.refined.empty:
            # The smoothed height is too low after the tip fell off the start.
            height = seam.height if self.phase == "entering" else felt.height
            return SeamReading(seam.refined.offset(self.tip), height)
        return felt

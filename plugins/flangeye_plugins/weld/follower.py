"""Following by touch: one step each cycle, measurements in, velocities out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from flangeye.devices import WeldProfile
from flangeye.motion.arc import OFF
from flangeye.motion.seam_following import STILL, Command, Phase, ToolPose, Touch, turned
from flangeye.types import Floats
from flangeye_plugins.weld.belief import BAND, Belief
from flangeye_plugins.weld.bias import Bias, Trail
from flangeye_plugins.weld.contact import STRAINED, STRIDE, Contact, Felt
from flangeye_plugins.weld.motion import SeamReading, Track
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.probing import SOFTER, SWEEP_MARGIN, Learned, Probing
from flangeye_plugins.weld.refined import RefinedPath
from flangeye_plugins.weld.response import Response
from flangeye_plugins.weld.search import SweepSearch
from flangeye_plugins.weld.settings import INSIDE, Following
from flangeye_plugins.weld.steering import SLOWEST, Steering
from flangeye_plugins.weld.striking import Striking
from flangeye_plugins.weld.weave import Sway, Weave

SETTLING = 8e-3
"""Way in which an error of the torch is taken back at speed [m]."""

SHORT = 0.01
"""A weld is done where no larger share of the planned seam was left out."""

STEADY = 0.03e-3
"""A finger that scatters less is followed from one measurement to the next [m]."""

LOST = 0.9
"""A wall is lost where the tip is as likely free, and held again where it is as likely not."""

WAITING = 0.2
"""Share of its speed that it keeps all the same: a wall that has ended is found out by going on."""

COMPARED = 15
"""Measurements that tell whether the seam has moved since the weld was stopped."""


@dataclass(frozen=True, eq=False)
class ResumePoint:
    """State of a stopped weld from which it is resumed.

    Attributes:
        samples: (K, 5) what was felt; see :meth:`RefinedPath.samples`.
        torch: Arc length of the torch's progress [m].
        learned: What the sweep found.
        traced: (K, 3) how high the tool was, where there are later passes; see ``passes.Traced``.
        number: Which pass was stopped, the root's is 0.
    """

    samples: Floats
    torch: float
    learned: Learned = field(default_factory=Learned)
    traced: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    number: int = 0


class Follower:
    """Follows a seam by touch.

    Attributes:
        mode: Its name, for people.
        phase: What it is doing.
        reason: Why it stopped.
        tip: Arc length of the tip's progress on the plan [m].
        torch: Arc length of the torch's progress [m].
        wanted: Deflection asked of the tip at present [m].
        refined: The seam as felt so far.
        contact: The state of the tip's contact.
        learned: What the sweep at the start found of finger, clock and arm.
        sigma: Standard deviation of the torch's place across the seam [m].
        bound: What the torch's distance from the seam does not exceed [m].
        band: The same for 95 % of the seam [m].
        aim: How far to the left of the seam the torch is to be [m].
        lit: Where the torch first was within ``max_error``, and so may weld, by arc length [m].
        bias: What a look behind the torch says of errors that nothing else measures.
    """

    def __init__(
        self,
        plan: Path,
        belief: Belief,
        settings: Following,
        touch: bool = True,
        before: ResumePoint | None = None,
    ) -> None:
        """Prepare to follow ``plan``.

        Args:
            plan: The planned seam.
            belief: What is known of tool, finger and joint.
            settings: Gains and limits.
            touch: Follow by touch; otherwise the plan alone, for comparison.
            before: What an earlier weld has left that is gone on with.
        """
        self.mode: str = "tactile" if touch else "vision"
        self.phase: Phase = "seeking" if touch else "following"
        self.reason = ""
        self.tip, self.torch = settings.set_down, settings.set_down - belief.distance
        self._coming, self.wanted = self.torch, 0.0
        self._margin = belief.distance + settings.ending + (settings.ends or 0.0)
        self.refined = RefinedPath(plan, self._margin, settings.wander)
        self._before = before
        if before is not None:
            self.refined.recall(before.samples)
        self._moved: list[float] = []
        self.contact = Contact(
            belief.flat(settings.sign), belief.sliding(settings) / SOFTER, belief.noise
        )
        softer = settings.probing and belief.two_walls  # the sweep tells how much the tip stands
        self._press = settings.deflection / (SOFTER if softer else 1.0)
        self._plan, self._settings, self._touching = plan, settings, touch
        gain = max(settings.cross_track_gain, settings.speed / SETTLING)
        self._steering = Steering(belief.distance, gain, settings.turn_rate)
        self._belief = belief
        self.learned = Learned(ahead=belief.ahead, ahead_sigma=belief.ahead_known)
        self.bias, self._trail, self._striking = (
            _bias_of(belief, settings), Trail(), Striking(belief.arc)
        )  # fmt: skip
        self.sigma = self.bound = self.band = self._elapsed = self._began = 0.0
        self.aim = self._offset = settings.offset_across
        self._weave = Weave(settings.weave_width, settings.weave_frequency)
        self._swings: float | None = None
        self.lit: float | None = None
        self.side = settings.sign
        self._track = Track()
        self._felt: SeamReading | None = None if touch else SeamReading(0.0, 0.0)
        self._time: float | None = None
        self._seen = self._heard = self._bridge = self._tried = self._latency = 0.0
        self._place = plan.at(self.tip)
        self._search = SweepSearch(settings, belief)
        self._probing = Probing(settings, belief, self.side)
        self._level = np.array(belief.level_R_tool)
        self._response = Response()
        self._backed: list[tuple[float, float, float, float]] | None = None
        self._swept: list[tuple[ToolPose, Touch]] = []
        self._sat: list[tuple[float, float, float, float]] = []

    @property
    def begins(self) -> float:
        """Where the torch is to begin to weld, by arc length [m]."""
        after = self._settings.offset_along
        return after if after > 0.0 else -self._beyond

    @property
    def ends(self) -> float:
        """Where the torch is to end, by arc length [m]."""
        return self._plan.length + self._beyond

    @property
    def _beyond(self) -> float:
        """How far beyond the planned ends the seam may be [m]."""
        return self._settings.ends or 0.0

    @property
    def arc(self) -> float:
        """What the arc is to do: OFF, GAS or BURN of :mod:`flangeye.motion.arc`."""
        over = self.phase in ("done", "stopped") or not self._touching
        return OFF if over else self._striking.level(self._time or 0.0)

    @property
    def share_fixed(self) -> float:
        """Share of the torch's variance that a look behind it alone could lessen."""
        fixed = self.bias.variance(self.torch) if self.bias.looked else self.bias.prior
        return fixed / max(self.sigma**2, fixed)

    @property
    def share_welded(self) -> float:
        """Share of the planned seam that was welded with the torch within ``max_error``."""
        if self.lit is None:
            return 0.0
        return max(min(self.torch, self.ends) - self.lit, 0.0) / (self.ends - self.begins)

    def kept(self) -> ResumePoint | None:
        """Return the state from which to resume; None before the torch was on the seam."""
        if self.lit is None:
            return None
        return ResumePoint(self.refined.samples(), self.torch, self.learned)

    def step(self, pose: ToolPose, touches: Sequence[Touch]) -> Command:
        """Return the command for this cycle; ``touches`` are the measurements not yet given."""
        if self._time is None:
            self._time = self._seen = self._heard = pose.time
        self._elapsed, self._time = pose.time - self._time, pose.time
        pose = self._true(pose)
        self._track.add(pose)
        if self._backed is None:
            self.refined.renew(self.torch)
        for touch in touches:
            if self._touching and touch.time > self._seen:
                self._feel(Touch(touch.time, self._level @ touch.displacement))
        coming = self._response.ahead(pose)
        self._judge(coming)
        waiting = self.phase == "seeking" and self._search.resting
        if self.phase in ("done", "stopped") or self._felt is None or waiting:
            return STILL
        silent = self._silence(pose.time) > self._settings.still
        if silent:  # sweep and ramp wait too
            self._elapsed = 0.0
        command = self._probe(pose) if self.phase == "probing" else self._lead(pose, coming)
        command = STILL if silent else command
        self._response.record(pose.time, command)
        return command

    def _lead(self, pose: ToolPose, coming: ToolPose) -> Command:
        """Return the command that leads the tip along the seam and the torch behind it.

        Args:
            pose: Where the tool is.
            coming: Where it will be when it has done all it was told.
        """
        self._ramp(self._elapsed)
        self._progress(pose, coming)
        point, normal = self.refined.frame(self._coming)
        pace = self._pace(coming, normal)
        if self._backed is not None:
            return Command(self._velocity(coming, -min(pace, self._backwards())), 0.0)
        velocity = self._velocity(coming, pace)
        sway = self._swayed(coming.time)
        there = float((self._torch_position(coming) - point) @ normal)
        error = there - (self._offset - self.bias.value) - sway.aside
        self._estimate(pose)
        turn = self._steering.turn(velocity[:2], coming.direction, normal, error, sway.rate)
        return Command(velocity, turn if velocity[:2].any() else 0.0)

    def _swayed(self, now: float) -> Sway:
        """Return the weave to command, ahead by the arm's delay; set ``aim`` to the one due now."""
        dead, lag = self._response.dead_time, self._response.lag
        if self._swings is None and self._coming >= max(self._settings.offset_along, 0.0):
            self._swings = now + dead
        elapsed = -1.0 if self._swings is None else now - self._swings
        self.aim = self._offset + self._weave.at(elapsed).aside
        return self._weave.at(elapsed + dead).led(lag)

    def _probe(self, pose: ToolPose) -> Command:
        """Return the next piece of the sweep."""
        speed, turn = self._probing.velocity(self._elapsed)
        slant = float(pose.direction @ self._place.normal)
        self._probing.note(pose.time, speed, self._lateral(pose), slant)
        up = self._rising(pose) if self._probing.rests else 0.0
        return Command(np.array([*(speed * self._place.normal), up]), turn)

    def _estimate(self, pose: ToolPose) -> None:
        """Estimate how far the torch may be from the seam now, and stop where that is too far."""
        if not self._touching:
            return
        point, normal = self.refined.frame(self.torch)
        raw = float((self._torch_position(pose) - point) @ normal)
        error = abs(raw - (self.aim - self.bias.value))
        variance = self._variance(float(pose.direction @ normal), pose.angle)
        self.sigma = math.sqrt(variance)
        self.band = error + BAND * self.sigma
        self.bound = error + self._settings.sigmas * self.sigma
        if self.phase in ("seeking", "probing"):
            return
        if self.begins - self.torch <= self._belief.arc[0] * self._settings.speed:
            self._striking.gas(pose.time)
        if not self.begins <= self.torch <= self.ends:
            return
        if self.lit is not None:
            self._trail.pass_by(pose.time, self.torch, raw, variance - self._unseen())
        worst, bound = self.torch, self.bound
        if self.lit is None and bound <= self._settings.max_error:
            worst, bound = self._ahead(variance)
        if bound > self._settings.max_error:
            self._too_far(worst, bound)
        elif self.lit is None:
            self.lit = self.torch
            self._striking.strike(pose.time)

    def _ahead(self, variance: float) -> tuple[float, float]:
        """Return where the seam that was felt is known least, and the torch's bound there [m].

        Args:
            variance: Of the torch's place where it is now [m^2].
        """
        place, felt = self.refined.worst(self.torch, self.ends)
        variance += felt - self.refined.variance(self.torch)
        return place, self._settings.sigmas * math.sqrt(max(variance, 0.0))

    def _too_far(self, place: float, bound: float) -> None:
        """Stop where the torch may be too far from the seam, or may not be lit in time.

        Args:
            place: Where the bound does not hold, by arc length [m].
            bound: The torch's bound there [m].
        """
        late = self.torch - self.begins > SHORT * (self.ends - self.begins)
        if self.lit is not None and self.share_welded >= 1.0 - SHORT:
            self._finish()
        elif self.lit is not None:
            self._stop(self._too_uncertain(bound))
        elif self._before is not None and self.torch > self._before.torch:
            self._stop("the torch was not on the seam again where it had stopped; raise 'overlap'")
        elif self._before is None and late:
            ahead = f" at {place * 1e3:.0f} mm of the seam" if place > self.torch else ""
            self._stop(f"not begun: {self._too_uncertain(bound, ahead)}")

    def _variance(self, slant: float, angle: float) -> float:
        """Return the variance of the torch's place across the seam [m^2].

        Args:
            slant: Sine of the angle between the tool and the path.
            angle: Of the tool [rad].
        """
        settings, learned = self._settings, self.learned
        aged = settings.gain_drift * ((self._time or 0.0) - self._began) / 60.0
        gain = (learned.gain_sigma + aged * (self.phase != "seeking")) * self._press
        fixed = self._unseen() + (self._belief.along_sigma * slant) ** 2
        # What the tip is off by is off for the torch too: all but what the tool has turned between.
        turned_by = angle - self.refined.angle(self.torch, angle)
        ahead = min(learned.ahead_sigma, self._belief.tip_sigma) * math.sin(turned_by)
        tip = ahead**2 + (self._belief.tip_sigma * (1.0 - math.cos(turned_by))) ** 2
        felt = self.refined.variance(self.torch) + self._weave.variance
        return fixed + gain**2 + learned.systematic + tip + felt

    def _unseen(self) -> float:
        """Return the variance of the torch that nothing ahead of it measures [m^2]."""
        if not self.bias.looked:
            return self._belief.fixed_variance(self._settings)
        return self._belief.arm_variance(self._settings) + self.bias.variance(self.torch)

    def looked(self, profile: WeldProfile) -> None:
        """Take in how far the bead lies from the joint, seen behind the torch."""
        torch = self._trail.place_at(profile.time_ns * 1e-9)
        if self._belief.behind is None or torch is None or self.phase in ("done", "stopped"):
            return
        place = torch - self._belief.behind
        passed = self._trail.passing(place)
        if passed is None:
            return
        raw, felt = passed
        others = felt + self._belief.arm_variance(self._settings)
        self.bias.look(place, profile.offset - raw, profile.sigma, others)
        if self.bias.doubt:
            self._stop(self.bias.doubt)

    # --- what the finger says -------------------------------------------------------------------

    def _feel(self, touch: Touch) -> None:
        """Take a measurement, with the pose the tool had when its image was taken (13)."""
        pose = self._track.at(touch.time - self.learned.stamp)
        if pose is None:
            return
        self._seen, self._heard = touch.time, self._time or 0.0
        late = (self._time or 0.0) - touch.time + self.learned.stamp
        # A running mean over some twenty images.
        self._latency += 0.05 * (late - self._latency)
        s, felt, deflection = self._located(pose, touch)
        if self.phase == "seeking":
            self._felt = felt
            compression = float(touch.displacement[2] - self._search.rest[2])
            self._search.feel(touch.displacement, deflection, compression)
        elif self.phase == "probing":
            moved = turned(touch.displacement - self._search.rest, pose.angle)
            along = float(moved[:2] @ self._place.tangent)
            self._felt = self._smoothed(felt)
            self._probing.feel(touch.time, -self.side * deflection, felt.height, along)
            self._swept.append((pose, touch))
        else:
            pressed = deflection, float(self._corrected(touch.displacement)[2])
            self._weigh(touch.time, s, felt, pressed, pose.angle)

    def _true(self, pose: ToolPose) -> ToolPose:
        """Return a pose with the tip as far ahead as the sweep has found it."""
        ahead = self.learned.ahead * np.array([*pose.direction, 0.0])
        return ToolPose(pose.time, pose.position + ahead, pose.angle)

    def _located(self, pose: ToolPose, touch: Touch) -> tuple[float, SeamReading, float]:
        """Return where on the plan the tip is, the seam there, and the deflection to the wall."""
        tip = pose.position + turned(self._corrected(touch.displacement), pose.angle)
        s = self._plan.foot(tip[:2], self.tip)
        place = self._plan.at(s)
        beside = float((tip[:2] - place.point) @ place.normal) - self._belief.beside
        felt = SeamReading(beside, float(tip[2]) - place.height)
        return s, felt, self.side * float((pose.position - tip)[:2] @ place.normal)

    def _corrected(self, displacement: Floats) -> Floats:
        """Return a displacement (3,) without what the finger's rest, gain and play add to it."""
        moved = displacement - self._search.rest
        kept = self.learned.kept * self._pressing()
        play = np.array([0.0, self.side * self.learned.width * kept, 0.0])
        across = 1.0 + self.learned.gain
        # The sweep measures the gain across. That upwards is its like; where it is not, the
        # preload errs towards pressing harder, which holds the tip in its groove.
        gain = np.array([across, across, max(across, 1.0)])
        return np.asarray((moved - play) / gain)

    def _pressing(self) -> float:
        """Return on which side of its play the finger is: 1 pressed, -1 let go of, and between."""
        width = abs(self.learned.width)
        if self.phase != "ending" or not width:
            return 1.0
        return 1.0 - min((self._press - self.wanted) / width, 2.0)

    def _smoothed(self, felt: SeamReading) -> SeamReading:
        """Return a mean over as many measurements as their scatter asks for."""
        before = self._felt
        if before is None:
            return felt
        share = min(1.0, max((STEADY / self.refined.noise) ** 2, 0.1))
        return SeamReading(
            before.offset + share * (felt.offset - before.offset),
            before.height + share * (felt.height - before.height),
        )

    def _weigh(
        self, time: float, s: float, felt: SeamReading, pressed: tuple[float, float], angle: float
    ) -> None:
        """Weigh how the tip touches, and keep what it felt where that is the seam.

        Args:
            time: [s].
            s: Arc length of the tip [m].
            felt: The seam, if the tip is seated.
            pressed: Deflection to the wall and compression [m].
            angle: Of the tool [rad].
        """
        aside = felt.offset - self.refined.offset(s)
        spread = self.refined.variance(s) + self.learned.variance + STEADY**2
        expected = time, s, felt.offset, angle, aside, spread, felt.height
        self.contact.take(Felt(*expected, *pressed), self.side)
        if self.phase == "bridging":
            self.contact.forget()
        elif self.contact.free < 0.5:
            self._felt = self._smoothed(felt)
            self._compare(s, felt.offset)
        # A sample is believed when contact has not been doubted for 0.3 s after it.
        self._keep(time - 0.3)

    def _keep(self, until: float) -> None:
        """Believe what was felt up to a time [s], short of where the seam may end."""
        end = self._plan.length - max(self._settings.ending / 4.0, self._beyond)
        for felt, doubt in self.contact.settled(until):
            if self._backed is not None:
                self._backed.append((felt.s, felt.offset, felt.angle, doubt))
            elif felt.s < end:
                self.refined.add(felt.s, felt.offset, felt.angle, doubt)

    def _compare(self, s: float, offset: float) -> None:
        """Stop where the seam is not where it was felt before the weld was stopped."""
        if self._before is None or len(self._moved) == COMPARED:
            return
        if s > self._before.samples[-1, 0]:
            return
        self._moved.append(offset - self.refined.offset(s))
        by = float(np.median(self._moved))
        # A seam that has moved by more than 0.2 mm is another one.
        if len(self._moved) == COMPARED and abs(by) > 0.2e-3:
            self._stop(
                f"the seam has moved by {abs(by) * 1e3:.2f} mm since the weld was stopped; weld "
                "the rest as a seam of its own"
            )

    # --- what follows from it -------------------------------------------------------------------

    def _judge(self, pose: ToolPose) -> None:
        """Change the phase where what was felt asks for it."""
        settings = self._settings
        if self.phase in ("following", "bridging") and self.tip >= self._pressing_ends:
            self.phase = "ending"
        elif self.phase == "seeking" and self._search.seats(self._press):
            self._probing.begin(float(self._search.sigma[1]))
            self.phase = "probing"
            if not settings.probing:
                self._follow(self.learned)
        elif self.phase == "probing" and self._probing.over:
            self._learn()
        elif self.phase == "following" and self.contact.free > LOST:
            self._bridge = self._tried = self.tip
            self.phase = "bridging"
            self._turn_over()
        elif self.phase == "bridging" and self._regained:
            self.phase = "following"
        elif self.phase == "bridging" and self.tip - self._tried > STRIDE:
            self._turn_over()
        if self.torch >= self.ends and self.phase != "stopped":
            self._finish()
        self._refuse(pose, settings)

    def _finish(self) -> None:
        """End the weld, if there was one."""
        if self.lit is not None and not self._striking.filled(self._time or 0.0):
            return
        if self._touching and self.lit is None:
            self._stop(f"not begun: {self._too_uncertain(self.bound)}")
        else:
            self.phase = "done"

    def _too_uncertain(self, bound: float, where: str = "") -> str:
        return (
            f"the torch is known to {bound * 1e3:.2f} mm only{where}, max_error is "
            f"{self._settings.max_error * 1e3:.3g} mm"
        )

    def _learn(self) -> None:
        """Take over what the sweep found of finger, clock and arm."""
        found = self._probing.learned()
        if isinstance(found, str):
            self._stop(found)
            return
        if found is not None:
            self._follow(replace(found, noise=max(found.noise, float(self._search.sigma[1]))))

    def _follow(self, found: Learned) -> None:
        """Begin to follow with what was found: how the finger shows, how hard to press."""
        settings, self.learned = self._settings, found
        self._response.dead_time, self._response.lag = found.dead_time, found.lag
        self._began = self._time or 0.0
        if self._belief.two_walls:
            swept = min(found.swept, SWEEP_MARGIN * settings.deflection)
            self.contact.steady = swept / settings.preload
            if settings.probing:
                self._press = min(max(swept / SOFTER, found.least), settings.deflection)
        self.contact.noise = found.noise, float(self._search.sigma[2])
        self._backed = []
        # The path begins with the last measurements of the sweep.
        for pose, touch in self._swept[-20:]:
            s, self._felt, self.wanted = self._located(self._true(pose), touch)
            self._backed.append((s, self._felt.offset, pose.angle, 0.0))
        self._take_backed()
        self.contact.seat(self._seen, self.wanted, settings.preload)
        self.phase = "following"
        # The tip goes back to where the seam is sure to have begun.
        self._backed = [] if self._before is None and self.tip > self._inside else None

    @property
    def _inside(self) -> float:
        """Where the tip is sure to be on the seam, by arc length [m]."""
        return math.inf if self._settings.ends is None else self._settings.ends + INSIDE

    def _take_backed(self) -> None:
        """Begin the path with what was felt at the sweep, and on the way back to the start."""
        settings = self._settings
        self._keep(math.inf)
        self.refined = RefinedPath(self._plan, self._margin, settings.wander)
        self.refined.noise = math.sqrt(self.learned.variance)
        if self._before is not None:
            self.refined.recall(self._before.samples)
        self._sat = sorted([*self._sat, *(self._backed or [])])
        for row in self._sat:
            self.refined.add(*row)
        self.refined.renew(self.torch, 10 * len(self._sat))
        self._backed = None

    @property
    def _regained(self) -> bool:
        """Whether a wall holds the tip again: a free one seems to where the arm leads it there."""
        return self.contact.free < 1.0 - LOST and self.contact.deflection > self._press / 2.0

    def _turn_over(self) -> None:
        """Press the other wall, where there is one."""
        self._tried = self.tip
        if self._belief.two_walls:
            self.side, self.wanted = -self.side, -self.wanted

    def _refuse(self, pose: ToolPose, settings: Following) -> None:
        """Stop where going on would be blind."""
        if self.phase in ("done", "stopped"):
            return
        # Before the arc burns the arm may stand for longer.
        patience = settings.blind if self.lit is not None else 4.0 * settings.blind
        if self._touching and self.phase != "ending" and pose.time - self._seen > patience:
            self._stop(f"no tag was seen for {patience * 1e3:.0f} ms")
        elif self.phase == "bridging" and self.tip - self._bridge > settings.longest_gap:
            self._stop(f"no contact for {settings.longest_gap * 1e3:.0f} mm of the seam")
        # There, at 70 % of the radius, all places of a curve are nearly as near.
        elif self.phase in ("following", "bridging") and self._aside(pose) > 0.7:
            self._stop(
                f"the plan curves with a radius of {1e3 / abs(self._plan.bend(self.tip)):.1f} mm "
                "and the arm is off towards its centre: how far along it the tip is cannot be "
                "told; plan better, or raise 'corner_radius'"
            )
        elif self._search.bent:
            self._stop("the tip is displaced though nothing should touch it")
        elif self.phase == "seeking" and self._astray(pose):
            self._stop(f"no groove within {settings.reach * 1e3:.0f} mm of the plan's start")

    def _aside(self, pose: ToolPose) -> float:
        """Return how far the arm is off to the inside of the plan's curve, in radii."""
        off = float((pose.position[:2] - self._place.point) @ self._place.normal)
        return off * self._plan.bend(self.tip)

    def _astray(self, pose: ToolPose) -> bool:
        below = self._place.height - float(pose.position[2])
        return self._search.over or below > self._settings.reach

    def _stop(self, reason: str) -> None:
        self.phase, self.reason = "stopped", reason

    @property
    def _pressing_ends(self) -> float:
        """Where the wanted deflection begins to ramp down, so that it is zero at ``ending``."""
        settings = self._settings
        release = settings.speed * self._press / settings.release
        return self._plan.length - max(settings.ending, self._beyond) - release

    def _ramp(self, elapsed: float) -> None:
        """Move the wanted deflection towards what the phase asks for."""
        settings = self._settings
        target = {"bridging": self._feeler(), "ending": 0.0}.get(self.phase, self._press)
        if not self._touching:
            target = 0.0
        if self.phase == "seeking" and not self._search.found:
            target = 0.0
        rate = settings.release if self.phase == "ending" else settings.ramp
        step = rate * elapsed
        self.wanted += within(target - self.wanted, step)

    def _feeler(self) -> float:
        """Return by how much the tip goes beyond where a wall is expected that has ended [m].

        The less is known of where the seam leads there the farther, but never so far that it
        would meet the end of the wall head on.
        """
        if self.phase != "bridging":
            return 0.0
        probe = self._press if self._belief.two_walls else self._settings.probe
        return probe + min(BAND * math.sqrt(self.refined.variance(self.tip)), probe)

    def _progress(self, pose: ToolPose, coming: ToolPose) -> None:
        advance, reach = self._plan.advance, self._settings.speed * 0.1
        if self._backed is not None:
            self.tip = self._plan.foot(coming.position[:2], self.tip)
            self.torch = self._plan.foot(self._torch_position(pose), self.torch)
            self._coming, self._place = self.torch, self._plan.at(self.tip)
            # Friction holds the tip back: where it was felt counts. The arm stays on the seam as
            # well: a tip that slips comes to where it is.
            gone = self.tip <= self._inside - 2.0 * INSIDE / 3.0
            if self.contact.at <= self._inside or gone or self.contact.free > 1.0 - LOST:
                self._take_backed()
            return
        self.tip = advance(coming.position[:2], self.tip, reach)
        self._place = self._plan.at(self.tip)
        self._coming = advance(self._torch_position(coming), self._coming, reach)
        self.torch = advance(self._torch_position(pose), self.torch, reach)

    def _torch_position(self, pose: ToolPose) -> Floats:
        """Return P_t (2,), equation (12)."""
        return pose.position[:2] - self._steering.distance * pose.direction

    def _pace(self, pose: ToolPose, normal: Floats) -> float:
        """Return the tip's speed along the seam: less where blind or crooked."""
        if self.phase == "seeking" or self._striking.stands(pose.time):
            return 0.0
        settings, silence = self._settings, self._silence(pose.time)
        sight = 1.0
        if settings.stale < silence <= settings.still:
            sight = (settings.still - silence) / (settings.still - settings.stale)
        speed = min(settings.speed, self._agility())
        steered = self._steering.pace(speed, pose.direction, normal, self._place.tangent)
        return steered * sight * self._firmness()

    def _silence(self, now: float) -> float:
        """Return for how long no image of the tag has come, where one is needed [s]."""
        return now - self._heard if self._touching and self.phase != "ending" else 0.0

    def _agility(self) -> float:
        """Return the speed at which the arm swerves little in the time in which it is blind.

        During the delay of images and arm together it goes on straight where the seam curves.
        """
        delay = self._latency + self._response.delay
        # The tip slows down 10 mm before a curve.
        ahead = self.tip + 10e-3
        sharpest = self._plan.sharpest(self.torch, ahead)
        if delay <= 0.0 or sharpest <= 0.0:
            return math.inf
        # The arm may swerve from it by 0.3 mm, s = v^2 t^2 k / 2.
        return max(math.sqrt(2.0 * 0.3e-3 / sharpest) / delay, SLOWEST * self._settings.speed)

    def _backwards(self) -> float:
        """Return the speed at which the tip goes back: it ends before it can leave the seam."""
        delay = self._latency + self._response.delay
        return INSIDE / (2.0 * delay) if delay > 0.0 else math.inf

    def _firmness(self) -> float:
        """Return the share of its speed that the tip may keep by how firmly it is on the wall.

        Where the seam turns away faster than the servo follows, the tip waits for it.
        """
        if self.phase == "bridging" and self._belief.two_walls:
            return WAITING
        if self.phase not in ("following", "ending") or not self._touching:
            return 1.0
        # The tip slows down below 70 % of the wanted deflection.
        firm = self.contact.deflection / (0.7 * max(self.wanted, self._settings.probe))
        held = (STRAINED - self.contact.strained) / 0.4
        firm = held if self.phase == "ending" else min(firm, held)
        return min(max(firm, WAITING), 1.0)

    def _velocity(self, pose: ToolPose, pace: float) -> Floats:
        """Return V_r (3,): along the plan; the servo (14) across it and in height."""
        settings, place, felt = self._settings, self._place, self._seam_at_tip()
        deflection = self.side * (self._lateral(pose) - felt.offset)
        most = settings.lateral_speed
        across = -self.side * settings.servo_gain * (deflection - self.wanted)
        if self.phase == "seeking" and not self._search.found:
            across = settings.servo_gain * self._search.step(self._lateral(pose))
        across += pace * self._drifting()
        planar = pace * place.tangent + within(across, most) * place.normal
        climb = pace * self._plan.climb(self.tip)
        return np.array([*planar, climb + self._rising(pose)])

    def _rising(self, pose: ToolPose) -> float:
        """Return how fast to go up for the preload to be right [m/s]."""
        settings = self._settings
        height = float(pose.position[2]) - self._place.height - self._seam_at_tip().height
        preload = settings.preload if self._touching else 0.0
        return within(-settings.height_gain * (height + preload), settings.lateral_speed)

    def _drifting(self) -> float:
        """Return how fast the seam leaves the plan to the left, per length of it, at the tip."""
        if self.phase != "following" or self.refined.empty or self._backed is not None:
            return 0.0
        return within(self.refined.slope(self.tip), 1.0)

    def _lateral(self, pose: ToolPose) -> float:
        """Return how far the end point is to the left of where a seated tip is planned [m]."""
        place = self._place
        return float((pose.position[:2] - place.point) @ place.normal) - self._belief.beside

    def _seam_at_tip(self) -> SeamReading:
        """Return the seam at the tip: as felt, or as predicted while nothing is felt."""
        felt = self._felt
        if felt is None:
            return SeamReading(0.0, 0.0)
        if self.phase in ("bridging", "ending") and not self.refined.empty:
            return SeamReading(self.refined.offset(self.tip), felt.height)
        return felt


def _bias_of(belief: Belief, settings: Following) -> Bias:
    """Return the bias before any look; what the arm is off by stays so, seen or not."""
    prior = belief.fixed_variance(settings) - belief.arm_variance(settings)
    return Bias(prior, settings.distortion, belief.distance)


def within(value: float, most: float) -> float:
    """Return a value, at most so large to both sides; NumPy's clip takes ten times as long."""
    return min(max(value, -most), most)

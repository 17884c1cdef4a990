"""Processing of the finger's measurements ("touches"), and the seam estimated from them."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from itertools import islice

import numpy as np

from flangeye.motion.seam_following import Phase, ToolPose, Touch, turned
from flangeye.types import Floats
from flangeye_plugins.weld.following.contact import (
    LOSS_PROBABILITY,
    Contact,
    SeamReading,
    TipPosition,
)
from flangeye_plugins.weld.following.model_prior import SweepFit
from flangeye_plugins.weld.following.probing import SOFTER, SWEEP_MARGIN, Probing
from flangeye_plugins.weld.following.refined import RefinedPath, Sample
from flangeye_plugins.weld.following.search import SweepSearch
from flangeye_plugins.weld.following.task import WeldTask
from flangeye_plugins.weld.following.tip import DeflectionTarget, SeamProgress
from flangeye_plugins.weld.settings import INSIDE

STEADY = 0.03e-3
"""Below this noise a touch is used without averaging [m]."""


class Sensing:
    """State of the finger's measurement: search for the groove, sweep, and smoothed reading.

    Attributes:
        search: Search for the groove.
        probing: Sweep of the seated tip.
        learned: Calibration of finger, clock and arm from the sweep.
        felt: Smoothed reading of the seam at the tip; None before the first touch.
        seen: Time of the newest touch [s].
        heard: Time at which that touch arrived [s].
        latency: Running mean of the touches' latency [s].
        track: The tool's poses, for touches that arrive later.
        swept: Last touches of the sweep, with which the path begins.
    """

    def __init__(self, task: WeldTask, progress: SeamProgress, pressing: DeflectionTarget) -> None:
        self._task, self._progress, self._pressing = task, progress, pressing
        prior = task.prior
        self.search = SweepSearch(task.settings, prior)
        self.probing = Probing(task.settings, prior, task.settings.sign)
        self.learned = SweepFit(ahead=prior.ahead, ahead_sigma=prior.ahead_known)
        self.felt: SeamReading | None = None if task.touch else SeamReading(0.0, 0.0)
        self.seen = self.heard = self.latency = 0.0
        self._level = np.array(prior.level_R_tool)
        self.track = Track()
        self.swept: deque[tuple[ToolPose, Touch]] = deque(maxlen=20)

    def true(self, pose: ToolPose) -> ToolPose:
        """Return the pose with the tip's position ahead corrected by the sweep's estimate."""
        ahead = self.learned.ahead * np.array([*pose.direction, 0.0])
        return ToolPose(pose.time, pose.position + ahead, pose.angle)

    def take(self, touch: Touch, now: float) -> tuple[ToolPose, Touch] | None:
        """Return the tool's pose at the time of a touch, and the touch in level axes (equation 13).

        Return None if the touch is not newer than the last one, or older than the stored poses.

        Args:
            touch: Touch in the tool's axes.
            now: Present time [s].
        """
        if not self._task.touch or touch.time <= self.seen:
            return None
        pose = self.track.at(touch.time - self.learned.stamp)
        if pose is None:
            return None
        self.seen, self.heard = touch.time, now
        late = now - touch.time + self.learned.stamp
        # A running mean over some twenty images.
        self.latency += 0.05 * (late - self.latency)
        return pose, Touch(touch.time, self._level @ touch.displacement)

    def locate(self, pose: ToolPose, touch: Touch, phase: Phase) -> TipPosition:
        """Return the tip's position relative to the plan, and its deformation, at a touch."""
        plan, prior = self._task.plan, self._task.prior
        corrected = self._corrected(touch.displacement, phase)
        tip = pose.position + turned(corrected, pose.angle)
        s = plan.foot(tip[:2], self._progress.tip)
        place = plan.at(s)
        beside = float((tip[:2] - place.point) @ place.normal) - prior.beside
        felt = SeamReading(beside, float(tip[2]) - place.height)
        deflection = self._pressing.side * float((pose.position - tip)[:2] @ place.normal)
        return TipPosition(touch.time, s, felt, deflection, float(corrected[2]), pose.angle)

    def _corrected(self, displacement: Floats, phase: Phase) -> Floats:
        """Return a displacement (3,) corrected for the finger's rest, gain and play [m]."""
        moved = displacement - self.search.rest
        kept = self.learned.kept * self._pressing.played(phase, self.learned.reversal)
        play = np.array([0.0, self._pressing.side * self.learned.width * kept, 0.0])
        across = 1.0 + self.learned.gain
        # The sweep measures the gain across, and the gain upwards is taken to be the same. Where it
        # is not, this errs towards a higher preload, which keeps the tip in its groove.
        gain = np.array([across, across, max(across, 1.0)])
        return np.asarray((moved - play) / gain)

    def seek(self, touch: Touch, found: TipPosition) -> None:
        """Process a touch during the search for the groove."""
        self.felt = found.seam
        compression = float(touch.displacement[2] - self.search.rest[2])
        self.search.feel(touch.displacement, found.deflection, compression)

    def sweep(self, pose: ToolPose, touch: Touch, found: TipPosition, noise: float) -> None:
        """Process a touch during the sweep; ``noise`` is one touch's standard deviation [m]."""
        moved = turned(touch.displacement - self.search.rest, pose.angle)
        along = float(moved[:2] @ self._progress.place.tangent)
        self.smooth(found.seam, noise)
        across = -self._pressing.side * found.deflection
        self.probing.feel(touch.time, across, found.seam.height, along)
        self.swept.append((pose, touch))

    def smooth(self, felt: SeamReading, noise: float) -> None:
        """Add a reading to the running mean ``felt``; the noisier the finger, the longer the mean.

        Args:
            felt: The new reading.
            noise: Standard deviation of one reading [m].
        """
        before = self.felt
        if before is None:
            self.felt = felt
            return
        share = min(1.0, max((STEADY / noise) ** 2, 0.1))
        self.felt = SeamReading(
            before.offset + share * (felt.offset - before.offset),
            before.height + share * (felt.height - before.height),
        )


class Track:
    """History of the tool's poses, to look up the pose at the time of an image."""

    def __init__(self) -> None:
        self._poses: deque[ToolPose] = deque()

    def add(self, pose: ToolPose) -> None:
        """Store a pose, and drop those older than one second."""
        self._poses.append(pose)
        # Images arrive well within one second of their exposure
        while pose.time - self._poses[0].time > 1.0:
            self._poses.popleft()

    def at(self, time: float) -> ToolPose | None:
        """Return the pose interpolated at ``time``; None before the first stored pose."""
        index = bisect_right(self._poses, time, key=lambda pose: pose.time)
        if index == 0:
            return None
        if index == len(self._poses):
            return self._poses[-1]
        before, after = islice(self._poses, index - 1, index + 1)
        share = (time - before.time) / (after.time - before.time)
        position = before.position + share * (after.position - before.position)
        return ToolPose(time, position, before.angle + share * (after.angle - before.angle))


class SeamEstimate:
    """The tip's contact, and the seam estimated from it.

    Attributes:
        refined: Estimate of the seam from the touches so far.
        contact: The state of the tip's contact.
        start: Arc length of the seam's start as felt by the tip; None if not felt [m].
        end: Arc length of the seam's end as felt by the tip; None if not felt [m].
        lost: Time at which the tip lost contact [s]; None in contact.
    """

    def __init__(self, task: WeldTask) -> None:
        self.start: float | None = None
        self.end: float | None = None
        self.lost: float | None = None
        self._task, prior, settings = task, task.prior, task.settings
        self.contact = Contact(
            prior.flat(settings.sign), prior.sliding(settings) / SOFTER, settings.preload,
            prior.noise,
        )  # fmt: skip
        self.refined = self._path()
        self._heights: deque[float] = deque(maxlen=20)
        self._backed: list[Sample] | None = None
        self._sat: list[Sample] = []
        self._moved: list[float] = []
        self._around = False

    def _path(self, noise: float | None = None) -> RefinedPath:
        """Return a path with the touches of the resumed weld, if any.

        ``noise`` is the standard deviation of one touch [m]; None keeps the path's own.
        """
        task = self._task
        path = RefinedPath(task.plan, task.margin, task.settings.wander)
        path.noise = path.noise if noise is None else noise
        if task.before is not None:
            path.recall(task.before.samples)
        return path

    @property
    def backs(self) -> bool:
        """Whether the tip is going back to the seam's start."""
        return self._backed is not None

    def stands(self, found: SweepFit) -> float:
        """Return the largest deflection at which the tip stayed seated in the sweep [m]."""
        return min(found.swept, SWEEP_MARGIN * self._task.settings.deflection)

    def begin(
        self, found: SweepFit, height_noise: float, swept: list[TipPosition], torch: float
    ) -> None:
        """Start the path with the last touches of the sweep.

        Args:
            found: Calibration from the sweep.
            height_noise: Standard deviation of one measured height [m].
            swept: Last touches of the sweep.
            torch: Arc length of the torch [m].
        """
        if self._task.prior.two_walls:
            self.contact.steady = self.stands(found) / self._task.settings.preload
        self.contact.noise = found.noise, height_noise
        self.contact.play = abs(found.width) * (1.0 + found.kept) / (1.0 + found.gain)
        self._backed = [(each.s, each.seam.offset, each.angle, 0.0) for each in swept]
        self.arrive(found, torch)

    def back(self) -> None:
        """Start going back to the seam's start; touches on the way are collected."""
        self._backed = []

    def arrive(self, found: SweepFit, torch: float, lost: bool = False) -> None:
        """Rebuild the path from the touches of the sweep and of the way back to the start.

        Args:
            found: Calibration from the sweep.
            torch: Arc length of the torch [m].
            lost: Whether the tip fell off the start.
        """
        self.keep(math.inf)
        self.start = self.contact.fell if lost else None
        self.refined = self._path(math.sqrt(found.variance))
        self._sat = sorted([*self._sat, *(self._backed or [])])
        for sample in self._sat:
            self.refined.add(*sample)
        self.refined.renew(torch, 10 * len(self._sat))
        self._backed = None

    def leave(self, phase: Phase) -> None:
        """Take the place where the tip fell off as the seam's end, if it is plausible."""
        task, at = self._task, self.contact.fell
        if self.end is not None or phase != "ending" or at is None:
            return
        if not task.feels_ends or not task.prior.two_walls:
            return
        if abs(at - task.plan.length) <= task.beyond + INSIDE:
            self.end = at

    @property
    def height(self) -> float:
        """Mean height above the plan of the last accepted, seated touches [m]."""
        return float(np.mean(self._heights or [0.0]))

    def weigh(self, found: TipPosition, learned: SweepFit, side: float) -> None:
        """Update the contact modes by a touch, while the wall on this side is pressed."""
        offset, variance = self.refined.expected(found.s)
        # Play is left out of the variance: it displaces the path's earlier touches by the same.
        spread = variance + (learned.noise / (1.0 + learned.gain)) ** 2 + STEADY**2
        self.contact.take(found, found.seam.offset - offset, spread, side)
        if self.contact.free <= LOSS_PROBABILITY:
            self.lost = None
        elif self.lost is None:
            self.lost = found.time
        if self._task.plan.closed and found.s >= self._task.plan.length:
            self._go_around()

    def _go_around(self) -> None:
        """Copy the touches at the start of a closed seam to beyond its end."""
        if self._around:
            return
        self._around, task = True, self._task
        for s, offset, angle, _, doubt in self.refined.samples().tolist():
            if s < task.settings.overlap + task.settings.ending:
                self.refined.add(s + task.plan.length, offset, angle, doubt)

    def keep(self, until: float) -> None:
        """Add the accepted touches up to a time [s] to the path.

        Those past the seam's earliest possible end are left out.
        """
        task = self._task
        end = task.plan.length - max(task.settings.ending / 4.0, task.beyond)
        # Between two walls a tip shows that it has fallen off the seam's end.
        if task.feels_ends and task.prior.two_walls:
            end = task.plan.length + task.beyond
        for felt, doubt in self.contact.settled(until):
            sample = felt.s, felt.seam.offset, felt.angle, doubt
            self._heights.append(felt.seam.height)
            if self._backed is not None:
                self._backed.append(sample)
            elif felt.s < end:
                self.refined.add(*sample)

    def regained(self, pressing: DeflectionTarget) -> bool:
        """Return whether a wall holds the tip again.

        Probability alone is not enough, as a free tip moves with the arm and may coincide with the
        expected seam: the tip must be deflected as well.
        """
        return (
            self.contact.free < 1.0 - LOSS_PROBABILITY
            and self.contact.deflection > pressing.most / 2.0
        )

    def moved(self, found: TipPosition) -> str:
        """Return a message if the seam has moved since the weld that is resumed; else ""."""
        before = self._task.before
        enough = 15  # measurements that show whether it has moved
        if before is None or len(self._moved) == enough or found.s > before.samples[-1, 0]:
            return ""
        self._moved.append(found.seam.offset - self.refined.offset(found.s))
        by = abs(float(np.median(self._moved)))
        # A seam that has moved by more than 0.2 mm is another one.
        if len(self._moved) < enough or by <= 0.2e-3:
            return ""
        return (
            f"the seam has moved by {by * 1e3:.2f} mm since the weld was stopped; weld "
            "the rest as a seam of its own"
        )

"""Following by touch: one step each cycle, measurements in, velocities out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flangeye_plugins.welding.contact import LOST, Contact
from flangeye_plugins.welding.controller import STILL, Phase
from flangeye_plugins.welding.motion import Command, Felt, ToolPose, Touch, Track, turned
from flangeye_plugins.welding.path import Path
from flangeye_plugins.welding.refined import RefinedPath
from flangeye_plugins.welding.search import Search
from flangeye_plugins.welding.settings import Following
from flangeye_plugins.welding.steering import Steering

Floats = NDArray[np.float64]

BELIEF = 0.3
"""A sample is believed when contact has not been doubted for so long after it [s]."""

LEANING = 0.1e-3
"""A tip that must be deflected by more, and is not, has lost its wall at the seam's end [m]."""


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
    """

    def __init__(
        self, plan: Path, distance: float, settings: Following, touch: bool = True
    ) -> None:
        """Prepare to follow ``plan`` with the torch ``distance`` [m] behind the tip.

        Args:
            plan: The planned seam.
            distance: From the torch to the tip [m].
            settings: Gains and limits.
            touch: Follow by touch; otherwise the plan alone, for comparison.
        """
        self.mode = "tactile" if touch else "vision"
        self.phase: Phase = "seeking" if touch else "following"
        self.reason = ""
        self.tip, self.torch = settings.inset, settings.inset - distance
        self.wanted = 0.0
        self.refined = RefinedPath(plan, distance + settings.ending)
        self.contact = Contact()
        self._plan, self._settings, self._touching = plan, settings, touch
        self._steering = Steering(distance, settings.cross_track_gain, settings.turn_rate)
        self.side = 1.0 if settings.side == "left" else -1.0
        self._track = Track()
        self._felt: Felt | None = None if touch else Felt(0.0, 0.0)
        self._time: float | None = None
        self._seen = self._bridge = 0.0
        self._loose = False
        self._place = plan.at(self.tip)
        self._search = Search(settings.reach)

    def step(self, pose: ToolPose, touches: Sequence[Touch]) -> Command:
        """Return the command for this cycle; ``touches`` are the measurements not yet given."""
        if self._time is None:
            self._time = self._seen = pose.time
        elapsed, self._time = pose.time - self._time, pose.time
        self._track.add(pose)
        for touch in touches:
            if self._touching and touch.time > self._seen:
                self._feel(touch)
        self._judge(pose)
        if self.phase in ("done", "stopped") or self._felt is None:
            return STILL
        self._ramp(elapsed)
        self._progress(pose)
        point, normal = self.refined.frame(self.torch)
        velocity = self._velocity(pose, self._pace(pose, normal))
        torch = self._torch_position(pose)
        error = float((torch - point) @ normal)
        turn = self._steering.turn(velocity[:2], pose.direction, normal, error)
        return Command(velocity, turn if velocity[:2].any() else 0.0)

    # --- what the finger says -------------------------------------------------------------------

    def _feel(self, touch: Touch) -> None:
        """Take a measurement, with the pose the tool had when its image was taken (13)."""
        pose = self._track.at(touch.time)
        if pose is None:
            return
        self._seen = touch.time
        tip = pose.position + turned(touch.displacement, pose.angle)
        s = self._plan.foot(tip[:2], self.tip)
        place = self._plan.at(s)
        deflection = self.side * float((pose.position - tip)[:2] @ place.normal)
        self.contact.update(touch.time, deflection, max(self.wanted, self._settings.probe))
        felt = Felt(float((tip[:2] - place.point) @ place.normal), float(tip[2]) - place.height)
        if self.phase == "seeking":
            self._felt = felt
            self._search.feel(deflection, float((tip - pose.position)[2]), self._settings)
        else:
            self._believe(touch.time, s, felt, deflection)

    def _believe(self, time: float, s: float, felt: Felt, deflection: float) -> None:
        """Keep what the tip felt, unless contact is doubtful."""
        if self.phase == "ending":
            self._notice_loss(s, felt, deflection)
            if self._loose:
                return
        if self.phase == "ending" or (self.phase == "following" and self.contact.state == "held"):
            if self.phase == "following" and self.contact.doubted(deflection, self.wanted):
                return
            settled = time - self.contact.since > BELIEF
            if settled and s < self._plan.length - self._settings.ending / 2:
                self._felt = felt
                self.refined.add(time, s, felt.offset)
            self.refined.confirm(time - BELIEF)

    def _notice_loss(self, s: float, felt: Felt, deflection: float) -> None:
        """Notice that the wall is gone while the tip is let go of: it then goes with the robot.

        What it should be deflected by follows from where the robot is and what was felt before.
        """
        if self.refined.empty:
            return
        expected = deflection + self.side * (felt.offset - self.refined.offset(s))
        if expected > LEANING and deflection < LOST * expected:
            self._loose = True
            self.refined.forget_pending()

    # --- what follows from it -------------------------------------------------------------------

    def _judge(self, pose: ToolPose) -> None:
        """Change the phase where what was felt asks for it."""
        settings, state = self._settings, self.contact.state
        if self.phase in ("following", "bridging") and self.tip >= self._pressing_ends:
            self._enter("ending")
        elif self.phase == "seeking" and state == "held" and self._search.seated:
            self._enter("following")
        elif self.phase == "following" and state == "lost":
            self.refined.forget_pending()
            self._bridge = self.tip
            self._enter("bridging")
        elif self.phase == "bridging" and state == "held":
            self._enter("following")
        if self.torch >= self._plan.length:
            self._enter("done")
        self._refuse(pose, settings)

    def _enter(self, phase: Phase) -> None:
        self._loose = phase == "ending" and self.phase == "bridging"
        self.phase = phase

    def _refuse(self, pose: ToolPose, settings: Following) -> None:
        """Stop where going on would be blind."""
        if self.phase in ("done", "stopped"):
            return
        if self._touching and self.phase != "ending" and pose.time - self._seen > settings.blind:
            self._stop(f"no tag was seen for {settings.blind * 1e3:.0f} ms")
        elif self.phase == "bridging" and self.tip - self._bridge > settings.longest_gap:
            self._stop(f"no contact for {settings.longest_gap * 1e3:.0f} mm of the seam")
        elif self.phase == "seeking" and self._astray(pose):
            self._stop(f"no groove within {settings.reach * 1e3:.0f} mm of the plan's start")

    def _astray(self, pose: ToolPose) -> bool:
        below = self._place.height - float(pose.position[2])
        return self._search.over or below > self._settings.reach

    def _stop(self, reason: str) -> None:
        self.phase, self.reason = "stopped", reason

    @property
    def _pressing_ends(self) -> float:
        """Where the wanted deflection begins to ramp down, so that it is zero at ``ending``."""
        settings = self._settings
        release = settings.speed * settings.deflection / settings.release
        return self._plan.length - settings.ending - release

    def _ramp(self, elapsed: float) -> None:
        """Move the wanted deflection towards what the phase asks for."""
        settings = self._settings
        target = {"bridging": settings.probe, "ending": 0.0}.get(self.phase, settings.deflection)
        if not self._touching:
            target = 0.0
        if self.phase == "seeking" and not self._search.found:
            target = 0.0
        rate = settings.release if self.phase == "ending" else settings.ramp
        step = rate * elapsed
        self.wanted += float(np.clip(target - self.wanted, -step, step))

    def _progress(self, pose: ToolPose) -> None:
        reach = self._settings.speed * 0.1
        self.tip = self._plan.advance(pose.position[:2], self.tip, reach)
        self._place = self._plan.at(self.tip)
        self.torch = self._plan.advance(self._torch_position(pose), self.torch, reach)

    def _torch_position(self, pose: ToolPose) -> Floats:
        """Return P_t (2,), equation (12)."""
        return pose.position[:2] - self._steering.distance * pose.direction

    def _pace(self, pose: ToolPose, normal: Floats) -> float:
        """Return the tip's speed along the seam: less where blind or crooked."""
        if self.phase == "seeking":
            return 0.0
        settings = self._settings
        age = pose.time - self._seen if self._touching and self.phase != "ending" else 0.0
        sight = float(np.clip((settings.blind - age) / (settings.blind - settings.stale), 0.0, 1.0))
        return settings.speed * sight * self._steering.slowing(pose.direction, normal)

    def _velocity(self, pose: ToolPose, pace: float) -> Floats:
        """Return V_r (3,): along the plan; the servo (14) across it and in height."""
        settings, place, felt = self._settings, self._place, self._seam_at_tip()
        deflection = self.side * (self._lateral(pose) - felt.offset)
        height = float(pose.position[2]) - place.height - felt.height
        most = settings.lateral_speed
        across = -self.side * settings.servo_gain * (deflection - self.wanted)
        if self.phase == "seeking" and not self._search.found:
            across = settings.servo_gain * self._search.step(self._lateral(pose))
        preload = settings.preload if self._touching else 0.0
        up = -settings.height_gain * (height + preload)
        planar = pace * place.tangent + np.clip(across, -most, most) * place.normal
        climb = pace * self._plan.climb(self.tip)
        return np.array([*planar, climb + np.clip(up, -most, most)])

    def _lateral(self, pose: ToolPose) -> float:
        """Return how far the end point is to the left of the plan [m]."""
        place = self._place
        return float((pose.position[:2] - place.point) @ place.normal)

    def _seam_at_tip(self) -> Felt:
        """Return the seam at the tip: as felt, or as predicted while nothing is felt."""
        felt = self._felt
        if felt is None:
            return Felt(0.0, 0.0)
        if self.phase in ("bridging", "ending") and not self.refined.empty:
            return Felt(self.refined.offset(self.tip), felt.height)
        return felt

"""Passes after the root pass: the torch follows the refined path again, offset and higher.

The root pass follows the seam by touch. Later passes touch nothing: the tool is aligned with the
path, its tip above the bead, and the torch is steered by

    V_t = v t + k (q - P_t),    V_r = V_t + L w n_d,    w = v curvature + k (heading - angle)

where q is the refined path, displaced by the pass's offsets; the second is equation (A) of the
README.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flangeye.motion.arc import OFF
from flangeye.motion.seam_following import STILL, Command, Controller, Phase, ToolPose, Touch
from flangeye.types import Floats
from flangeye_plugins.weld.following.bound import along
from flangeye_plugins.weld.following.follower import Follower
from flangeye_plugins.weld.following.model_prior import BAND
from flangeye_plugins.weld.following.response import Response
from flangeye_plugins.weld.following.steering import ArcSequence, Weave, WeaveOffset
from flangeye_plugins.weld.following.task import ResumePoint
from flangeye_plugins.weld.following.tip import within
from flangeye_plugins.weld.path import PATH_SPACING, Path
from flangeye_plugins.weld.settings import PassParams

GAIN = 2.0
"""Gain of a pass on errors of position and heading [1/s]."""


class RootPass:
    """Result of the root pass: the seam with its variance, and the tool's height.

    Attributes:
        rows: Along the root pass: the torch's arc length, the end point's height and the torch's
            standard deviation [m].
    """

    def __init__(self, root: Follower, plan: Path, before: Floats) -> None:
        """Start with the rows ``before`` (K, 3) of a resumed weld, or none."""
        self._root, self._plan = root, plan
        self.rows: list[tuple[float, ...]] = [tuple(row) for row in before.tolist()]
        self._along, self._sigma = before[:, 0], before[:, 2]

    def note(self, height: float) -> None:
        """Store a cycle of the root pass with the end point's height [m]."""
        root = self._root
        # The torch may go back, after a lost wall: each place is stored once.
        if not self.rows or root.torch >= self.rows[-1][0] + PATH_SPACING:
            self.rows.append((root.torch, height, root.sigma))

    def path(self, chosen: PassParams) -> Path:
        """Return the torch's path in a pass; its height is the tool's end point's."""
        s = np.arange(0.0, self._plan.length + PATH_SPACING / 2, PATH_SPACING)
        frames = [self._root.seam.refined.frame(x) for x in s.tolist()]
        planar = np.array([point + chosen.across * normal for point, normal in frames])
        self._along, height, self._sigma = np.array(self.rows).T
        return Path(np.column_stack([planar, np.interp(s, self._along, height) + chosen.up]))

    def sigma(self, s: float) -> float:
        """Return the root pass's standard deviation of the torch at an arc length [m]."""
        return float(np.interp(s, self._along, self._sigma))


class MultiPassController:
    """Controller of several passes: the root pass by touch, later ones along the felt seam.

    Attributes:
        root: Controller of the root pass.
        number: Number of the present pass; 0 is the root pass.
        aim: Present target of the torch, to the left of the seam [m].
    """

    def __init__(self, root: Follower) -> None:
        """Start with the root pass, or with the pass in which a resumed weld stopped."""
        task, before = root.task, root.task.before
        plan, prior, settings = task.plan, task.prior, task.settings
        self.root, self.number = root, 0
        self.mode, self.side = root.mode, root.side
        self._prior, self._settings = prior, settings
        self._sigmas = along(plan, prior, settings)
        self._traced = RootPass(root, plan, np.zeros((0, 3)) if before is None else before.traced)
        self._response = Response()
        self._path = plan
        self._began: float | None = None
        self._striking, self._now = ArcSequence(prior.arc), 0.0
        self._take_over()
        if before is not None and before.number:
            self._go_on(before)

    def _go_on(self, before: ResumePoint) -> None:
        """Start in the later pass that is resumed."""
        root = self.root
        root.sensing.learned, root.welding.arc_from = before.learned, root.task.start.torch
        root.seam.refined.noise = before.learned.noise
        self.number = before.number - 1
        self._learned()
        self._next_pass(0.0)
        self._start = self.torch = root.task.start.torch

    def _learned(self) -> None:
        """Use the arm's delay as identified in the root pass."""
        learned = self.root.sensing.learned
        self._response.dead_time, self._response.lag = learned.dead_time, learned.lag

    def kept(self) -> ResumePoint | None:
        """Return the state from which to resume; None before the torch was on the seam."""
        root = self.root.kept()
        if root is None:
            return None
        root = replace(root, traced=np.array(self._traced.rows))
        if not self.number:
            return root
        return replace(root, torch=self.torch, number=self.number)

    def _take_over(self) -> None:
        root = self.root
        self.phase: Phase = root.phase
        self.reason, self.tip, self.torch, self.wanted = (
            root.reason, root.tip, root.torch, root.wanted
        )  # fmt: skip
        self.sigma, self.bound, self.band, self.aim = root.sigma, root.bound, root.band, root.aim

    @property
    def arc_from(self) -> float | None:
        """Arc length at which the arc was struck in the root pass [m]; None before."""
        return self.root.arc_from

    @property
    def arc(self) -> float:
        """Commanded state of the arc: OFF, GAS or BURN of :mod:`flangeye.motion.arc`."""
        if not self.number:
            return self.root.arc
        return self._striking.level(self._now) if self.phase == "passing" else OFF

    def step(self, pose: ToolPose, touches: Sequence[Touch]) -> Command:
        """Return the command for this cycle, given the measurements since the last one."""
        if not self.number:
            return self._root_step(pose, touches)
        # The pose after all commands sent so far: without touch nothing else corrects the arm's
        # delay.
        coming, self._now = self._response.ahead(pose), pose.time
        command = self._return(coming) if self.phase == "returning" else self._weld(coming)
        self._response.record(pose.time, command)
        return command

    def _root_step(self, pose: ToolPose, touches: Sequence[Touch]) -> Command:
        command = self.root.step(pose, touches)
        self._traced.note(float(pose.position[2]))
        self._take_over()
        if self.phase == "done":
            self._learned()
            self._next_pass(float(pose.position[2]))
        return command

    @property
    def _pass(self) -> PassParams:
        return self._settings.passes[self.number - 1]

    def _next_pass(self, height: float) -> None:
        """Start the return to the next pass from this height [m]; end after the last."""
        if self.number == len(self._settings.passes):
            self.phase = "done"
            return
        self.number += 1
        self._path, self._began = self._traced.path(self._pass), None
        self._striking = ArcSequence(self._prior.arc)
        self._weave = Weave(self._pass.weave_width, self._settings.weave_frequency)
        # Between two passes the tool is lifted by 15 mm.
        self._over = max(height, float(self._path.points[:, 2].max())) + 15e-3
        self._start = 0.0
        self.phase, self.torch, self.tip = "returning", 0.0, self._prior.distance
        self.wanted = self.sigma = self.bound = self.band = 0.0
        self.aim = self._pass.across

    # --- back to the start, above the work -------------------------------------------------------

    def _return(self, pose: ToolPose) -> Command:
        """Return the command that moves the tool up, across to the pass's start, and down."""
        start = self._path.at(self._start)
        # Displacement of the end point that brings the torch to the start, with the tool along the
        # path
        aside = start.point + self._prior.distance * start.tangent - pose.position[:2]
        turn = math.remainder(start.heading - pose.angle, math.tau)
        # A place is reached when the tool is within 0.1 mm and 0.2 deg of it.
        there = float(np.hypot(*aside)) < 0.1e-3 and abs(turn) < math.radians(0.2)
        goal = start.height if there else self._over
        up = goal - float(pose.position[2])
        if there and abs(up) < 0.1e-3:
            self.phase = "passing"
            return self._weld(pose)
        away = 0.0 if up > 5e-3 else 1.0  # lifted first
        speed = self._settings.return_speed
        return Command(
            np.array([*(away * _towards(aside, speed)), within(GAIN * up, speed)]),
            away * within(GAIN * turn, self._settings.turn_rate),
        )

    # --- along the refined path ------------------------------------------------------------------

    def _weld(self, pose: ToolPose) -> Command:
        """Return the command that steers the torch along the pass's path."""
        settings, distance = self._settings, self._prior.distance
        ahead = np.array([math.cos(pose.angle), math.sin(pose.angle)])
        torch = pose.position[:2] - distance * ahead
        self.torch = self._path.advance(torch, self.torch, settings.speed * 0.1)
        self.tip = self.torch + distance
        self._striking.strike(self._now)
        if self.torch >= self._path.length:
            if self._striking.filled(self._now):
                self._next_pass(float(pose.position[2]))
            return STILL
        if self._striking.stands(self._now):
            return STILL
        self._began = pose.time if self._began is None else self._began
        sway = self._swayed(pose.time)
        place = self._path.at(self.torch)
        error = float((torch - place.point) @ place.normal) - sway.aside
        self._estimate(error)
        across = sway.rate - GAIN * error
        torch_speed = settings.speed * place.tangent + across * place.normal
        # Rotate with the path's curvature plus a correction of the heading; then, by (12), the end
        # point moves at V_r = V_t + L w n_d
        askew = math.remainder(place.heading - pose.angle, math.tau)
        turning = GAIN * askew + settings.speed * self._path.bend(self.torch)
        turn = within(turning, settings.turn_rate)
        planar = torch_speed + distance * turn * np.array([-ahead[1], ahead[0]])
        up = settings.height_gain * (place.height - float(pose.position[2]))
        up += settings.speed * self._path.climb(self.torch)
        return Command(np.array([*planar, up]), turn)

    def _swayed(self, now: float) -> WeaveOffset:
        dead, elapsed = self._response.dead_time, now - (self._began or now)
        # What the arm carries out now was commanded one dead time ago.
        self.aim = self._pass.across + self._weave.at(elapsed - dead).aside
        return self._weave.at(elapsed).for_lag(self._response.lag)

    def _estimate(self, error: float) -> None:
        """Update the torch's error bound, given its control error [m]; stop if it is too large."""
        settings = self._settings
        # The arm's error enters twice, when the seam was felt and now: at worst with opposite
        # signs.
        again = (2.0 * settings.arm_sigma) ** 2 + settings.distortion**2 + self._weave.variance
        seam = self._traced.sigma(self.torch)
        self.sigma = math.sqrt(seam**2 + again)
        self.band, self.bound = (abs(error) + k * self.sigma for k in (BAND, self._sigmas))
        if self.bound > settings.max_error:
            self.phase = "stopped"
            self.reason = (
                f"in pass {self.number + 1} the torch is known to {self.bound * 1e3:.2f} mm only, "
                f"max_error is {settings.max_error * 1e3:.3g} mm"
            )


def follower_of(controller: Controller) -> Follower | None:
    """Return the controller that follows by touch (the root pass's); None if there is none."""
    if isinstance(controller, MultiPassController):
        return controller.root
    return controller if isinstance(controller, Follower) else None


def _towards(way: Floats, speed: float) -> Floats:
    """Return a velocity (2,) along the remaining way, reduced near its end [m/s]."""
    far = float(np.hypot(*way))
    return way * (min(GAIN * far, speed) / max(far, 1e-9))

"""Resume a stopped weld: measurements are kept, and the torch overlaps the weld's end.

The state is recovered from the log by stepping the controller through all logged poses and
displacements. So nothing has to be saved when a weld stops, even if the process was killed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from flangeye.devices import WeldProfile
from flangeye.errors import StageError
from flangeye.motion.seam_following import Command, Controller, FollowingTask, ToolPose, Touch
from flangeye.plugin.registry import Lookup, load_registry
from flangeye.plugin.stage import BoundPart
from flangeye.types import Floats
from flangeye.workflow.log.read import JournalEntry, read_notes
from flangeye_plugins.weld.following.follower import Follower
from flangeye_plugins.weld.following.model_prior import ModelPrior, SweepFit
from flangeye_plugins.weld.following.steering import SETTLING
from flangeye_plugins.weld.following.task import ResumePoint, WeldStart, WeldTask
from flangeye_plugins.weld.passes import MultiPassController, follower_of
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import ControllerChoice, Following, WeldTactileParams

RUN_IN = 2 * SETTLING
"""Run-in before the arc, in which the torch recovers from its displacement by the sweep [m]."""


def controller_of(task: WeldTask, mode: ControllerChoice) -> Controller:
    """Return the controller that carries out a task in a mode."""
    if isinstance(mode, BoundPart):
        controller: Controller = mode(task_of(task.plan, task.prior.distance, task.settings))
        return controller
    root = Follower(replace(task, touch=mode == "tactile"))
    return MultiPassController(root) if task.settings.passes and root.task.touch else root


def task_of(plan: Path, distance: float, settings: Following) -> FollowingTask:
    """Return the task for a plugin's controller; the torch is ``distance`` behind the tip [m]."""
    return FollowingTask(
        plan.points, plan.tangents, plan.step, distance,
        settings.sign, settings.speed, settings.deflection, settings.preload, settings.servo_gain,
        settings.height_gain, settings.lateral_speed, settings.turn_rate,
    )  # fmt: skip


def _mode_of(logged: str | Mapping[str, Any]) -> ControllerChoice:
    """Return the mode named in a log; a plugin's controller must be installed."""
    if logged in ("tactile", "vision"):
        return logged
    ((name, given),) = {logged: {}}.items() if isinstance(logged, str) else logged.items()
    lookup = Lookup(load_registry())
    part = lookup.part(f"controller.{name}")
    return part.bind(part.params.model_validate(given, context=lookup) if part.params else None)


def controller_from(start: Mapping[str, Any]) -> Controller:
    """Return the controller of a logged weld, in its initial state."""
    tuples = {name: tuple(start["prior"][name]) for name in ("noise", "arc")}
    prior = ModelPrior(**{**start["prior"], **tuples})
    settings = Following.model_validate(start["settings"])
    plan, kept = Path(np.array(start["points"]), start["wraps"]), start.get("kept")
    before = None
    if kept is not None:
        samples, traced = np.array(kept["samples"]), np.array(kept["traced"]).reshape(-1, 3)
        learned = SweepFit(**kept["learned"])
        before = ResumePoint(samples, kept["torch"], learned, traced, kept["number"])
    given = start.get("start")
    at = None if given is None else WeldStart(**given)
    task = WeldTask(plan, prior, settings, before=before, given=at)
    return controller_of(task, _mode_of(start["mode"]))


def kept_value(kept: ResumePoint) -> dict[str, Any]:
    """Return the state of a stopped weld as plain values for the log."""
    return {**asdict(kept), "samples": kept.samples.tolist(), "traced": kept.traced.tolist()}


def resume_point_of(log: FilePath, points: Floats) -> ResumePoint | None:
    """Return the state of a stopped weld; None if its torch was not on the seam yet.

    Args:
        log: Log of the stopped weld.
        points: (N, 3) points of the plan, in the plane of the work [m].

    Raises:
        StageError: The log holds no weld by touch, or a complete one, or one on another plan.
    """
    again: LoggedWeld | None = None
    for note in read_notes(log):
        if note.name == "start":
            _require_same(log, points, np.array(note.value["points"]))
            again = LoggedWeld(note.value)
        elif again is not None:
            again.take(note)
    controller = None if again is None else again.controller
    if not isinstance(controller, Follower | MultiPassController):
        raise StageError(f"{log}: holds no tactile weld to resume")
    if controller.phase == "done":
        raise StageError(f"{log}: this weld is complete; there is nothing to resume")
    return controller.kept()


class LoggedWeld:
    """Steps a controller through a logged weld.

    Attributes:
        controller: The controller, created in its initial state.
        felt: Measurement of each image, by the image's number.
        newest: Number of the newest image.
        cycles: Number of cycles processed.
    """

    def __init__(self, start: Mapping[str, Any]) -> None:
        self.controller = controller_from(start)
        self.felt: dict[int, Touch | None] = {}
        self.newest, self.cycles = -1, 0
        self._profiles: dict[int, list[WeldProfile]] = {}

    def take(self, note: JournalEntry) -> None:
        """Process the next log entry."""
        if note.name == "sight":
            self.see(note.value)
        elif note.name == "feeling":
            self.feel(note.value)
        elif note.name == "profile":
            told = dict(note.value)
            self._profiles.setdefault(told.pop("cycle"), []).append(WeldProfile(**told))
        elif note.name == "cycles":
            self._decide(note.value)

    def see(self, sight: Mapping[str, Any]) -> None:
        """Process the log entry of an image."""
        self.newest = sight["number"]

    def feel(self, logged: Mapping[str, Any]) -> None:
        """Process the measurement of the newest image."""
        self.felt[self.newest] = Touch(logged["time_ns"] * 1e-9, np.array(logged["displacement"]))

    def decided(self, command: Command, cycles: Mapping[str, list[Any]], i: int) -> None:
        """Receive the controller's command in the ``i``-th cycle of a block; ignore it here."""

    def _decide(self, cycles: Mapping[str, list[Any]]) -> None:
        for i, time in enumerate(cycles["time"]):
            pose = ToolPose(time, np.array(cycles["position"][i]), cycles["angle"][i])
            if (follower := follower_of(self.controller)) is not None:
                for profile in self._profiles.pop(self.cycles, []):
                    follower.looked(profile)
            self.cycles += 1
            felt = [self.felt[number] for number in cycles["touches"][i]]
            command = self.controller.step(pose, [touch for touch in felt if touch is not None])
            self.decided(command, cycles, i)


def _require_same(log: FilePath, points: Floats, before: Floats) -> None:
    # To rounding: 1 um.
    if points.shape == before.shape and np.abs(points - before).max() < 1e-6:
        return
    raise StageError(
        f"{log}: was planned on another seam; resume it on its own: --from {log} --at weld.tactile"
    )


def restart(params: WeldTactileParams, plan: Path, distance: float, kept: ResumePoint) -> WeldStart:
    """Return the start of a resumed weld, such that the torch overlaps the bead.

    The arc is struck at the start of the overlap; the tip is set down a run-in before that. A later
    pass touches nothing and needs no run-in.

    Raises:
        StageError: The rest of the seam is too short for the tip.
    """
    if kept.number:
        arc_from = max(kept.torch - params.overlap, 0.0)
        return _standing(plan, distance, arc_from, _away(plan, arc_from, distance))
    release = params.speed * params.deflection / params.release
    # At the latest 5 mm before the tip lets go of the wall.
    last = plan.length - params.ending - release - 5e-3
    arc_from = kept.torch - params.overlap
    if last < params.set_down:
        raise StageError("weld.tactile: the rest of the seam is too short for the tip to press on")
    tip = min(_away(plan, max(arc_from - RUN_IN, params.set_down - distance), distance), last)
    return _standing(plan, distance, max(arc_from, 0.0), tip)


def _standing(plan: Path, distance: float, arc_from: float, tip: float) -> WeldStart:
    """Return the start with the tip and the torch on the plan, for an arc from ``arc_from`` [m]."""
    place = plan.at(tip)
    torch = plan.at(_away(plan, tip, -distance)).point
    x, y = (place.point - torch).tolist()
    return WeldStart(tip, arc_from, math.remainder(math.atan2(y, x) - place.heading, math.tau))


def _away(plan: Path, s: float, distance: float) -> float:
    """Return the arc length of the tool's other end; see :meth:`Path.other_end`."""
    return float(plan.other_end(np.array([s]), distance)[0])

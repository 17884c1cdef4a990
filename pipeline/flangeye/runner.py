"""Run a checked recipe: lazily, one capture at a time.

The solver pulls observations; each pull acquires one capture and takes it through the
per-capture steps. When the solver stops pulling, nothing more is acquired.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from itertools import chain
from typing import Any

import pluggy

from flangeye import types as t
from flangeye.devices import MotionAllowed
from flangeye.errors import CalibrationRefused, FlangeyeError, StageError
from flangeye.outcome import Outcome, result_of
from flangeye.recipe import Recipe
from flangeye.registry import Registry
from flangeye.replay import Earlier, Replay
from flangeye.result import Result
from flangeye.steps import Step, bare
from flangeye.stopwatch import Stopwatch


class Runner:
    """One run of one recipe."""

    def __init__(
        self,
        recipe: Recipe,
        registry: Registry,
        archive: t.ArchivePath,
        motion: MotionAllowed = MotionAllowed(),  # noqa: B008  frozen
    ) -> None:
        self._recipe = recipe
        self._registry = registry
        self._hooks: pluggy.HookRelay = registry.hooks.hook
        self._values: dict[Any, Any] = {
            t.Box: None, t.ArchivePath: archive, t.Views: t.Views(), MotionAllowed: motion,
            **recipe.context,
        }  # fmt: skip
        self._watch = Stopwatch()
        self._outcome = Outcome(t.Source(fingerprint=""))
        self._stream: t.Captures | t.Observations | None = None
        self._segmented: dict[str, t.FlangeCloud] | None = None
        self._refined: list[Step] = []
        self._captures: t.Captures | None = None

    @property
    def accepted(self) -> int:
        """How many captures have become observations so far."""
        return len(self._outcome.seen)

    def run(self, replay: Replay | None = None, earlier: Earlier | None = None) -> Result:
        """Run the recipe and return its result.

        Args:
            replay: Steps to take from an earlier log instead of doing them, if any.
            earlier: A run that ended early, to go on with, if any.

        Raises:
            StageError: A step cannot do its work with the input it was given.
        """
        try:
            try:
                self._observe(replay, earlier)
                self._solve(replay)
            finally:
                self._finish_acquiring()
            self._refine(replay)
            self._verify()
            self._weld(replay)
        except CalibrationRefused as error:
            self._outcome.refused = str(error)
        result = result_of(self._outcome, self._recipe, self._registry, self._watch)
        self._hooks.flangeye_run_finished(result=result.model_dump(mode="json"))
        return result

    def observe(self) -> t.Observations:
        """Return what the steps before the solver give, as it is pulled."""
        self._observe(None)
        observations: t.Observations = self._values[t.Observations]
        return observations

    # --- acquire, segment, fit: one capture at a time ------------------------------------------

    def _observe(self, replay: Replay | None, earlier: Earlier | None = None) -> None:
        """Set up the stream of observations; nothing is acquired yet."""
        self._values[t.Resumed] = earlier.resumed if earlier else None
        stream = replay.stream() if replay else self._call(self._steps("acquire")[0])
        if replay:
            self._segmented = replay.segmented()
            self._values[t.Views] = replay.views()
            self._outcome.rejections = replay.rejections()
        self._stream = stream
        self._outcome.source = stream.source
        self._values[t.Box] = self._values[t.Box] or stream.source.workspace
        self._hooks.flangeye_run_started(source=stream.source, total=stream.total)
        observations: Iterator[t.Observation] = (
            self._logged(stream) if isinstance(stream, t.Observations) else self._fitted(stream)
        )
        if earlier:
            observations = chain(self._gathered(earlier), observations)
            if isinstance(stream, t.Captures):
                stream.became.update(earlier.became())
        solvable = t.Observations(observations, stream.source, stream.total)
        self._outcome.seen = solvable.seen
        self._values[t.Observations] = solvable

    def _logged(self, stream: t.Observations) -> Iterator[t.Observation]:
        """Log observations that came ready made: one by one, as if they had been fitted."""
        step = self._steps("acquire")[0]
        for observation in stream:
            self._finished(step, observation.id, observation, 0.0)
            self._hooks.flangeye_capture_finished(capture=observation.id)
            yield observation

    def _gathered(self, earlier: Earlier) -> Iterator[t.Observation]:
        """Log again what an earlier run gathered, so that this log stands by itself."""
        acquire, fit = (self._steps(kind)[0] for kind in ("acquire", "fit"))
        segments = self._steps("segment")
        self._values[t.Views].extend(earlier.log.views())
        for rejection in earlier.log.rejections:
            self._reject(rejection)
        fitted = {o.id: o for o in earlier.log.observations()}
        unsegmented = ((capture, None) for capture in earlier.log.captures())
        for capture, flange in earlier.log.flange_clouds() if segments else unsegmented:
            self._hooks.flangeye_captured(step=acquire.label, capture=capture, seconds=0.0)
            if flange is not None:
                self._finished(segments[0], capture.id, flange, 0.0)
            if observation := fitted.get(capture.id):
                self._finished(fit, capture.id, observation.feature, 0.0)
            self._hooks.flangeye_capture_finished(capture=capture.id)
            if observation:
                yield observation

    def _finish_acquiring(self) -> None:
        """Let go of the source at once: a solver that has enough stops the arm."""
        if self._captures is not None:
            self._captures.close()

    def _fitted(self, stream: t.Captures) -> Iterator[t.Observation]:
        acquire = self._steps("acquire")[0]
        label = acquire.label
        self._captures = stream
        captures = iter(stream)
        while True:
            before = self._watch.seconds.get(label, 0.0)
            with self._watch.timing(label):
                capture = next(captures, None)
            if capture is None:
                return
            seconds = self._watch.seconds[label] - before
            if isinstance(capture, t.Rejection):
                stream.became[capture.id] = None
                self._reject(capture)
                continue
            if (fault := _unread_joint(capture)) is not None:
                stream.became[capture.id] = None
                self._reject(t.Rejection(capture.id, acquire.stage.name, fault))
                continue
            self._hooks.flangeye_captured(step=label, capture=capture, seconds=seconds)
            observation = stream.became[capture.id] = self._through(capture)
            self._hooks.flangeye_capture_finished(capture=capture.id)
            if observation is not None:
                yield observation

    def _through(self, capture: t.Capture) -> t.Observation | None:
        """Take one capture through segment and fit; None when set aside or kept for verifying."""
        given: dict[Any, Any] = {t.Capture: capture}
        if self._steps("segment"):
            flange = self._segment(capture)
            if flange is None:
                return None
            if capture.role == "verification":
                view = t.VerificationView(capture.id, flange, capture.base_T_flange)
                self._values[t.Views].append(view)
            given[t.FlangeCloud] = flange
        if capture.role == "verification":
            return None
        feature = self._per_capture("fit", capture.id, given)
        if feature is None:
            return None
        return t.Observation(
            capture.id, feature, capture.base_T_flange, capture.joints, capture.base2_T_flange2
        )

    def _segment(self, capture: t.Capture) -> t.FlangeCloud | None:
        if self._segmented is not None:
            flange = self._segmented[capture.id]
            self._finished(self._steps("segment")[0], capture.id, flange, 0.0)
            return flange
        found: t.FlangeCloud | None = self._per_capture("segment", capture.id, {t.Capture: capture})
        return found

    def _per_capture(self, kind: str, capture: str, given: Mapping[Any, Any]) -> Any:
        step = self._steps(kind)[0]
        value = self._call(step, capture, given)
        if isinstance(value, t.Rejected):
            self._reject(t.Rejection(capture, step.stage.name, value.reason))
            return None
        return value

    def _reject(self, rejection: t.Rejection) -> None:
        self._outcome.rejections.append(rejection)
        self._hooks.flangeye_capture_rejected(rejection=rejection)

    # --- solve, verify, weld: once -------------------------------------------------------------

    def _solve(self, replay: Replay | None) -> None:
        step = self._steps("solve")[0]
        if replay and replay.at > step.index:
            list(self._values[t.Observations])  # log them again: the new log stands by itself
        self._calibrate(step, replay)
        self._values[t.Solver] = self._solve_subset

    def _refine(self, replay: Replay | None) -> None:
        for step in self._steps("refine"):
            self._calibrate(step, replay)
            self._refined.append(step)

    def _calibrate(self, step: Step, replay: Replay | None) -> None:
        self._values[t.HandEye] = self._outcome.calibration = self._once(step, replay)

    def _once(self, step: Step, replay: Replay | None) -> Any:
        """Do a step that runs once, or read back from the log what it gave."""
        if replay is None or replay.at <= step.index:
            return self._call(step)
        value = replay.given(step.stage.name)
        self._finished(step, None, value, 0.0)
        return value

    def _solve_subset(self, observations: Sequence[t.Observation]) -> t.HandEye:
        """Solve a subset, and refine it as far as the calibration has been refined."""
        subset = t.Observations(observations, self._outcome.source, len(observations))
        given: dict[Any, Any] = {t.Observations: subset}
        for step in (self._steps("solve")[0], *self._refined):
            given[t.HandEye] = step.stage.function(**self._arguments(step, given))
        calibration: t.HandEye = given[t.HandEye]
        return calibration

    def _verify(self) -> None:
        for step in self._steps("verify"):
            self._outcome.verifications[step.label] = self._call(step)
        failed = [v.reason for v in self._outcome.verifications.values() if not v.passed]
        if failed:
            raise CalibrationRefused("; ".join(failed))
        calibration = self._outcome.calibration
        if self._outcome.verifications and calibration is not None:
            values = {f.name: getattr(calibration, f.name) for f in fields(t.HandEye)}
            verified = t.VerifiedHandEye(**values, verifications=self._outcome.verifications)
            self._values[t.VerifiedHandEye] = self._outcome.calibration = verified

    def _weld(self, replay: Replay | None) -> None:
        """Scan the workpiece, plan the seam, weld; what a simulation knows stays here."""
        for step in self._steps("scan"):
            self._values[t.Look] = self._look(step, replay)
            scan = self._outcome.scan = self._once(step, replay)
            self._values[t.WorkpieceScan] = replace(scan, truth={})
        for step in self._steps("seam"):
            self._values[t.Seam] = self._outcome.seam = self._once(step, replay)
        for step in self._steps("weld"):
            self._values[t.WeldReport] = self._outcome.weld = self._call(step)

    def _look(self, step: Step, replay: Replay | None) -> t.Look | None:
        """Return the simulation's scanner; for a log of a simulation, the cell is set up again."""
        if replay and replay.at <= step.index and replay.source.truth:
            self._stream = self._call(self._steps("acquire")[0])
        return self._stream.look if isinstance(self._stream, t.Captures) else None

    # --- one call --------------------------------------------------------------------------------

    def _steps(self, kind: str) -> list[Step]:
        return [step for step in self._recipe.steps if step.stage.kind == kind]

    def _call(
        self, step: Step, capture: str | None = None, given: Mapping[Any, Any] | None = None
    ) -> Any:
        before = self._watch.seconds.get(step.label, 0.0)
        with self._watch.timing(step.label):
            value = _guarded(step, self._arguments(step, given or {}))
        if not isinstance(value, t.Stream):
            seconds = self._watch.seconds[step.label] - before
            if not isinstance(value, t.Rejected):
                self._finished(step, capture, value, seconds)
        return value

    def _arguments(self, step: Step, given: Mapping[Any, Any]) -> dict[str, Any]:
        values = {**self._values, t.Journal: partial(self._noted, step.label), **given}
        arguments = {name: values.get(bare(need)) for name, need in step.stage.needs.items()}
        if step.params is not None:
            arguments["params"] = step.params
        return arguments

    def _noted(self, step: str, name: str, value: Any) -> None:
        self._hooks.flangeye_noted(step=step, name=name, value=value)

    def _finished(self, step: Step, capture: str | None, value: Any, seconds: float) -> None:
        self._hooks.flangeye_stage_finished(
            step=step.label, capture=capture, value=value, seconds=seconds
        )


def _unread_joint(capture: t.Capture) -> str | None:
    """Return which joint angle is no number: a driver that had none to give leaves NaN."""
    joints = () if capture.joints is None else capture.joints.tolist()
    for number, angle in enumerate(joints, 1):
        if not math.isfinite(angle):
            return f"joint {number} is {angle}: the arm's driver had no angle to give"
    return None


def _guarded(step: Step, arguments: dict[str, Any]) -> Any:
    """Call a stage; a mistake inside a plugin becomes one line that names it."""
    try:
        return step.stage.function(**arguments)
    except (FlangeyeError, MemoryError):
        raise
    except Exception as error:
        raise StageError(
            f"{step.label}: failed with {type(error).__name__}: {error}; this is a mistake in the "
            "plugin (FLANGEYE_DEBUG=1 shows where)"
        ) from error

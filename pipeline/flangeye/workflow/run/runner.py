"""Run a checked recipe: lazily, one capture at a time.

The solver pulls observations; each pull acquires one capture and takes it through the
per-capture steps. When the solver stops pulling, nothing more is acquired.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import fields, replace
from functools import partial
from itertools import chain, islice
from typing import Any

import numpy as np
import pluggy

from flangeye import types as t
from flangeye.devices import MotionAllowed
from flangeye.errors import CalibrationRefused, FlangeyeError, NothingSeen, StageError
from flangeye.files.processes import require_memory
from flangeye.models.cell import cell_in
from flangeye.models.configuration import CELL
from flangeye.models.scanners import ScannerModel
from flangeye.plugin.registry import Registry
from flangeye.workflow.recipe.load import Recipe
from flangeye.workflow.recipe.steps import Step, bare
from flangeye.workflow.result import calibrated_pose, require_one
from flangeye.workflow.result.contract import Result
from flangeye.workflow.run.outcome import Outcome, Stopwatch, Truths, result_of
from flangeye.workflow.run.prefetch import FinishedCall, cores, prefetched
from flangeye.workflow.run.restart import FromNothing


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
        self._start = FromNothing()
        self._refined: list[Step] = []
        self._held: list[list[t.Observation]] = []
        self._captures: t.Captures | None = None
        self._working: Generator[t.Capture | t.Rejection] | None = None
        self._done: Callable[[], dict[str, FinishedCall]] = dict

    def run(self, start: FromNothing = FromNothing()) -> Result:  # noqa: B008  holds nothing
        """Run the recipe and return its result.

        Args:
            start: Starting point: nothing, a log, or a run that ended early.

        Raises:
            StageError: A step failed on its input.
        """
        _take_buffers()
        truths = Truths()  # nothing that a stage can reach from its arguments holds them
        try:
            try:
                truths.cell = self._observe(start)
                self._solve()
            finally:
                self._finish_acquiring()
            self._refine()
            self._verify()
            self._export()
            self._weld(truths)
        except CalibrationRefused as error:
            self._outcome.refused = error
        result = result_of(self._outcome, self._recipe, self._registry, self._watch, truths)
        self._hooks.flangeye_run_finished(result=result.model_dump(mode="json"))
        return result

    def observe(self) -> t.Observations:
        """Yield the observations of the steps before the solver, on demand."""
        self._observe(FromNothing())
        observations: t.Observations = self._values[t.Observations]
        return observations

    @property
    def rejections(self) -> Sequence[t.Rejection]:
        """Captures rejected so far."""
        return self._outcome.rejections

    def take(self, count: int | None) -> list[t.Observation]:
        """Return the first ``count`` observations, or all, and close the source."""
        try:
            return list(islice(self.observe(), count))
        finally:
            self._finish_acquiring()

    def solve(self, observations: Sequence[t.Observation], source: t.Source) -> t.HandEye:
        """Return the result of the recipe's solve step on given observations."""
        self._outcome.source = source
        self._values[t.Box] = self._values[t.Box] or source.workspace
        return self._solve_subset(observations)

    # --- acquire, segment, fit: one capture at a time ------------------------------------------

    def _observe(self, start: FromNothing) -> t.Truth | None:
        """Set up the stream of observations, unpulled; return the truth of a simulation."""
        self._start = start
        self._values[t.Resumed] = start.resumed
        self._values[t.Views] = start.views()  # before an acquire step adds its own
        stream = start.stream(self._acquire)
        self._hooks.flangeye_run_started(source=stream.source, total=stream.total)
        # No stage may see a simulation's truth: a solver could use the answer
        truth, stream.source = stream.source.truth, replace(stream.source, truth=None)
        self._outcome.source = stream.source
        self._values[t.Box] = self._values[t.Box] or stream.source.workspace
        for rejection in start.rejections():
            self._reject(rejection)
        taken = self._taken(stream)
        # Captures to take again come first: an adaptive solver that already has enough from the
        # earlier ones would never ask for them
        solvable = t.Observations(
            chain(islice(taken, start.first), self._gathered(), taken), stream.source, stream.total
        )
        # The same list, not a copy: it grows while the solver pulls
        self._outcome.seen = solvable.seen
        self._values[t.Earlier] = t.Earlier(solvable.seen)
        self._values[t.Observations] = solvable
        return truth

    def _acquire(self) -> t.Captures | t.Observations:
        stream: t.Captures | t.Observations = self._call(self._steps("acquire")[0])
        if isinstance(stream, t.Captures):
            # Its devices are open from now on, also if the solver never asks for a capture
            self._captures = stream
        self._values[t.Look] = None if self._captures is None else self._captures.look
        return stream

    def _taken(self, stream: t.Captures | t.Observations) -> Iterator[t.Observation]:
        return self._logged(stream) if isinstance(stream, t.Observations) else self._fitted(stream)

    def _logged(self, stream: t.Observations) -> Iterator[t.Observation]:
        """Log observations that came ready made: one by one, as if they had been fitted."""
        step = self._steps("acquire")[0]
        for observation in stream:
            self._finished(step, observation.id, observation)
            self._hooks.flangeye_capture_finished(capture=observation.id)
            yield observation

    def _gathered(self) -> Iterator[t.Observation]:
        """Copy the captures of an earlier run to this log, so that it is complete by itself."""
        acquire = self._steps("acquire")[0]
        for capture, flange, observation in self._start.gathered():
            self._hooks.flangeye_captured(step=acquire.label, capture=capture, seconds=0.0)
            if flange is not None:
                self._finished(self._steps("segment")[0], capture.id, flange)
            if observation:
                self._finished(self._steps("fit")[0], capture.id, observation.feature)
            self._hooks.flangeye_capture_finished(capture=capture.id)
            if observation:
                yield observation

    def _finish_acquiring(self) -> None:
        """Close the source, which stops the arm once the solver has enough poses."""
        if self._working is not None:  # here, for the collector may do it in one of its threads
            self._working.close()
        if self._captures is not None:
            self._captures.close()
            self._watch.idle[self._steps("acquire")[0].label] = self._captures.idle

    def _fitted(self, stream: t.Captures) -> Iterator[t.Observation]:
        acquire = self._steps("acquire")[0]
        label = acquire.label
        captures: Iterator[t.Capture | t.Rejection] = iter(stream)
        if self._may_work_ahead(stream):
            captures = self._working = self._ahead(stream)
        while True:
            before = self._watch.seconds[label]
            with self._watch.timing(label):
                capture = next(captures, None)
            if capture is None:
                yield from self._disambiguated(stream, last=True)
                self._require_seen()
                return
            seconds = self._watch.seconds[label] - before
            if isinstance(capture, t.Rejection):
                stream.outcomes[capture.id] = None
                self._reject(capture)
                continue
            if (fault := _unread_joint(capture)) is not None:
                stream.outcomes[capture.id] = None
                self._reject(t.Rejection(capture.id, acquire.stage.name, fault))
                continue
            self._hooks.flangeye_captured(step=label, capture=capture, seconds=seconds)
            poses = self._through(capture)
            if len(poses) > 1:  # the arm's motion decides, once there is more of it
                self._held.append(poses)
            else:
                stream.outcomes[capture.id] = poses[0] if poses else None
                self._hooks.flangeye_capture_finished(capture=capture.id)
                yield from poses
            yield from self._disambiguated(stream)

    def _disambiguated(self, stream: t.Captures, last: bool = False) -> Iterator[t.Observation]:
        """Yield ambiguous captures whose pose has been decided by the arm's motion.

        Those still undecided after the last capture are rejected.
        """
        from flangeye.estimation.start.ambiguity import ambiguous, disambiguated

        if not self._held:
            return
        found = disambiguated(cell_in(self._values), self._outcome.seen, self._held, last)
        pairs = list(zip(self._held, found, strict=True))
        self._held = [poses for poses, one in pairs if one is None and not last]
        for poses, one in pairs:
            capture = poses[0].id
            if one is not None:
                self._finished(self._steps("fit")[0], capture, one.feature)
            elif last:
                why, segment = ambiguous(poses), self._steps("segment")[0].stage.name
                self._reject(t.Rejection(capture, segment, why.reason, why.figures, why.fix))
            if one is not None or last:
                stream.outcomes[capture] = one
                self._hooks.flangeye_capture_finished(capture=capture)
        yield from (one for one in found if one is not None)

    def _require_seen(self) -> None:
        """Refuse the run if no capture shows the target, with the most frequent reason.

        Raises:
            NothingSeen: No capture shows the target.
        """
        why = self._outcome.rejections
        if self._outcome.seen or self._values[t.Views] or not why:
            return
        common, share = Counter(each.kind for each in why).most_common(1)[0]
        first = next(each for each in why if each.kind == common)
        of = f"{share} of the " if share < len(why) else "the "
        usual = f"{first.stage}: {first.reason}" + (f"; {first.fix}" if first.fix else "")
        raise NothingSeen(f"no capture can be used; {of}{len(why)} were rejected by {usual}")

    def _may_work_ahead(self, stream: t.Captures) -> bool:
        steps = (*self._steps("segment"), *self._steps("fit"))
        needs = [need for step in steps for need in step.stage.needs.values()]
        # Pulling the next capture early would move a real arm. A stage that logs, or reads the
        # earlier observations, depends on the order
        return stream.recorded and cores() > 1 and not {t.StageLog, t.Earlier} & {*needs}

    def _ahead(self, stream: t.Captures) -> Generator[t.Capture | t.Rejection]:
        """Yield the captures; the next ones are segmented and fitted meanwhile, on all cores."""
        with closing(prefetched(iter(stream), self._meanwhile, cores())) as working:
            for capture, self._done in working:
                yield capture

    def _meanwhile(self, capture: t.Capture | t.Rejection) -> dict[str, FinishedCall]:
        """Return the results of segment and fit for a capture, by label; runs in any thread."""
        if isinstance(capture, t.Rejection) or _unread_joint(capture) is not None:
            return {}
        found: dict[str, FinishedCall] = {}
        given: dict[Any, Any] = {t.Capture: capture}
        for step in (*self._steps("segment"), *self._steps("fit")):
            # Verifiers compare whole clouds, and the solver must not get these captures
            if step.stage.kind == "fit" and capture.role == "verification":
                break
            done = FinishedCall.of(partial(_guarded, step, self._arguments(step, given)))
            found[step.label] = done
            if not isinstance(done.value, t.FlangeCloud):
                break
            given[t.FlangeCloud] = done.value
        return found

    def _through(self, capture: t.Capture) -> list[t.Observation]:
        """Segment and fit one capture, and return it with each pose that it may show.

        There is no pose if it was rejected or is kept for verification.
        """
        given: dict[Any, Any] = {t.Capture: capture}
        flange = None
        if self._steps("segment"):
            flange = self._segment(capture)
            if flange is None:
                return []
            if capture.role == "verification":
                view = t.VerificationView(capture.id, flange, capture.base_T_flange)
                self._values[t.Views].append(view)
            given[t.FlangeCloud] = flange
        if capture.role == "verification":
            return []
        features = self._each_fitted(capture.id, flange, given)
        return [
            t.Observation(
                capture.id, feature, capture.poses, capture.joints, capture.camera, capture.target,
                capture.motion, capture.arm_joints,
            )
            for feature in features
        ]  # fmt: skip

    def _each_fitted(
        self, capture: str, flange: t.FlangeCloud | None, given: dict[Any, Any]
    ) -> list[Any]:
        """Return the fit for each pose that explains a scan; ambiguous ones are logged later."""
        if flange is not None and len(flange.others):
            step = self._steps("fit")[0]
            with self._watch.timing(step.label):
                every = [
                    (one, _guarded(step, self._arguments(step, {**given, t.FlangeCloud: one})))
                    for one in flange.alone
                ]
            fitted = [each for each in every if not isinstance(each[1], t.Rejected)]
            if len(fitted) > 1:
                return [feature for _, feature in fitted]
            given[t.FlangeCloud] = (fitted or every)[0][0]
        feature = self._per_capture("fit", capture, given)
        return [] if feature is None else [feature]

    def _segment(self, capture: t.Capture) -> t.FlangeCloud | None:
        if flange := self._start.segmented(capture.id):
            self._finished(self._steps("segment")[0], capture.id, flange)
            return flange
        found: t.FlangeCloud | None = self._per_capture("segment", capture.id, {t.Capture: capture})
        return found

    def _per_capture(self, kind: str, capture: str, given: Mapping[Any, Any]) -> Any:
        step = self._steps(kind)[0]
        value = self._call(step, capture, given)
        if isinstance(value, t.Rejected):
            why = (value.reason, value.figures, value.fix)
            self._reject(t.Rejection(capture, step.stage.name, *why))
            return None
        return value

    def _reject(self, rejection: t.Rejection) -> None:
        self._outcome.rejections.append(rejection)
        self._hooks.flangeye_capture_rejected(rejection=rejection)

    # --- solve, verify, weld: once -------------------------------------------------------------

    def _solve(self) -> None:
        step = self._steps("solve")[0]
        if not self._start.does(step):
            list(self._values[t.Observations])  # log them again: the new log stands by itself
        self._calibrate(step)
        self._values[t.Solver] = self._solve_subset

    def _refine(self) -> None:
        for step in self._steps("refine"):
            self._calibrate(step)
            self._refined.append(step)

    def _calibrate(self, step: Step) -> None:
        found = _refined(self._once(step), self._outcome.calibration)
        # Closed forms have no error model, so the mixed model predicts their error at the work
        if found.expected is None:
            found = self._with_expected_error(found)
        self._values[t.HandEye] = self._outcome.calibration = found

    def _with_expected_error(self, found: t.HandEye) -> t.HandEye:
        """Return a calibration with the mixed model's expected error, if its solver gives none."""
        from flangeye.estimation.calibrate import with_expected_error

        cell, given = cell_in(self._values), self._values.get
        return with_expected_error(found, cell, given(ScannerModel), given(t.Box))

    def _once(self, step: Step) -> Any:
        """Return the result of a step that runs once: from the starting point, or by running it."""
        if self._start.does(step):
            return self._call(step)
        value = self._start.given(step)
        self._finished(step, None, value)
        return value

    def _solve_subset(self, observations: Sequence[t.Observation]) -> t.HandEye:
        """Solve a subset, and refine it as far as the calibration has been refined."""
        subset = t.Observations(observations, self._outcome.source, len(observations))
        given: dict[Any, Any] = {t.Observations: subset}
        for step in (self._steps("solve")[0], *self._refined):
            found = step.stage.function(**self._arguments(step, given))
            given[t.HandEye] = _refined(found, given.get(t.HandEye))
        calibration: t.HandEye = given[t.HandEye]
        return calibration

    def _verify(self) -> None:
        for step in self._steps("verify"):
            self._outcome.verifications[step.label] = self._call(step)
        failed = [v for v in self._outcome.verifications.values() if not v.passed]
        if failed:
            advice = next((v.advice for v in failed if v.advice), "")
            raise CalibrationRefused("; ".join(v.reason for v in failed), advice)
        calibration = self._outcome.calibration
        if self._outcome.verifications and calibration is not None:
            # Seam and weld stages take this type only: no torch moves by an unverified calibration
            values = {f.name: getattr(calibration, f.name) for f in fields(t.HandEye)}
            verified = t.VerifiedHandEye(**values, verifications=self._outcome.verifications)
            self._values[t.VerifiedHandEye] = self._outcome.calibration = verified

    def _export(self) -> None:
        """Write the pose in other programs' formats; a refused calibration ends the run before."""
        steps = self._steps("export")
        if steps:
            so_far = result_of(self._outcome, self._recipe, self._registry, self._watch)
            pose = self._values[t.CalibratedPose] = calibrated_pose(so_far)
        for step in steps:
            # A format for one pose would silently drop the other transforms of a cell
            if CELL not in step.stage.serves:
                require_one(step.label, pose, so_far)
            file = self._call(step)
            if file.name in {other.name for other in self._outcome.exports}:
                raise StageError(
                    f"{step.label}: an earlier step writes {file.name} already; give this one "
                    "another name"
                )
            self._outcome.exports.append(file)

    def _weld(self, truths: Truths) -> None:
        """Scan the workpiece, plan the seam, and weld; a simulation's truth stays in ``truths``."""
        for step in self._steps("scan"):
            if self._start.does(step) and self._start.simulated:
                self._acquire()  # the simulated cell is set up again, to scan with
            scan = self._once(step)
            truths.seams = scan.truth
            self._values[t.WorkpieceScan] = self._outcome.scan = replace(scan, truth={})
        for step in self._steps("seam"):
            self._values[t.Seam] = self._outcome.seam = self._once(step)
        for step in self._steps("weld"):
            self._values[t.WeldReport] = self._outcome.weld = self._call(step)

    # --- one call --------------------------------------------------------------------------------

    def _steps(self, kind: str) -> list[Step]:
        return [step for step in self._recipe.steps if step.stage.kind == kind]

    def _call(
        self, step: Step, capture: str | None = None, given: Mapping[Any, Any] | None = None
    ) -> Any:
        before = self._watch.seconds[step.label]
        # A worker thread may have run this call already; its time did not pass on this thread's
        # clock
        done = self._done().get(step.label) if capture is not None else None
        if done is not None:
            self._watch.add(step.label, done.seconds)
            value = done.result()
        else:
            with self._watch.timing(step.label):
                value = _guarded(step, self._arguments(step, given or {}))
        # The acquire step's stream is lazy: its captures are logged when they are pulled
        if not isinstance(value, t.Stream):
            seconds = self._watch.seconds[step.label] - before
            if not isinstance(value, t.Rejected):
                self._finished(step, capture, value, seconds)
        return value

    def _arguments(self, step: Step, given: Mapping[Any, Any]) -> dict[str, Any]:
        values = {**self._values, t.StageLog: partial(self._noted, step.label), **given}
        arguments = {
            name: _given(step, need, values.get(bare(need)))
            for name, need in step.stage.needs.items()
        }
        if step.params is not None:
            arguments["params"] = step.params
        return arguments

    def _noted(self, step: str, name: str, value: Any) -> None:
        self._hooks.flangeye_noted(step=step, name=name, value=value)

    def _finished(self, step: Step, capture: str | None, value: Any, seconds: float = 0.0) -> None:
        """Pass a step's result on to the hooks; a result that was there already took no time."""
        self._hooks.flangeye_stage_finished(
            step=step.label, capture=capture, value=value, seconds=seconds
        )


def _take_buffers() -> None:
    """Make NumPy's and SciPy's OpenBLAS allocate their permanent buffers of 32 MB now.

    If an allocation fails later, OpenBLAS retries for ever or ends the process.
    """
    from scipy.linalg import cholesky

    require_memory("linear algebra needs buffers", 72)
    np.linalg.cholesky(np.eye(2))
    cholesky(np.eye(2))


def _given(step: Step, need: Any, value: Any) -> Any:
    """Return the values that a stage takes; raise if a required one is missing."""
    if value is None and bare(need) is need:
        name = getattr(need, "__name__", str(need))
        raise StageError(f"{step.label}: needs a {name}, and nothing in this run gives one")
    return value


def _refined(found: t.HandEye, before: t.HandEye | None) -> t.HandEye:
    """Return a step's changed calibration, without solver data that no longer applies."""
    stale = before is not None and found.without is before.without
    return replace(found, without=None) if stale else found


def _unread_joint(capture: t.Capture) -> str | None:
    """Return a message about a joint angle that is not finite; None if all are finite."""
    joints = () if capture.joints is None else capture.joints.tolist()
    for number, angle in enumerate(joints, 1):
        if not math.isfinite(angle):
            return f"joint {number} is {angle}: the arm's driver had no angle to give"
    return None


def _guarded(step: Step, arguments: dict[str, Any]) -> Any:
    """Call a stage; a failure of the system, or a plugin's mistake, becomes one line."""
    try:
        return step.stage.function(**arguments)
    except (FlangeyeError, MemoryError):
        raise
    except Exception as error:
        failed = f"{step.label}: failed with {type(error).__name__}: {error}"
        require_memory(failed)  # as libraries that cannot be loaded, and threads, fail otherwise
        if isinstance(error, OSError):
            where = f"{error.filename}: " if error.filename else ""
            raise StageError(f"{step.label}: {where}{error.strerror or error}") from error
        raise StageError(
            f"{failed}; this is a mistake in the plugin (FLANGEYE_DEBUG=1 shows where)"
        ) from error

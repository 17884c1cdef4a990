"""The conformance kit: tests that every plugin of a kind must pass; vendors inherit them.

``class TestMyFit(FitConformance): stage = my_fit`` in a test module is all that pytest needs; it
then runs every ``test_…`` method of the class. Nothing here imports pytest: a method that finds a
fault raises AssertionError with one line that says what was expected.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flangeye import types as t
from flangeye.testing.base import (
    Conformance,
    require,
    require_close,
    require_refusal,
    require_repeats,
    require_type,
)
from flangeye.testing.devices import (
    ArcConformance,
    ProfilerConformance,
    RobotConformance,
    ScannerConformance,
    SensorConformance,
)
from flangeye.testing.percapture import FitConformance, SegmentConformance
from flangeye.testing.solving import (
    TRUE_CAMERA,
    RefineConformance,
    SolveConformance,
    VerifyConformance,
    observed,
    work_points,
)
from flangeye.testing.sources import (
    AcquireConformance,
    PlanConformance,
    ReaderConformance,
    ViewConformance,
)
from flangeye.testing.welding import (
    ControllerConformance,
    ScanConformance,
    SeamConformance,
    WeldConformance,
)
from flangeye.types import Floats
from flangeye.types.geometry import rigid, rotation_exp, rotation_from_rpy
from flangeye.workflow.doctor.diagnosis import Finding, NotApplicable, RecordedSession

AT = np.array([0.05, -0.03, 0.7])
"""Position of the work in ``camera`` [m]."""

REMARKS = ("flangeye: a pose of the kit", "REFUSED, DO NOT USE: the kit says so")


def session(count: int = 16) -> RecordedSession:
    """Return recordings without a mistake: a known cell with 0.05 mm of noise."""
    observations = observed(work_points(count))
    features = [o.circle for o in observations]
    return RecordedSession(
        ids=tuple(o.id for o in observations),
        poses=np.array([o.base_T_flange.matrix for o in observations]),
        centres=np.array([feature.centre for feature in features]),
        normals=np.array([feature.normal for feature in features]),
        rotations=np.full((count, 3, 3), np.nan),
        places=np.zeros((count, 3)),
        times=np.arange(count, dtype=float),
    )


class CheckConformance(Conformance):
    """A ``check`` part: takes a recorded session, returns findings."""

    kind = "check"

    def found(self, recordings: RecordedSession) -> list[Finding]:
        """Return the check's findings; empty if it does not apply."""
        try:
            findings = list(self.call({}, recordings))
        except NotApplicable:
            return []
        require(all(isinstance(f, Finding) for f in findings), "did not return Findings")
        return findings

    def test_it_gives_the_same_twice(self) -> None:
        """Two calls with equal recordings give equal findings."""
        first, again = ([f.what for f in self.found(session())] for _ in range(2))
        require(first == again, "two calls with equal input differ")

    def test_it_finds_nothing_where_nothing_is_wrong(self) -> None:
        """Recordings of a known cell with 0.05 mm of noise give no finding of a mistake."""
        mistakes = [finding.what for finding in self.found(session()) if not finding.note]
        require(not mistakes, f"found in good recordings: {'; '.join(mistakes)}")

    def test_too_little_is_no_crash(self) -> None:
        """Sessions of no sample, two samples, or some without a target must not crash a check."""
        blind = replace(session(), centres=np.full_like(session().centres, np.nan))

        def look(given: RecordedSession) -> Any:
            for finding in self.found(given):
                require("\n" not in finding.what, f"{finding.name}: one sentence, one line")
            return t.Rejected("")

        for what, given in (
            ("two", session(2)),
            ("no", session().where(np.zeros(16, bool))),
            ("blind", blind),
        ):
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                require_refusal(partial(look, given), t.Rejected, f"{what} samples")
            require(not said, f"{what} samples: warns instead: {said[0].message if said else ''}")


class ReplayConformance(Conformance):
    """A ``replay`` part: takes a log and a step, returns the comparison of repeated decisions."""

    kind = "replay"

    def test_a_log_that_is_none_is_refused(self) -> None:
        """A file that is no log is refused with a one-line error."""
        missing = Path("no/such/run.mcap")
        require_refusal(lambda: self.call({}, missing, "0.none"), t.Rejected, str(missing))


class GuideConformance(Conformance):
    """A ``guide`` part leads a person through a procedure; its own tests cover the procedure."""

    kind = "guide"


def pose_error(shift: Floats, turn: Floats | None = None) -> t.PoseError:
    """Return an error that moves the work by ``shift`` [m] and turns it about itself [rad]."""
    rotation = rotation_exp(np.zeros(3) if turn is None else turn)
    return t.PoseError(rigid(rotation, AT + shift - rotation @ AT), AT, TRUE_CAMERA[:3, :3])


class CostConformance(Conformance):
    """A ``cost`` part: takes a PoseError, returns one number; smaller is better."""

    kind = "cost"

    def cost(self, error: t.PoseError) -> float:
        """Return the part's number."""
        return require_type(self.call(None, error), float)

    def test_it_gives_the_same_twice(self) -> None:
        """Two calls with equal errors give equal costs, to the last bit."""
        error = pose_error(np.array([1e-3, 2e-3, -1e-3]), np.array([1e-3, 0, 2e-3]))
        require_repeats(lambda: self.cost(error))

    def test_no_error_costs_nothing(self) -> None:
        """An error of zero has a cost of zero."""
        require(abs(self.cost(pose_error(np.zeros(3)))) < 1e-12, "no error has a cost")

    def test_an_error_costs_something(self) -> None:
        """The cost of an error in a general direction is finite and positive."""
        cost = self.cost(pose_error(np.array([1e-3, 2e-3, -1e-3])))
        require(np.isfinite(cost) and cost > 0, f"an error of 2 mm costs {cost}")

    def test_it_scales_with_the_error(self) -> None:
        """Twice the error never costs less."""
        costs = [self.cost(pose_error(k * np.array([1e-3, 2e-3, -1e-3]))) for k in (1, 2, 4)]
        require(costs[0] < costs[1] < costs[2], f"1, 2, 4 times the error cost {costs}")

    def test_an_error_and_its_mirror_cost_the_same(self) -> None:
        """An error and its opposite have the same cost."""
        shift = np.array([1e-3, 2e-3, -1e-3])
        here, there = self.cost(pose_error(shift)), self.cost(pose_error(-shift))
        require(
            np.isclose(here, there, rtol=1e-6), f"an error costs {here:.6g}, its mirror {there:.6g}"
        )


class ErrorConformance(Conformance):
    """An ``error`` part: takes a candidate pose and held-out poses, returns PoseError or None."""

    kind = "error"

    def measured(self, candidate: Floats, kept: Sequence[t.Observation]) -> Any:
        """Return the part's answer."""
        pose = t.Transform(t.BASE, t.CAMERA, candidate)
        return self.call({}, pose, list(kept))

    def test_it_gives_the_same_twice(self) -> None:
        """Two calls with equal input give equal output, to the last bit."""
        require_repeats(lambda: self.measured(TRUE_CAMERA, observed(work_points())))

    def test_the_true_pose_has_next_to_no_error(self) -> None:
        """The true pose has no error beyond the noise."""
        off = np.linalg.norm(self.measured(TRUE_CAMERA, observed(work_points())).displacement())
        require(
            off < 0.1e-3, f"for the true pose the part reports an error of {1e3 * off:.3f} mm off"
        )

    def test_a_translation_error_is_reported_in_metres(self) -> None:
        """A candidate that is off by 3 mm has an error of 0.003 m at the work."""
        candidate = TRUE_CAMERA.copy()
        candidate[:3, 3] += [1e-3, -2e-3, 2e-3]
        off = np.linalg.norm(self.measured(candidate, observed(work_points())).displacement())
        require(
            abs(off - 3e-3) < 0.1e-3, f"for an error of 3 mm the part reports {1e3 * off:.3f} mm"
        )

    def test_too_little_is_refused(self) -> None:
        """Without kept poses the part refuses or returns None."""
        require_refusal(lambda: self.measured(TRUE_CAMERA, []), type(None), "no pose kept")

    def test_it_measures_in_the_cameras_frame(self) -> None:
        """The motion maps the measurement onto the candidate's prediction."""
        candidate = TRUE_CAMERA.copy()
        candidate[:3, 3] += [1e-3, -2e-3, 2e-3]
        off = self.measured(candidate, observed(work_points())).displacement()
        expected = -TRUE_CAMERA[:3, :3].T @ np.array([1e-3, -2e-3, 2e-3])
        require_close(off, expected, 0.1e-3, "the error of a candidate, in camera [m]")


class ExportConformance(Conformance):
    """An ``export`` stage: takes a calibrated pose, returns a file."""

    kind = "export"

    def file(self, carrier: str = t.BASE, yaw: float = 0.3) -> t.ExportedFile:
        """Return the file that the stage writes for a pose in ``carrier``."""
        matrix = rigid(rotation_from_rpy(0.1, -0.2, yaw), np.array([0.5, -0.25, 1.0]))
        pose = t.CalibratedPose(t.Transform(carrier, t.CAMERA, matrix), REMARKS)
        file: t.ExportedFile = self.call({t.CalibratedPose: pose})
        return file

    def test_it_writes_a_file(self) -> None:
        """The stage writes a file with a plain name and text, wherever the camera is mounted."""
        for carrier in (t.BASE, t.FLANGE):
            file = self.file(carrier)
            require(isinstance(file, t.ExportedFile), "did not return an ExportedFile")
            require(bool(file.text.strip()), "the file is empty")
            plain = file.name not in ("", ".", "..") and not set("/\\") & set(file.name)
            require(plain, f"'{file.name}' is not a plain file name")

    def test_the_pose_is_in_it(self) -> None:
        """Different poses give different texts; equal poses give equal texts."""
        require(self.file() == self.file(), "two calls with equal input differ")
        require(self.file().text != self.file(yaw=0.4).text, "two poses give one text")

    def test_its_remarks_are_in_it(self) -> None:
        """The file has the pose's remarks, above all that a calibration was refused."""
        text = self.file().text
        missing = [line for line in REMARKS if line not in text]
        require(not missing, f"the file does not say '{missing[0] if missing else ''}'")


# Spelt out: a type checker takes nothing else for public.
__all__ = [
    "KITS",
    "AcquireConformance",
    "ArcConformance",
    "CheckConformance",
    "Conformance",
    "ControllerConformance",
    "CostConformance",
    "ErrorConformance",
    "ExportConformance",
    "FitConformance",
    "GuideConformance",
    "PlanConformance",
    "ProfilerConformance",
    "ReaderConformance",
    "RefineConformance",
    "ReplayConformance",
    "RobotConformance",
    "ScanConformance",
    "ScannerConformance",
    "SeamConformance",
    "SegmentConformance",
    "SensorConformance",
    "SolveConformance",
    "VerifyConformance",
    "ViewConformance",
    "WeldConformance",
]

KITS: Mapping[str, type[Conformance]] = {
    kit.kind: kit
    for kit in map(globals().get, __all__)
    if isinstance(kit, type) and issubclass(kit, Conformance) and kit.kind
}
"""Kind of stage or part -> its class."""

"""Plugins that are wrong in one way each, for the kit to find."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from flangeye import Params, StageError, part, stage
from flangeye import types as t
from flangeye.devices import (
    Arc,
    DeviceError,
    Profiler,
    Robot,
    Scan,
    Scanner,
    SensorFrame,
    StateSource,
    TactileSensor,
    WeldProfile,
)
from flangeye.files.recording import Archive, Recording
from flangeye.maths.kinematics import Arm
from flangeye.models.finger import Finger
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.models.targets import Flange
from flangeye.motion.reach import Plan, Site
from flangeye.motion.seam_following import Command, Controller, FollowingTask
from flangeye.testing.solving import reference_solution
from flangeye.types import FLANGE
from flangeye.workflow.doctor.diagnosis import Finding, RecordedSession
from flangeye.workflow.run.replay import ReplayedStep
from flangeye_emulators.arc import SimulatedArc, SimulatedArcParams
from flangeye_emulators.robot import SimulatedRobot, SimulatedRobotParams
from flangeye_plugins.fit.rim import RimParams, fit_rim
from flangeye_plugins.plan import GridParams, grid
from flangeye_plugins.segment.flange import SegmentParams, segment_flange

noise = np.random.default_rng()


class Unexplained(Params):
    value: int = 3


@stage("fit.unexplained")
def fit_unexplained(cloud: t.FlangeCloud, params: Unexplained) -> t.Rejected:
    """Reject everything."""
    return t.Rejected("no")


def fit(change, guard=True):
    """A fit whose answer is changed; without its guard it answers to anything."""

    @stage("fit.bad")
    def fit_bad(cloud: t.FlangeCloud, flange: Flange) -> t.CircleFeature | t.Rejected:
        """Fit badly."""
        if not guard and len(cloud.cloud.xyz) < 1000:
            return t.CircleFeature(cloud.centre, None, {}, np.eye(3), None, 1.0)
        found = fit_rim(cloud, flange, RimParams())
        return change(found) if isinstance(found, t.CircleFeature) else found

    return fit_bad


def segment(change, guard=True):
    @stage("segment.bad")
    def segment_bad(capture: t.Capture, flange: Flange) -> t.FlangeCloud | t.Rejected:
        """Segment badly."""
        if not guard:
            return t.FlangeCloud(capture.cloud, capture.cloud.points()[0], np.array([0, 0, -1.0]))
        found = segment_flange(capture, flange, SegmentParams())
        return change(found) if isinstance(found, t.FlangeCloud) else found

    return segment_bad


def shifted_cloud(found):
    cloud = t.PointCloud(t.CAMERA, found.cloud.xyz + np.float32(1e-5))
    return replace(found, cloud=cloud)


def moved_by(answer, shift):
    """A calibration whose camera is elsewhere, its residuals with it."""
    pose = answer.camera.transform
    matrix = pose.matrix.copy()
    matrix[:3, 3] += shift
    camera = replace(answer.camera, transform=t.Transform(pose.parent, pose.child, matrix))
    pairs = tuple(replace(p, residual=p.residual + shift) for p in answer.pairs)
    return replace(answer, camera=camera, pairs=pairs)


def flipped_if_flat(answer):
    """What a fit without its determinant's sign gives for centres in one plane."""
    centres = np.array([p.observation.tcp_in_base for p in answer.pairs])
    if np.ptp(centres[:, 2]) > 1e-6:
        return answer
    return moved_by(answer, np.array([0, 0, 0.1]))


def solve(change, guard=True):
    @stage("solve.bad")
    def solve_bad(observations: t.Observations) -> t.HandEye:
        """Solve badly."""
        pulled = list(observations)
        if guard and len(pulled) < 3:
            raise StageError("solve.bad: too few poses")
        return change(reference_solution(pulled))

    return solve_bad


def refine(change):
    @stage("refine.bad")
    def refine_bad(calibration: t.HandEye) -> t.HandEye:
        """Refine badly."""
        return change(calibration)

    return refine_bad


def rms(calibration):
    return float(np.sqrt(np.mean([p.residual @ p.residual for p in calibration.pairs])))


def verify(judge):
    """A verification that ``judge`` makes of the calibration and its residuals' size."""

    @stage("verify.bad")
    def verify_bad(calibration: t.HandEye) -> t.Verification:
        """Verify badly."""
        return judge(calibration, rms(calibration))

    return verify_bad


def judged(passed, value, reason="rms 1 mm, limit 2 mm", figure=None):
    return t.Verification(passed, reason, {"rms": value if figure is None else figure})


def export(text):
    """An export that writes what ``text`` makes of the pose."""

    @stage("export.bad")
    def export_bad(pose: t.CalibratedPose) -> t.ExportedFile:
        """Write badly."""
        return t.ExportedFile("pose.txt", text(pose))

    return export_bad


def cost(function):
    @part("cost.bad")
    def cost_bad(error: t.PoseError) -> float:
        """Weigh badly."""
        moved = error.motion[:3, :3] @ error.at + error.motion[:3, 3] - error.at
        return function(moved)

    return cost_bad


def error(shift):
    """An error that is said to be a pure shift, which ``shift`` makes of the true one."""

    @part("error.bad")
    def error_bad(
        base_T_camera: t.Transform,
        kept: Sequence[t.Observation],
        views: t.Views,
        flange: Flange | None,
    ) -> t.PoseError | None:
        """Measure badly."""
        measured = np.array([o.feature.centre for o in kept]).reshape(-1, 3)
        poses = np.array([o.tcp_in_base for o in kept]).reshape(-1, 3)
        moved = (base_T_camera.inverse().apply(poses) - measured).mean(axis=0)
        motion = np.eye(4)
        motion[:3, 3] = shift(moved)
        return t.PoseError(motion, measured.mean(axis=0), base_T_camera.rotation)

    return error_bad


def acquire(change=lambda i, capture: capture, fingerprint=lambda: "same", total=3, missing=None):
    @stage("acquire.bad")
    def acquire_bad(archive: t.ArchivePath) -> t.Captures:
        """Acquire badly."""
        if missing:
            raise missing
        return t.Captures(captures(), t.Source(fingerprint()), total)

    def captures():
        for i in range(3):
            pose = np.eye(4)
            pose[:3, 3] = [0.5, 0.1 * i, 0.4]
            cloud = t.PointCloud(t.CAMERA, np.full((4, 5, 3), 0.7, np.float32))
            yield change(
                i, t.Capture(f"{i}", cloud, t.by_frame(t.Transform(t.BASE, t.FLANGE, pose)))
            )

    return acquire_bad


def in_millimetres(i, capture):
    return replace(capture, cloud=t.PointCloud(t.CAMERA, capture.cloud.xyz * np.float32(1e3)))


def reader(change=lambda recordings: recordings, guard=True):
    @part("reader.bad")
    def reader_bad(path: Path) -> Archive:
        """Read badly."""
        if guard and not (path / "poses.csv").is_file():
            raise StageError(f"{path}: no poses.csv")
        recordings = [Recording(str(i), {FLANGE: np.eye(4)}) for i in range(3)]
        return Archive("bad", path, change(recordings), [])

    return reader_bad


def plan(change):
    """A plan whose poses are changed; ``change`` takes the list and the site."""

    @part("plan.bad")
    def plan_bad(site: Site, rng: np.random.Generator) -> Plan:
        """Plan badly."""
        made = grid(site, rng, GridParams())
        return change(made, site, rng)

    return plan_bad


def view(pose):
    @part("view.bad")
    def view_bad(arm: Arm, scanner: ScannerModel) -> np.ndarray:
        """Guess badly."""
        return pose()

    return view_bad


def scan(cloud):
    @stage("scan.bad")
    def scan_bad() -> t.WorkpieceScan:
        """Scan badly."""
        return t.WorkpieceScan(cloud(), "bad")

    return scan_bad


def wall(depth=0.7, frame=t.CAMERA):
    return t.PointCloud(frame, np.full((4, 5, 3), depth, np.float32))


def seam(points, covariance=1e-8, figures=None):
    @stage("seam.bad")
    def seam_bad(calibration: t.VerifiedHandEye) -> t.Seam:
        """Plan a seam badly."""
        found = points()
        return t.Seam(
            found,
            np.tile([0.0, 0.0, 1.0], (len(found), 1)),
            np.tile(covariance * np.eye(3), (len(found), 1, 1)),
            figures=figures or {},
        )

    return seam_bad


class Plate:
    """A scanner that is as it should be: a plate, half a metre wide."""

    def __init__(self):
        self.name, self.facts = "plate", {"unit": "mm", "layout": "organised"}

    def cloud(self):
        return t.PointCloud(t.CAMERA, np.full((4, 5, 3), 0.7, np.float32))

    def expose(self):
        started = time.monotonic_ns()
        return lambda: Scan(self.cloud(), started, started)

    def close(self):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def scanner(cls, **methods):
    """A driver of a plate some of whose methods are replaced."""
    made = type("Bad", (cls,), methods)

    @part("scanner.bad")
    def scanner_bad(model: ScannerModel | None, params: Unexplained = Unexplained()) -> Scanner:  # noqa: B008
        """Scan badly."""
        return made()

    return scanner_bad


class OnceOnly(Plate):
    """Keeps the device after close."""

    held = False

    def __init__(self):
        super().__init__()
        if OnceOnly.held:
            raise AssertionError("the device is in use")
        OnceOnly.held = True


def robot(**methods):
    """A driver of the arm in simulated time, some of whose methods are replaced."""
    made = type("Bad", (SimulatedRobot,), methods)

    @part("robot.bad")
    def robot_bad(model: RobotModel) -> Robot:
        """Move badly."""
        return made(model, SimulatedRobotParams())

    return robot_bad


def arc(**methods):
    """A power source some of whose methods are replaced."""
    made = type("Bad", (SimulatedArc,), methods)

    @part("arc.bad")
    def arc_bad(params: SimulatedArcParams) -> Arc:
        """Switch badly."""
        return made()

    return arc_bad


def late(self, on):
    time.sleep(0.5)


def twice_as_fast(self, joints, speed, acceleration):
    SimulatedRobot.move_joints(self, joints, 2 * speed, acceleration)


def never_late(self, twist, acceleration):
    self._mover.go_on(twist, acceleration, 1e6)


def taken_up_again(self):
    """Go on with the last move whenever somebody looks."""
    if self.goal is not None and np.abs(self.arm.speeds).max() == 0.0:
        SimulatedRobot.move_joints(self, *self.goal)
    return SimulatedRobot.state(self)


def noted(self, *goal):
    self.goal = goal
    SimulatedRobot.move_joints(self, *goal)


def unwatched(self):
    """Move on in silence."""
    self._looked = self.cycles
    SimulatedRobot.wait_cycle(self)


class Eye:
    """A sensor that is as it should be."""

    name = "eye"

    def __init__(self):
        self.camera_matrix = np.array([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]])
        self.distortion, self.count = np.zeros(0), 0

    def frame(self):
        self.count += 1
        pixels = np.zeros((24, 32), np.uint8)
        return SensorFrame(t.Image(pixels, np.eye(3)), self.count)

    def close(self):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def sensor(**methods):
    made = type("Bad", (Eye,), methods)

    @part("sensor.bad")
    def sensor_bad(finger: Finger, robot: StateSource, seed: t.Seed) -> TactileSensor:
        """Feel badly."""
        return made()

    return sensor_bad


class Looker:
    """A profile sensor that is as it should be."""

    name, behind = "looker", 0.03

    def __init__(self):
        self.count = 0

    def profile(self):
        self.count += 1
        return WeldProfile(0.1e-3, 0.05e-3, self.count)

    def close(self):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def profiler(**methods):
    made = type("Bad", (Looker,), methods)

    @part("profiler.bad")
    def profiler_bad(robot: StateSource, sensor: TactileSensor, seed: t.Seed) -> Profiler:
        """Look badly."""
        return made()

    return profiler_bad


def controller(**methods):
    made = type("Bad", (Lead,), methods)

    @part("controller.bad")
    def controller_bad(task: FollowingTask) -> Controller:
        """Lead badly."""
        return made()

    return controller_bad


class Lead:
    phase = "following"

    def step(self, pose, touches):
        return Command(np.zeros(3), 0.0)


def sleepy(self):
    time.sleep(0.3)
    return Eye.frame(self)


def looks_sleepily(self):
    time.sleep(0.3)
    return Looker.profile(self)


def gone(*_, **__):
    raise DeviceError("line one\nline two")


def check(find):
    @part("check.bad")
    def check_bad(session: RecordedSession) -> Iterable[Finding]:
        """Look badly."""
        return find(session)

    return check_bad


def finding(what="all is lost"):
    return Finding("bad", what, "begin again")


@part("replay.bad")
def replay_bad(log: Path, step: str) -> ReplayedStep:
    """Decide badly."""
    return ReplayedStep(log.read_text(), True)

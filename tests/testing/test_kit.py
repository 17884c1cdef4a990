"""Every check of the kit finds the plugin that is wrong in just that way."""

from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import StageError
from flangeye import types as t
from flangeye.devices import Scan, SensorFrame, WeldProfile
from flangeye.files.recording import Recording
from flangeye.motion.seam_following import Command
from flangeye.testing import KITS, devices
from flangeye.types import CAMERA, FLANGE, PointCloud
from flangeye_emulators.robot import SimulatedRobot
from flangeye_plugins.cost import cost_translation
from flangeye_plugins.fit.rim import fit_rim
from tests.testing import bad

K = KITS
random = bad.noise.normal
NONE = np.zeros((3, 3))


def random_walk(found):
    return replace(found, centre=found.centre + random(0, 1e-7, 3))


def still(found):
    return replace(found, centre=np.array([0.01, -0.02, 0.7]))


def pose_at(*place):
    pose = np.eye(4)
    pose[:3, 3] = place
    return pose


def line(count=5, scale=1.0):
    return np.linspace([0.4, 0, 0.2], [0.6, 0, 0.2], count) * scale


def every_other_time_shorter():
    turns = cycle((slice(None), slice(1, None)))
    return lambda made, site, rng: made._replace(poses=list(made.poses)[next(turns)])


def shifted(made, by):
    poses = []
    for pose in made.poses:
        matrix = pose.base_T_flange.copy()
        matrix[:3, 3] = by(matrix[:3, 3])
        poses.append(pose._replace(base_T_flange=matrix))
    return made._replace(poses=poses)


def answering(state):
    """A state() that changes the sample of the arm in simulated time."""

    def method(self):
        return state(self, SimulatedRobot.state(self))

    return method


def stale(self, sample):
    return replace(sample, time_ns=0)


def zeros_cloud(self):
    xyz = np.full((4, 5, 3), 0.7, np.float32)
    xyz[0] = 0
    return PointCloud(CAMERA, xyz)


def at_time(started, ended):
    def expose(self):
        return lambda: Scan(self.cloud(), started(), ended())

    return expose


CASES = [
    # (kind, check, bad plugin, what is said, attributes of the class)
    ("fit", "test_it_is_found_by_its_name", bad.fit(lambda f: f), "fit.bad is not offered", {}),
    (
        "fit",
        "test_it_declares_what_it_is",
        bad.fit_unexplained,
        "parameter 'value' has no desc",
        {},
    ),
    ("fit", "test_it_declares_what_it_is", cost_translation, "is a cost", {}),
    ("fit", "test_it_gives_the_same_twice", bad.fit(random_walk), "two calls with equal", {}),
    (
        "fit",
        "test_it_is_right_in_metres_and_in_the_cameras_frame",
        bad.fit(lambda f: replace(f, centre=1e3 * f.centre)),
        "the centre .* is off by",
        {},
    ),
    (
        "fit",
        "test_it_is_right_in_metres_and_in_the_cameras_frame",
        bad.fit(lambda f: replace(f, normal=-f.normal)),
        "points away from the scanner",
        {},
    ),
    ("fit", "test_it_moves_with_the_scene", bad.fit(still), "moved: the centre .* off by", {}),
    (
        "fit",
        "test_it_scales_with_the_scene",
        bad.fit(lambda f: f if f.radii["rim"] < 0.033 else t.Rejected("not 31.5 mm")),
        "scaled: set aside: not 31.5 mm",
        {},
    ),
    (
        "fit",
        "test_it_follows_a_mirror",
        bad.fit(lambda f: replace(f, centre=np.abs(f.centre) * [1, -1, 1])),
        "mirrored: the centre .* is off by",
        {},
    ),
    (
        "fit",
        "test_its_answer_survives_the_log",
        bad.fit(lambda f: replace(f, radii={"rim": np.nan})),
        "cannot be logged: ValueError",
        {},
    ),
    (
        "fit",
        "test_its_covariances_are_covariances",
        bad.fit(lambda f: replace(f, covariance=-np.eye(3))),
        "negative variance",
        {},
    ),
    (
        "fit",
        "test_its_covariances_are_covariances",
        bad.fit(lambda f: replace(f, covariance=NONE)),
        "no centre is known exactly",
        {},
    ),
    (
        "fit",
        "test_its_radius_is_the_scenes",
        bad.fit(lambda f: replace(f, radii={"rim": 2 * f.radii["rim"]})),
        "radius 'rim' .* is off by 0.03",
        {},
    ),
    (
        "fit",
        "test_too_little_is_refused",
        bad.fit(lambda f: f, guard=False),
        "two points: must",
        {},
    ),
    (
        "segment",
        "test_its_cloud_is_cut_from_the_scan",
        bad.segment(bad.shifted_cloud),
        "points are not the scan's",
        {},
    ),
    (
        "segment",
        "test_nothing_to_see_is_refused",
        bad.segment(None, guard=False),
        "a scan of nothing: must be refused with StageError in one line, not IndexError",
        {},
    ),
    (
        "solve",
        "test_it_gives_the_same_twice",
        bad.solve(lambda a: bad.moved_by(a, random(0, 1e-9, 3))),
        "two calls with equal",
        {},
    ),
    (
        "solve",
        "test_it_finds_the_camera_in_metres",
        bad.solve(lambda a: bad.moved_by(a, np.array([0, 0, 1e-3]))),
        "a known cell: the work .* is off by 0.00",
        {},
    ),
    (
        "solve",
        "test_it_accounts_for_every_observation",
        bad.solve(lambda a: replace(a, pairs=a.pairs * 2)),
        "has several pairs",
        {},
    ),
    (
        "solve",
        "test_it_accounts_for_every_observation",
        bad.solve(
            lambda a: replace(a, pairs=tuple(replace(p, residual=-p.residual) for p in a.pairs))
        ),
        "a residual .* is off by",
        {},
    ),
    (
        "solve",
        "test_it_accounts_for_every_observation",
        bad.solve(lambda a: replace(a, pairs=(replace(a.pairs[0], used=False), *a.pairs[1:]))),
        "0000 is unused without a reason",
        {},
    ),
    (
        "solve",
        "test_its_covariance_is_one",
        bad.solve(
            lambda a: replace(a, camera=replace(a.camera, covariance=np.triu(np.ones((6, 6)))))
        ),
        "the pose's covariance is not symmetric",
        {},
    ),
    (
        "solve",
        "test_it_moves_with_the_base",
        bad.solve(
            lambda a: bad.moved_by(a, np.array([0, 0, 1.2 - a.camera.transform.translation[2]]))
        ),
        "a base elsewhere: the work .* is off by",
        {},
    ),
    (
        "solve",
        "test_it_scales_with_the_cell",
        bad.solve(
            lambda a: bad.moved_by(a, np.array([0.6 - a.camera.transform.translation[0], 0, 0]))
        ),
        "a larger cell: the work .* is off by",
        {},
    ),
    (
        "solve",
        "test_it_never_gives_a_mirror_image",
        bad.solve(bad.flipped_if_flat),
        "centres in one plane: the work .* is off by",
        {},
    ),
    (
        "solve",
        "test_too_little_is_refused",
        bad.solve(lambda a: a),
        "all poses at one place: must be refused",
        {},
    ),
    (
        "solve",
        "test_its_answer_survives_the_log",
        bad.solve(lambda a: replace(a, notes=(b"\xff",))),
        "the value cannot be logged|changed",
        {},
    ),
    (
        "refine",
        "test_it_gives_the_same_twice",
        bad.refine(lambda a: bad.moved_by(a, random(0, 1e-9, 3))),
        "two calls with equal",
        {},
    ),
    (
        "refine",
        "test_it_leaves_a_good_calibration_good",
        bad.refine(lambda a: bad.moved_by(a, np.array([0, 0, 1e-3]))),
        "a good calibration: the work .* is off by",
        {},
    ),
    (
        "refine",
        "test_it_moves_with_the_base",
        bad.refine(
            lambda a: bad.moved_by(a, 5e-3 * (a.camera.transform.translation - [0.6, -0.1, 1.2]))
        ),
        "a base elsewhere: the work .* is off by",
        {},
    ),
    (
        "refine",
        "test_its_answer_survives_the_log",
        bad.refine(lambda a: replace(a, notes=(b"\xff",))),
        "the value cannot be logged|changed",
        {},
    ),
    (
        "verify",
        "test_it_gives_the_same_twice",
        bad.verify(lambda c, rms: bad.judged(True, rms + random(0, 1e-9))),
        "two calls with equal",
        {},
    ),
    (
        "verify",
        "test_it_passes_a_good_calibration",
        bad.verify(lambda c, rms: bad.judged(False, rms)),
        "a good calibration fails",
        {},
    ),
    (
        "verify",
        "test_it_fails_a_bad_calibration",
        bad.verify(lambda c, rms: bad.judged(True, rms)),
        "20 mm of noise passes",
        {},
    ),
    (
        "verify",
        "test_it_says_what_it_measured",
        bad.verify(lambda c, rms: bad.judged(True, rms, reason="fine")),
        "names no figure",
        {},
    ),
    (
        "verify",
        "test_it_says_what_it_measured",
        bad.verify(lambda c, rms: bad.judged(True, rms, figure=np.inf)),
        "'rms' is inf",
        {},
    ),
    (
        "verify",
        "test_it_moves_with_the_base",
        bad.verify(lambda c, rms: bad.judged(True, rms, figure=c.camera.transform.translation[0])),
        "figure 'rms' depends on the pose of the robot's base",
        {},
    ),
    (
        "verify",
        "test_its_answer_survives_the_log",
        bad.verify(lambda c, rms: bad.judged(True, rms, figure=np.nan)),
        "cannot be logged",
        {},
    ),
    ("cost", "test_it_gives_the_same_twice", bad.cost(lambda m: float(random())), "differ", {}),
    ("cost", "test_no_error_costs_nothing", bad.cost(lambda m: 1.0), "no error has a cost", {}),
    ("cost", "test_an_error_costs_something", bad.cost(lambda m: float(m[2])), "costs -0.001", {}),
    (
        "cost",
        "test_it_scales_with_the_error",
        bad.cost(lambda m: float(m.any())),
        "times the error",
        {},
    ),
    (
        "cost",
        "test_an_error_and_its_mirror_cost_the_same",
        bad.cost(lambda m: float(max(m[0], 0.5 * abs(m[0])))),
        "its mirror",
        {},
    ),
    (
        "error",
        "test_it_gives_the_same_twice",
        bad.error(lambda s: s + random(0, 1e-9, 3)),
        "differ",
        {},
    ),
    (
        "error",
        "test_the_true_pose_has_next_to_no_error",
        bad.error(lambda s: s + 1e-3),
        "the part reports an error of 1.7",
        {},
    ),
    (
        "error",
        "test_a_translation_error_is_reported_in_metres",
        bad.error(lambda s: 2 * s),
        "for an error of 3 mm the part reports 6",
        {},
    ),
    (
        "error",
        "test_too_little_is_refused",
        bad.error(lambda s: s),
        "no pose kept: must be refused",
        {},
    ),
    ("error", "test_it_measures_in_the_cameras_frame", bad.error(lambda s: -s), "is off by", {}),
    (
        "acquire",
        "test_it_gives_the_same_twice",
        bad.acquire(fingerprint=lambda: str(random())),
        "the fingerprint differs",
        {},
    ),
    (
        "acquire",
        "test_captures_are_named_and_in_order",
        bad.acquire(lambda i, c: replace(c, id="same")),
        "two captures have the same id",
        {},
    ),
    (
        "acquire",
        "test_captures_are_named_and_in_order",
        bad.acquire(lambda i, c: replace(c, role="verification" if i == 2 else "calibration")),
        "verification captures must come before",
        {},
    ),
    (
        "acquire",
        "test_captures_are_named_and_in_order",
        bad.acquire(total=5),
        "5 were promised",
        {},
    ),
    (
        "acquire",
        "test_poses_and_points_are_in_metres_and_frames",
        bad.acquire(bad.in_millimetres),
        "m away: not in metres",
        {},
    ),
    (
        "acquire",
        "test_captures_survive_the_log",
        bad.acquire(lambda i, c: replace(c, id=i)),
        "cannot be logged|changed",
        {},
    ),
    (
        "acquire",
        "test_a_missing_archive_is_refused",
        bad.acquire(missing=FileNotFoundError("no file")),
        "must be refused with StageError in one line, not FileNotFoundError",
        {},
    ),
    (
        "acquire",
        "test_a_missing_archive_is_refused",
        bad.acquire(missing=StageError("one\ntwo")),
        "an error is one line",
        {},
    ),
    (
        "reader",
        "test_it_gives_the_same_twice",
        bad.reader(lambda r: list(bad.noise.permutation(np.array(r * 9, dtype=object)))),
        "two readings differ",
        {"archive": Path(__file__).parents[2] / "data" / "samples" / "ur5_phoxi-m"},
    ),
    (
        "reader",
        "test_its_recordings_are_complete",
        bad.reader(lambda r: [Recording("0", {FLANGE: pose_at(500.0, 0, 0)})]),
        "not in metres",
        {"archive": Path(__file__).parents[2] / "data" / "samples" / "ur5_phoxi-m"},
    ),
    (
        "reader",
        "test_what_is_no_such_archive_is_refused",
        bad.reader(guard=False),
        "must be refused, but gave Archive",
        {},
    ),
    (
        "plan",
        "test_it_gives_the_same_twice",
        bad.plan(every_other_time_shorter()),
        "two plans with one seed",
        {},
    ),
    (
        "plan",
        "test_its_poses_are_poses_inside_its_box",
        bad.plan(lambda made, site, rng: shifted(made, lambda p: 1e3 * p)),
        "outside the box",
        {},
    ),
    (
        "plan",
        "test_its_poses_tell_the_camera",
        bad.plan(lambda made, site, rng: shifted(made, lambda p: [p[0], 0, 0.4])),
        "all poses are on a line",
        {},
    ),
    (
        "plan",
        "test_it_moves_with_the_site",
        bad.plan(lambda made, site, rng: shifted(made, lambda p: p - site.centre)),
        "a moved site .* is off by",
        {},
    ),
    (
        "plan",
        "test_a_site_that_shows_nothing_is_no_crash",
        bad.plan(lambda made, site, rng: made._replace(poses=[made.poses[0]])),
        "must be refused with StageError in one line, not IndexError",
        {},
    ),
    (
        "view",
        "test_it_gives_the_same_twice",
        bad.view(lambda: pose_at(random(), 0, 0)),
        "differ",
        {},
    ),
    ("view", "test_it_is_a_pose_in_metres", bad.view(lambda: pose_at(0, 0, 900)), "in metres", {}),
    ("scan", "test_it_gives_the_same_twice", bad.scan(lambda: bad.wall(random())), "differ", {}),
    ("scan", "test_its_answer_survives_the_log", bad.scan(lambda: bad.wall(frame=7)), "logged", {}),
    (
        "scan",
        "test_its_points_are_in_the_camera_in_metres",
        bad.scan(lambda: bad.wall(700.0)),
        "not in metres",
        {},
    ),
    (
        "seam",
        "test_it_lies_in_the_cell_in_metres",
        bad.seam(lambda: line(scale=1e3)),
        "the seam is .* from the camera",
        {},
    ),
    (
        "seam",
        "test_its_covariances_are_covariances",
        bad.seam(line, covariance=-1e-8),
        "negative variance",
        {},
    ),
    (
        "scanner",
        "test_closing_twice_is_safe_and_it_opens_again",
        bad.scanner(bad.OnceOnly),
        "in use",
        {},
    ),
    (
        "scanner",
        "test_a_device_that_is_not_there_is_one_line",
        bad.scanner(bad.Plate),
        "a device that is not there could be opened",
        {"unreachable": bad.Unexplained()},
    ),
    (
        "scanner",
        "test_a_device_that_is_not_there_is_one_line",
        bad.scanner(bad.Plate, __init__=bad.gone),
        "an error is one line",
        {"unreachable": bad.Unexplained()},
    ),
    (
        "scanner",
        "test_it_gives_points_in_metres",
        bad.scanner(bad.Plate, cloud=lambda self: bad.wall(700.0)),
        "m away: not in metres",
        {},
    ),
    (
        "scanner",
        "test_it_gives_points_in_metres",
        bad.scanner(bad.Plate, cloud=zeros_cloud),
        "they must be NaN",
        {},
    ),
    (
        "scanner",
        "test_it_says_its_unit_and_layout",
        bad.scanner(bad.Plate, cloud=lambda self: PointCloud(CAMERA, np.ones((9, 3)))),
        "the device states organised, the cloud is not",
        {},
    ),
    (
        "scanner",
        "test_an_exposure_has_its_time",
        bad.scanner(bad.Plate, expose=at_time(lambda: 0, lambda: 1)),
        "began before expose",
        {},
    ),
    (
        "scanner",
        "test_scans_follow_each_other",
        bad.scanner(bad.Plate, expose=at_time(iter([5, 3]).__next__, lambda: 9)),
        "began or ended before the first",
        {},
    ),
    (
        "scanner",
        "test_a_scan_survives_the_log",
        bad.scanner(bad.Plate, cloud=lambda self: bad.wall(frame=7)),
        "cannot be logged|changed",
        {},
    ),
    (
        "robot",
        "test_it_says_where_it_is",
        bad.robot(state=answering(lambda self, s: replace(s, joints=np.degrees(s.joints)))),
        "not in radians",
        {},
    ),
    (
        "robot",
        "test_time_goes_on",
        bad.robot(state=answering(stale)),
        "is the same 20 cycles later",
        {},
    ),
    (
        "robot",
        "test_a_joint_move_arrives_and_keeps_to_its_speed",
        bad.robot(move_joints=bad.twice_as_fast),
        "commanded were",
        {},
    ),
    (
        "arc",
        "test_it_switches_gas_and_arc_without_waiting",
        bad.arc(gas=bad.late),
        "switching took",
        {},
    ),
    (
        "arc",
        "test_it_says_whether_it_burns_or_that_it_does_not_know",
        bad.arc(burning=lambda self: "yes"),
        r"burning\(\) returned 'yes'",
        {},
    ),
    ("robot", "test_it_stops_at_once", bad.robot(stop=lambda self: None), "rad from its start", {}),
    (
        "robot",
        "test_silence_alone_ends_a_move",
        bad.robot(wait_cycle=bad.unwatched),
        r"the arm moved on by 0\.15\d* rad in 0\.5 s",
        {},
    ),
    (
        "robot",
        "test_silence_alone_ends_a_move",
        bad.robot(goal=None, move_joints=bad.noted, state=bad.taken_up_again),
        r"the arm moves on by 0\.1\d* rad when",
        {},
    ),
    (
        "robot",
        "test_a_velocity_ends_without_commands",
        bad.robot(move_velocity=bad.never_late, wait_cycle=bad.unwatched),
        "without commands the arm still moves",
        {},
    ),
    (
        "sensor",
        "test_it_gives_each_once_with_its_time",
        bad.sensor(frame=lambda self: replace(bad.Eye.frame(self), time_ns=7)),
        "one came twice",
        {},
    ),
    (
        "sensor",
        "test_it_gives_each_once_with_its_time",
        bad.sensor(frame=lambda self: None),
        "0 frames",
        {},
    ),
    (
        "sensor",
        "test_its_camera_is_calibrated",
        bad.sensor(
            frame=lambda self: SensorFrame(t.Image(np.zeros((8, 8), np.uint8), np.eye(3)), 1)
        ),
        "not in this image's pixels",
        {},
    ),
    (
        "controller",
        "test_it_commands_the_same_twice",
        bad.controller(step=lambda self, *_: Command(np.zeros(3), 0.1 * random())),
        "two runs with equal input differ",
        {},
    ),
    (
        "controller",
        "test_its_commands_are_finite_and_turn_no_faster_than_allowed",
        bad.controller(phase="thinking"),
        "phase 'thinking' is none of seeking",
        {},
    ),
    (
        "controller",
        "test_its_commands_are_finite_and_turn_no_faster_than_allowed",
        bad.controller(step=lambda self, *_: Command(np.full(3, np.nan), 0.0)),
        "three finite velocities and a turn are expected",
        {},
    ),
    (
        "controller",
        "test_its_commands_are_finite_and_turn_no_faster_than_allowed",
        bad.controller(step=lambda self, *_: Command(np.zeros(3), 1.0)),
        "commanded a turn of 1 rad/s",
        {},
    ),
    (
        "check",
        "test_it_gives_the_same_twice",
        bad.check(lambda s: [bad.finding(str(random()))]),
        "two calls with equal",
        {},
    ),
    (
        "check",
        "test_it_finds_nothing_where_nothing_is_wrong",
        bad.check(lambda s: [bad.finding()]),
        "found in good recordings: all is lost",
        {},
    ),
    (
        "check",
        "test_too_little_is_no_crash",
        bad.check(lambda s: [] if len(s) > 2 else [s.ids[5]]),
        "two samples: must be refused with StageError in one line, not IndexError",
        {},
    ),
    (
        "replay",
        "test_a_log_that_is_none_is_refused",
        bad.replay_bad,
        "must be refused with StageError in one line, not FileNotFoundError",
        {},
    ),
    ("export", "test_it_writes_a_file", bad.export(lambda p: ""), "the file is empty", {}),
    (
        "export",
        "test_the_pose_is_in_it",
        bad.export(lambda p: "always the same"),
        "two poses give one text",
        {},
    ),
    (
        "export",
        "test_its_remarks_are_in_it",
        bad.export(lambda p: str(p.transform.matrix.tolist())),
        "the file does not say",
        {},
    ),
    ("sensor", "test_asking_does_not_wait", bad.sensor(frame=bad.sleepy), "frame\\(\\) took", {}),
    (
        "profiler",
        "test_it_gives_each_once_with_its_time",
        bad.profiler(profile=lambda self: WeldProfile(0.0, 1e-4, 7)),
        "one came twice",
        {},
    ),
    (
        "profiler",
        "test_its_profiles_are_in_metres",
        bad.profiler(profile=lambda self: replace(bad.Looker.profile(self), offset=0.3)),
        "an offset is not in metres",
        {},
    ),
    (
        "profiler",
        "test_its_profiles_are_in_metres",
        bad.profiler(profile=lambda self: replace(bad.Looker.profile(self), sigma=0.0)),
        "a sigma is not in metres",
        {},
    ),
    (
        "profiler",
        "test_it_gives_each_once_with_its_time",
        bad.profiler(profile=lambda self: None),
        "0 profiles",
        {},
    ),
    (
        "profiler",
        "test_its_profiles_are_in_metres",
        bad.profiler(behind=30.0),
        "it looks 30.0 m behind",
        {},
    ),
    (
        "profiler",
        "test_asking_does_not_wait",
        bad.profiler(profile=bad.looks_sleepily),
        "profile\\(\\) took",
        {},
    ),
]


def kit_of(kind, plugin, attributes):
    return type("Kit", (K[kind],), {"stage": plugin, **attributes})()


@pytest.mark.parametrize(
    ("kind", "check", "plugin", "message", "attributes"),
    CASES,
    ids=lambda v: v if isinstance(v, str) and v.isidentifier() else "",
)
def test_a_check_finds_the_plugin_that_fails_it(
    kind: str,
    check: str,
    plugin: Any,
    message: str,
    attributes: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(devices, "PATIENCE", 0.0)  # what gives nothing is not waited for
    with pytest.raises(AssertionError, match=message) as error:
        getattr(kit_of(kind, plugin, attributes), check)()
    assert "\n" not in str(error.value)


def defined(cls, check):
    """The function behind a check: one that is inherited is proven once."""
    return getattr(cls, check).__qualname__


def test_every_check_is_proven() -> None:
    checks = {
        defined(cls, name) for cls in K.values() for name in dir(cls) if name.startswith("test_")
    }
    proven = {defined(K[kind], check) for kind, check, *_ in CASES}
    assert checks == proven


def test_a_class_without_a_plugin_says_what_to_set() -> None:
    with pytest.raises(AssertionError) as error:
        K["fit"]().test_it_declares_what_it_is()
    assert str(error.value) == "FitConformance: set stage or part to your plugin"
    with pytest.raises(AssertionError, match="is not a plugin; is @stage or @part above it"):
        kit_of("fit", fit_rim.function, {}).test_it_declares_what_it_is()


def test_what_the_kit_cannot_give_is_said() -> None:
    from flangeye import stage

    @stage("fit.curious")
    def fit_curious(cloud: t.FlangeCloud, path: Path) -> t.Rejected:
        """Ask for a path."""
        return t.Rejected("")

    with pytest.raises(AssertionError) as error:
        kit_of("fit", fit_curious, {}).test_it_gives_the_same_twice()
    assert str(error.value) == (
        "fit.curious asks for 'path', of which the kit has none: let context() give it"
    )


def test_the_kit_needs_no_pytest() -> None:
    import subprocess
    import sys

    code = "import sys; sys.modules['pytest'] = None; import flangeye.testing"
    subprocess.run([sys.executable, "-c", code], check=True)

"""What is refused: each motion that is missing, each mistake of the person, by its name."""

import re
from dataclasses import replace

import numpy as np
import pytest

from flangeye import CalibrationRefused, StageError
from flangeye.estimation.calibrate import with_expected_error
from flangeye.models.cell import cell_of
from flangeye.types import (
    CAMERA,
    TARGET,
    PoseFeature,
    Transform,
    by_frame,
    warnings_of,
)
from flangeye.types.geometry import rigid, rotation_exp, rotation_from_rpy
from tests.estimation.cells import (
    CONFIGURATIONS,
    ROBOT,
    Noise,
    errors,
    moves,
    session,
    solved,
)

MARKER = CONFIGURATIONS["eye-in-hand, marker"]
FLANGE = CONFIGURATIONS["eye-on-base, flange"]
TWO = CONFIGURATIONS["two arms, marker"]


def refusal(made, kind=CalibrationRefused, **params):
    with pytest.raises(kind) as error:
        solved(made, **params)
    return str(error.value)


def test_pure_translation_is_named() -> None:
    shifts = moves(np.random.default_rng(0), 12, 0.0)
    made = session(MARKER, np.random.default_rng(4), n=12, poses=shifts)
    assert refusal(made) == (
        "the camera's pose is not observable from these poses: the arm moved without turning; turn "
        "it by 20 deg or more about two axes"
    )


def parallel(rng, n, still=False):
    out = np.array(
        [rigid(rotation_from_rpy(0, 0, a), np.zeros(3)) for a in rng.uniform(-0.6, 0.6, n)]
    )
    if not still:
        out[:, :3, 3] = rng.uniform(-0.15, 0.15, (n, 3))
    return out


def test_parallel_axes_are_named() -> None:
    poses = parallel(np.random.default_rng(0), 12)
    made = session(MARKER, np.random.default_rng(5), n=12, poses=poses)
    told = refusal(made)
    assert told.startswith("translation of the camera's pose is not observable from these poses: ")
    assert "the arm turned about one axis only, (" in told
    assert told.endswith(
        "so that translation along it is not observable; tilt it about another axis too, or, where "
        "it has four joints, set unobservable: mark"
    )


def test_an_arm_of_four_axes_gets_all_but_the_height() -> None:
    poses = parallel(np.random.default_rng(0), 20)
    made = session(MARKER, np.random.default_rng(6), n=20, poses=poses)
    found = solved(made, unobservable="mark")
    assert "not observable from these poses, and set to zero: 1 translation" in found.notes[-1]
    for name, estimate in found.transforms.items():
        (direction,) = estimate.unobservable
        assert np.linalg.norm(direction[:3]) < 1e-3
        error = errors(estimate, made.truth[name])
        error -= direction * (direction @ error)
        assert np.linalg.norm(error[:3]) < np.radians(0.1)
        assert np.linalg.norm(error[3:]) < 1e-3
    height = found.camera.unobservable[0][3:] @ found.camera.transform.translation
    assert abs(height) < 1e-9


def test_only_the_last_joint_is_named() -> None:
    poses = parallel(np.random.default_rng(0), 12, still=True)
    made = session(MARKER, np.random.default_rng(7), n=12, poses=poses)
    told = refusal(made, unobservable="mark")
    assert "the arm turned only its last joint, about (" in told


def test_an_arm_that_rests_is_named() -> None:
    made = session(TWO, np.random.default_rng(8), n=14)
    assert refusal(_with_resting_second_arm(made)) == (
        "the camera's pose is not observable from these poses: the second arm stood still; move it too"
    )


def _with_resting_second_arm(made):
    """Return the session as it would be had the second arm not moved."""
    x, y, z = (made.truth[name] for name in made.configuration.unknowns)
    second = made.observations[0].poses["flange2"]
    resting = []
    for o in made.observations:
        seen = np.linalg.inv(o.base_T_flange.matrix @ x) @ (y @ second.matrix @ z)
        feature = PoseFeature(Transform(CAMERA, TARGET, seen), o.feature.covariance)
        resting.append(replace(o, feature=feature, poses={**o.poses, "flange2": second}))
    return replace(made, observations=resting)


def test_half_turns_between_poses_do_not_matter() -> None:
    rng = np.random.default_rng(9)
    poses = moves(rng, 12, 0.3)
    poses[::2, :3, :3] = poses[::2, :3, :3] @ rotation_from_rpy(np.pi - 1e-3, 0, 0)
    made = session(MARKER, rng, n=12, poses=poses)
    found = solved(made)
    name = found.camera.transform.name
    assert np.abs(errors(found.camera, made.truth[name])[3:]).max() < 1e-3


def test_too_few_poses() -> None:
    made = session(MARKER, np.random.default_rng(10), n=2)
    assert refusal(made, StageError) == (
        "3 poses needed for what this configuration leaves unknown, 2 given: add poses, or see "
        "why captures were set aside"
    )


def test_poses_that_are_all_the_same() -> None:
    made = session(MARKER, np.random.default_rng(11), n=5, poses=np.tile(np.eye(4), (5, 1, 1)))
    assert refusal(made, StageError) == ("all 5 poses are the same: move the arm between captures")


@pytest.mark.parametrize("feature", ["normal", "centre"])
def test_normals_tell_the_turn_about_a_line_of_centres(feature: str) -> None:
    """As well as a tilt common to all of them is known; without normals nothing does."""
    along = np.tile(np.eye(4), (6, 1, 1))
    along[:, 0, 3] = np.linspace(-0.12, 0.12, 6)
    made = session(
        CONFIGURATIONS["eye-on-base, flange"], np.random.default_rng(11), n=6, poses=along,
        feature=feature,
    )  # fmt: skip
    if feature == "centre":
        assert "lie on a line along base" in refusal(made)
        return
    found = solved(made).camera
    assert np.degrees(np.abs(errors(found, made.truth["base_T_camera"])[:3]).max()) < 0.3
    assert 0.05 < np.degrees(np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1])) < 0.3


def test_a_mirrored_camera_is_recognised() -> None:
    made = session(MARKER, np.random.default_rng(12), n=15)
    flip = np.diag([1.0, 1.0, -1.0, 1.0])
    mirrored = [
        replace(
            o,
            feature=PoseFeature(
                Transform(CAMERA, TARGET, flip @ o.feature.camera_T_target.matrix @ flip),
                o.feature.covariance,
            ),
        )
        for o in made.observations
    ]
    told = refusal(replace(made, observations=mirrored), CalibrationRefused)
    figures = re.match(
        r"what the camera saw fits the poses only when mirrored \((\S+) mm instead of (\S+) mm\)",
        told,
    )
    assert figures is not None
    there, here = map(float, figures.groups())
    # The noise of a place, and that of a rotation at a lever of 0.3 m
    assert there == pytest.approx(0.4, abs=0.15)
    assert 0.1 < here / spread(made) < 1.0
    assert told.endswith("flip one axis of the scanner's or the robot's frame")


def spread(made):
    """How far apart the camera saw its targets, rms [mm]."""
    seen = np.array([o.feature.camera_T_target.translation for o in made.observations])
    return 1e3 * np.sqrt(seen.var(axis=0).sum())


def test_scans_of_other_poses_are_refused() -> None:
    made = session(MARKER, np.random.default_rng(13), n=15, tilt=0.4)
    features = [o.feature for o in made.observations]
    shuffled = [
        replace(o, feature=f)
        for o, f in zip(made.observations, features[1:] + features[:1], strict=True)
    ]
    told = refusal(replace(made, observations=shuffled))
    figures = re.match(r"the poses fit one calibration to (\S+) mm and (\S+) deg only; ", told)
    assert figures is not None
    assert 0.5 < float(figures[1]) / spread(made) < 1.0
    assert np.degrees(0.4) < float(figures[2]) < np.degrees(0.8)  # of the tilts, and twice as far
    assert "check that each scan belongs to its robot pose" in told
    assert "(write place: unknown, or for a body target: {at: unknown}, if" in told


def test_noise_that_is_not_stated_is_found() -> None:
    rng = np.random.default_rng(15)
    made = session(MARKER, rng, n=60, noise=Noise(arm_shift=5e-4))
    (note,) = solved(made).notes
    beyond = float(
        note.removeprefix(
            "estimated noise of each pose, in addition to the noise of its fit: "
        ).split(" mm")[0]
    )
    assert 0.4 < beyond < 0.65


def test_noise_that_is_not_found_is_never_called_zero() -> None:
    made = session(MARKER, np.random.default_rng(15), n=12, noise=Noise(0.0, 0.0))
    assert not any("0.000" in note for note in solved(made).notes)


def shaken(made, turn, shift, deeper, seed):
    """The session with a camera's noise of its own: rotation, and place across and in depth."""
    rng, seen = np.random.default_rng(seed), []
    for o in made.observations:
        pose = o.feature.camera_T_target.matrix.copy()
        pose[:3, :3] = rotation_exp(turn * rng.standard_normal(3)) @ pose[:3, :3]
        pose[:3, 3] += np.array([shift, shift, deeper]) * rng.standard_normal(3)
        moved = replace(o.feature, camera_T_target=Transform(CAMERA, TARGET, pose))
        seen.append(replace(o, feature=moved))
    return replace(made, observations=seen)  # fmt: skip


def test_noise_of_the_camera_alone_costs_no_good_pose() -> None:
    """Its rotations and places are noisy apart, which no arm makes: nothing is an outlier."""
    used = []
    for seed in range(2):
        made = shaken(session(MARKER, np.random.default_rng(seed), n=60), 1e-2, 6e-3, 2e-2, seed)
        used += [pair.used for pair in solved(made).pairs]
    assert np.mean(used) > 0.99


def resized(made, factor):
    """The session as a camera would see it that takes all distances for longer."""
    seen = []
    for o in made.observations:
        pose = o.feature.camera_T_target.matrix.copy()
        pose[:3, 3] *= factor
        seen.append(
            replace(o, feature=replace(o.feature, camera_T_target=Transform(CAMERA, TARGET, pose)))
        )
    return replace(made, observations=seen)  # fmt: skip


@pytest.mark.parametrize("factor", [2.0, 7.2, 0.1])
def test_a_size_that_is_unknown_is_found(factor: float) -> None:
    made = session(MARKER, np.random.default_rng(17), n=20)
    found = solved(resized(made, factor), target_size="unknown")
    (note,) = [n for n in found.notes if "times the size" in n]
    told, _, sigma = note.split("target is ")[1].split()[:3]
    assert abs(float(told) - 1 / factor) < 4 * float(sigma) < 0.02 / factor
    error = errors(found.camera, made.truth["flange_T_camera"])
    assert error @ np.linalg.solve(found.camera.covariance, error) < 30


def test_a_size_that_is_a_little_off_is_refused_and_what_finds_it_is_named() -> None:
    made = session(MARKER, np.random.default_rng(17), n=20)
    assert "target_size: unknown finds it" in refusal(resized(made, 2.0))


def test_a_size_that_is_off_by_a_hundredth_is_told_as_well_as_it_is_known() -> None:
    made = session(MARKER, np.random.default_rng(17), n=20)
    told = refusal(resized(made, 1.01))
    found = re.match(r"the arm's motion shows that the target is (\S+) \+- (\S+) times as", told)
    assert found is not None
    assert abs(float(found[1]) - 1 / 1.01) < 4 * float(found[2]) < 0.005


def test_a_size_that_may_well_be_right_is_not_refused() -> None:
    """It seems off by 0.05 %, but poses as noisy as these do not tell so little."""
    poses = moves(np.random.default_rng(0), 12, 0.3, reach=0.06)
    made = session(MARKER, np.random.default_rng(18), n=12, poses=poses, noise=Noise().scaled(20))
    found = solved(resized(made, 1.04), size_limit=1e-5)
    assert found.camera.transform.name == "flange_T_camera"


def test_a_size_that_the_motion_does_not_tell_is_refused() -> None:
    poses = moves(np.random.default_rng(0), 12, 0.3, reach=0.0)
    made = session(MARKER, np.random.default_rng(18), n=12, poses=poses, noise=Noise().scaled(20))
    told = refusal(made, target_size="unknown")
    assert told.startswith("the target's size is known to ")
    assert told.endswith("move the arm further between poses, or write target_size: known")


@pytest.mark.parametrize(("tilt", "warned"), [(2e-3, True), (0.3, False)])
def test_poses_that_hardly_turn_show_no_tool_and_that_is_said(tilt: float, warned: bool) -> None:
    flange = CONFIGURATIONS["eye-on-base, flange"]
    made = session(flange, np.random.default_rng(5), n=15, tilt=tilt, feature="normal")
    found = solved(made)
    cell = cell_of(made.configuration, ROBOT)
    # Of any method, the paper's too
    other = with_expected_error(replace(found, notes=(), expected=None), cell, None, None)
    for warnings in (warnings_of(found.notes), warnings_of(other.notes)):
        assert [w[:29] for w in warnings] == ["the poses hardly turn the fla"] * warned


def test_a_tool_that_the_poses_show_is_no_unseen_one() -> None:
    """The misfit of a tool of 150 mm is not taken for noise in which it would not show."""
    flange = CONFIGURATIONS["eye-on-base, flange"]
    made = session(flange, np.random.default_rng(5), n=15, tilt=0.3, feature="normal")
    tool = rigid(np.eye(3), np.array([0.0, 0.0, 0.15]))
    tipped = [
        replace(o, poses=by_frame(Transform("base", "flange", o.base_T_flange.matrix @ tool)))
        for o in made.observations
    ]
    assert not warnings_of(solved(replace(made, observations=tipped)).notes)

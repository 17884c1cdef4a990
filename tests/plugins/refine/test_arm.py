"""``refine.arm``: the arm itself, from scans of its flange alone."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from flangeye import StageError
from flangeye.files.yaml_lines import parse_yaml
from flangeye.maths.kinematics import Arm
from flangeye.models.cell import cell_of
from flangeye.models.configuration import DEFAULT
from flangeye.models.loading import load_model
from flangeye.models.robots import RobotModel
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    CalibratedPose,
    CircleFeature,
    Observation,
    Observations,
    Source,
    Transform,
    by_frame,
)
from flangeye.types.geometry import rigid
from flangeye_emulators.world.arm import REAL, ArmErrors, ImperfectArm
from flangeye_plugins.export.controllers import export_robot
from flangeye_plugins.export.writing import NamedParams
from flangeye_plugins.refine import ArmParams, refine_arm
from flangeye_plugins.solve.robust import RobustParams, solve_robust
from tests.plugins.fixed import fixed

UR5 = load_model("robots", "ur5")
HOME = np.radians([0, -90, 90, -90, -90, 0])
BASE_T_CAMERA = rigid(np.eye(3), np.array([-0.49, -0.11, -0.3]))
NOISE = 0.03e-3


def observed(count, seed, spread, errors, only_places=False, noise=NOISE):
    """Sightings of the flange of an arm that is not what it reports."""
    rng = np.random.default_rng([seed, 3])
    arm = ImperfectArm(UR5, 1.0, np.random.default_rng(seed), errors)
    joints = HOME + rng.uniform(-spread, spread, (count, 6))
    if only_places:
        home = Arm(UR5).flange(HOME)
        wanted = [
            rigid(home[:3, :3], home[:3, 3] + d) for d in rng.uniform(-0.09, 0.09, (count, 3))
        ]
        joints = np.array([near(pose) for pose in wanted])
    actual, reported = arm.flange(arm.angles(joints)), arm.reported(joints)
    camera_T_base = np.linalg.inv(BASE_T_CAMERA)
    centres = (camera_T_base @ actual)[:, :3, 3] + noise * rng.standard_normal((count, 3))
    return [
        Observation(
            f"{i:02d}",
            CircleFeature(centres[i], None, {}, noise**2 * np.eye(3), None, 1.0),
            by_frame(Transform(BASE, FLANGE, reported[i])),
            joints[i],
        )
        for i in range(count)
    ]


def near(pose):
    found = Arm(UR5).inverse(pose)
    return found[np.abs((found - HOME + np.pi) % (2 * np.pi) - np.pi).max(axis=1).argmin()]


def solved(observations):
    return solve_robust(Observations(observations, Source("")), RobustParams(), robot=UR5)


@cache
def refined(spread=0.5, only_places=False, count=40):
    zeros, noise = ("8 mrad", 0.15e-3) if only_places else ("3 mrad", NOISE)
    errors = ArmErrors(quality="real", zeros=zeros)
    seen = observed(count, 0, spread, errors, only_places, noise)
    return refine_arm(solved(seen), ArmParams(), UR5)


def errors_on_others(calibration, observations):
    """Distances [m] on sightings that took no part, of a calibration whose pose and arm agree."""
    from flangeye_plugins.verify.holdout import hold_out

    every = [np.arange(len(observations))]
    return np.linalg.norm(
        hold_out(observations, every, [calibration], cell_of(DEFAULT, UR5)).errors, axis=1
    )


def rms(values):
    return float(np.sqrt((np.asarray(values) ** 2).mean()))


def test_the_arm_found_is_better_at_poses_that_took_no_part() -> None:
    found = refined()
    others = observed(200, 0, 0.5, ArmErrors(quality="real", zeros="3 mrad"))[40:]
    with_it = rms(errors_on_others(found.as_corrected(), others))
    without = rms(errors_on_others(found.as_reported(), others))
    assert with_it < 0.4 * without
    assert with_it < 0.25e-3
    assert 0.8 < found.corrected.expected.rms / with_it < 1.25


def test_it_says_what_the_poses_identify() -> None:
    said = " ".join(refined().notes)
    assert "parameters of the arm singly, and" in said
    assert "joint 3 zero" in said.split("identified:")[1].split("not identified")[0]
    assert "joint 1 zero" in said.split("not identified singly:")[1]  # it turns the base


def test_one_orientation_identifies_none_and_still_predicts() -> None:
    found = refined(only_places=True, count=30)
    (said,) = [n for n in found.notes if n.startswith("the poses identify")]
    identified = re.match(r"the poses identify \d+ combinations? of the arm's 24 parameters", said)
    assert identified and said[identified.end() :].startswith(", and none singly (one orientation")
    assert (
        "the correction is valid at similar poses, and gives no value for any single joint" in said
    )
    assert found.corrected is not None


def told_singly(found):
    """Return the parameters that are said to be identified, with value and deviation."""
    (listed,) = [n for n in found.notes if n.startswith("identified: ")]
    return {
        each.rsplit(" ", 4)[0]: [float(x) for x in each.split(" ")[-4:-1:2]]
        for each in listed.removeprefix("identified: ").split("; ")
    }


def test_without_joint_angles_only_what_all_ways_to_the_poses_agree_on_is_identified() -> None:
    """An elbow that bends the other way explains the same scans by zeros of the other sign."""
    # Play in the joints would tell from which side each came
    observations = observed(40, 0, 0.5, REAL._replace(zeros=3e-3, backlash=0.0))
    without = [replace(o, joints=None) for o in observations]
    found = refine_arm(solved(without), fixed(ArmParams, propose=0), UR5)
    (said,) = [n for n in found.notes if "joint angles" in n]
    assert said.startswith("the recordings have no joint angles, and the arm may have reached the")
    assert said.endswith("; record the joint angles with the poses")
    sure, unsure = told_singly(refined()), told_singly(found)
    assert set(unsure) < set(sure)
    for name, (value, sigma) in unsure.items():
        assert abs(value - sure[name][0]) < 2 * np.hypot(sigma, sure[name][1])
    assert not any("joint angles" in note for note in refined().notes)


def test_an_arm_of_seven_joints_without_their_angles_tells_no_parameter_singly() -> None:
    panda = load_model("robots", "franka-panda")
    arm, rng = Arm(panda), np.random.default_rng(0)
    joints = np.array([0, -0.5, 0, -2.2, 0, 1.8, 0.8]) + rng.uniform(-0.3, 0.3, (20, 7))
    observations = [
        Observation(
            f"{i:02d}",
            CircleFeature(
                np.linalg.inv(BASE_T_CAMERA)[:3] @ pose[:, 3], None, {}, NOISE**2 * np.eye(3),
                None, 1.0,
            ),
            by_frame(Transform(BASE, FLANGE, pose)),
        )
        for i, pose in enumerate(arm.flange(joints))
    ]  # fmt: skip
    calibration = solve_robust(Observations(observations, Source("")), RobustParams(), robot=panda)
    found = refine_arm(calibration, fixed(ArmParams, propose=0), panda)
    assert any("parameters, and none singly" in n for n in found.notes)
    assert any("in any number of ways that fit equally" in n for n in found.notes)


def test_it_proposes_poses_that_would_tell_more() -> None:
    notes = refined(only_places=True, count=30).notes
    (said,) = [n for n in notes if n.startswith("poses that would")]
    (before,) = [n for n in notes if n.startswith("the poses identify")]
    listed = said.split("joints in deg: ")[1].split("; with them")[0].split("; ")
    assert len(listed) == 6
    assert all(len(pose.split(", ")) == 6 for pose in listed)
    known = int(before.removeprefix("the poses identify ").split(" combination")[0])
    assert int(said.split(", and ")[-1].split(" combination")[0]) > known


def test_a_perfect_arm_is_left_as_it_is() -> None:
    calibration = solved(observed(25, 1, 0.4, ArmErrors(zeros="0 mrad")))
    found = refine_arm(calibration, ArmParams(), UR5)
    assert found.corrected is None
    assert found.notes[-1].startswith("the arm's parameters are not corrected")


def test_the_answer_for_the_arm_as_reported_stays() -> None:
    calibration = solved(observed(40, 0, 0.5, ArmErrors(quality="real", zeros="3 mrad")))
    found = refined()
    assert np.array_equal(
        found.camera.transform.matrix, calibration.as_reported().camera.transform.matrix
    )


def test_an_arm_of_another_model_is_refused() -> None:
    observations = observed(12, 0, 0.4, ArmErrors())
    with pytest.raises(StageError, match="the robot's model does not reach the poses"):
        refine_arm(solved(observations), ArmParams(), load_model("robots", "ur10e"))


def test_the_corrected_arm_is_a_robot_file() -> None:
    found = refined()
    pose = CalibratedPose(Transform(BASE, CAMERA, np.eye(4)), ("a remark",))
    file = export_robot(pose, found, UR5, NamedParams(name="my_ur5"))
    assert file.name == "my_ur5.yaml"
    read = RobotModel.model_validate(parse_yaml(file.text, "my_ur5.yaml").data)
    correction, arm = found.corrected.correction, Arm(UR5)
    expected = arm.perturbed(correction.lengths).flange(HOME + correction.joint_offsets)
    assert Arm(read).flange(HOME) == pytest.approx(expected, abs=1e-9)
    with pytest.raises(StageError, match="no joint error of the arm was estimated; add refine.arm"):
        export_robot(pose, found.as_reported(), UR5, NamedParams())

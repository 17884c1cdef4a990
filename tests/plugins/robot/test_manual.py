"""robot.manual: what a person is told, and what becomes of what they type."""

import ast
import io
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from flangeye.devices import DeviceError, MovedByHand, Robot
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.types import Transform
from flangeye.types.geometry import rigid, rotation_exp
from flangeye.types.pose_formats import CONVENTIONS, AngleUnit
from flangeye_emulators.controllers.arm import starting_joints
from flangeye_plugins.robot.manual import (
    ManualParams,
    ManualRobot,
    OperatorConsole,
    Tolerance,
    fault,
)
from tests.plugins.robot.cell import UR5E, moved

ARM = Arm(UR5E)
HOME = starting_joints(UR5E, None)
AT_HOME = Transform("base", "flange", ARM.flange(HOME))
PENDANTS = ("ur", "kuka", "fanuc", "abb")


class Person:
    """Somebody who types into a pipe and reads what is said."""

    def __init__(self, *lines):
        end, self._typing = os.pipe()
        self.heard = os.fdopen(end, "r")
        self.said = io.StringIO()
        for line in lines:
            self.types(line)

    def types(self, line):
        os.write(self._typing, (line + "\n").encode())

    def leaves(self):
        os.close(self._typing)

    def robot(self, convention="ur", model=UR5E, **params):
        console = OperatorConsole(self.heard, self.said)
        return ManualRobot(model, ManualParams(convention=convention, **params), console)

    def last(self):
        return self.said.getvalue().strip().split("\n")[-1]


@pytest.fixture
def person() -> Iterator[Person]:
    somebody = Person()
    yield somebody
    somebody.heard.close()


@pytest.mark.parametrize("convention", PENDANTS)
def test_a_pose_is_asked_for_and_answered_in_the_pendants_words(
    person: Person, convention: str
) -> None:
    words = CONVENTIONS[convention]
    person.types(words.text(AT_HOME.matrix))
    robot = person.robot(convention)
    assert isinstance(robot, Robot)
    assert isinstance(robot, MovedByHand)
    assert robot.state().mode == "ready"
    target = moved(AT_HOME, z=-0.1, turn=(0.1, 0.0, 0.2))
    robot.move_linear(target, 0.1, 0.5)
    assert robot.state().mode == "moving"
    assert f"Go to   {words.text(target.matrix)}\n" in person.said.getvalue()
    near = moved(target, x=0.004)
    person.types(words.text(near.matrix))
    state = robot.state()
    assert state.mode == "ready"
    np.testing.assert_allclose(state.base_T_flange.matrix, near.matrix, atol=3e-5)
    np.testing.assert_allclose(ARM.flange(state.joints), near.matrix, atol=3e-5)
    assert not state.joint_speeds.any()


def test_joint_angles_are_asked_for_as_the_pose_they_make_and_stay_on_their_branch(
    person: Person,
) -> None:
    person.types(CONVENTIONS["ur"].text(AT_HOME.matrix))
    robot = person.robot()
    target = HOME + [0.3, 0.1, -0.2, 0.1, 0.05, 2 * np.pi - 0.4]
    robot.move_joints(target, 0.1, 0.5)
    person.types(CONVENTIONS["ur"].text(ARM.flange(target)))
    np.testing.assert_allclose(robot.state().joints, target, atol=2e-4)


def test_of_a_joint_s_turns_the_one_nearest_to_where_it_stood_is_taken(person: Person) -> None:
    stood, target = HOME.copy(), HOME.copy()
    stood[5], target[5] = 4.0, 5.78  # which is also -0.5
    person.types(CONVENTIONS["ur"].text(AT_HOME.matrix))
    robot = person.robot()
    robot.move_joints(stood, 0.1, 0.5)
    person.types(CONVENTIONS["ur"].text(ARM.flange(stood)))
    np.testing.assert_allclose(robot.state().joints, stood, atol=2e-4)
    there = ARM.flange(target)
    robot.move_linear(Transform("base", "flange", there), 0.1, 0.5)
    person.types(CONVENTIONS["ur"].text(there))
    np.testing.assert_allclose(robot.state().joints, target, atol=2e-4)


@pytest.mark.parametrize(
    ("metres", "degrees", "taken"),
    [(0.0198, 0.0, True), (0.0202, 0.0, False), (0.0, 4.9, True), (0.0, 5.1, False)],
)
def test_a_pose_within_two_centimetres_and_five_degrees_is_taken(
    person: Person, metres: float, degrees: float, taken: bool
) -> None:
    person.types(CONVENTIONS["kuka"].text(AT_HOME.matrix))
    robot = person.robot("kuka")
    robot.move_linear(AT_HOME, 0.1, 0.5)
    near = moved(AT_HOME, z=-metres, turn=(0.0, 0.0, np.radians(degrees)))
    person.types(CONVENTIONS["kuka"].text(near.matrix))
    assert robot.state().mode == ("ready" if taken else "moving")


def test_a_strange_pose_is_asked_about_and_kept_when_it_is_meant(person: Person) -> None:
    person.types(CONVENTIONS["kuka"].text(AT_HOME.matrix))
    robot = person.robot("kuka")
    robot.move_linear(moved(AT_HOME, z=-0.1), 0.1, 0.5)
    person.types(CONVENTIONS["kuka"].text(AT_HOME.matrix))
    assert robot.state().mode == "moving"
    assert person.last() == (
        "that is 100.0 mm and 0.0 deg from the pose asked for (type the pose again, or yes "
        "if the arm stands there)"
    )
    person.types("yes")
    state = robot.state()
    assert state.mode == "ready"
    np.testing.assert_allclose(state.base_T_flange.matrix, AT_HOME.matrix, atol=3e-5)


def test_yes_to_nothing_is_no_pose(person: Person) -> None:
    person.types("yes")
    person.types(CONVENTIONS["ur"].text(AT_HOME.matrix))
    person.robot()
    assert "UR has 6 numbers (X Y Z RX RY RZ), not 0; type the pose again" in person.said.getvalue()


def test_a_pose_out_of_reach_is_never_taken(person: Person) -> None:
    person.types("400 0 5000 0 3.14159 0")
    person.types("10 0 5 0 3.14159 0")
    person.types(CONVENTIONS["ur"].text(AT_HOME.matrix))
    person.robot()
    said = person.said.getvalue()
    assert "that is 5.016 m from the base, and the arm is 1.31 m long" in said
    assert "no joint angles reach that pose; once more" in said


def test_who_goes_away_is_missed(person: Person) -> None:
    person.types(CONVENTIONS["ur"].text(AT_HOME.matrix))
    robot = person.robot()
    person.leaves()
    robot.move_linear(moved(AT_HOME, z=-0.1), 0.1, 0.5)
    with pytest.raises(DeviceError) as error:
        robot.state()
    assert str(error.value) == (
        "ur5e moved by hand: the input has ended, and a pose is missing: type or pipe one line "
        "for each"
    )


def test_a_stop_is_told_and_leaves_the_pose_open(person: Person) -> None:
    person.types(CONVENTIONS["ur"].text(AT_HOME.matrix))
    with person.robot() as robot:
        robot.stop()
        assert robot.state().mode == "ready"
        robot.move_linear(moved(AT_HOME, z=-0.1), 0.1, 0.5)
        robot.stop()
        assert person.last() == "Stop: leave the arm where it is."
        state = robot.state()
        assert state.mode == "not ready"
        assert state.message == "it was stopped on its way, and its pose was not entered since"
        with pytest.raises(DeviceError) as error:
            robot.move_velocity(np.zeros(6), 0.1)
    assert (
        str(error.value)
        == "ur5e moved by hand: it is moved by hand to poses; it takes no velocities"
    )


def test_an_unknown_convention_is_refused() -> None:
    with pytest.raises(ValidationError, match="no convention 'cuca'; known: ur, kuka, fanuc, abb"):
        ManualParams(convention="cuca")


TILTED = rigid(
    rotation_exp(np.array([0.3, -0.4, 0.5])) @ AT_HOME.rotation, np.array([0.4, -0.2, 0.3])
)
NEAR = Tolerance(0.02, np.radians(5))


def doubted(numbers, convention, asked=TILTED):
    return fault(np.asarray(numbers), CONVENTIONS[convention], 0.95, asked, NEAR)


@pytest.mark.parametrize("convention", PENDANTS)
def test_a_pose_near_the_one_asked_for_is_not_doubted(convention: str) -> None:
    assert doubted(CONVENTIONS[convention].numbers(TILTED), convention) is None
    assert doubted(CONVENTIONS[convention].numbers(TILTED), convention, None) is None


@pytest.mark.parametrize("convention", PENDANTS)
@pytest.mark.parametrize("asked", [TILTED, None])
def test_metres_for_millimetres_are_named(convention: str, asked: Any) -> None:
    words = CONVENTIONS[convention]
    numbers = words.in_units("m", words.angle).numbers(TILTED)
    assert doubted(numbers, convention, asked).endswith(": is the position in m, not in mm?")
    in_metres = words.in_units("m", words.angle)
    why = fault(words.numbers(TILTED), in_metres, 0.95, asked, NEAR)
    assert why.endswith(": is the position in mm, not in m?")


@pytest.mark.parametrize("convention", ["kuka", "fanuc", "ur"])
def test_radians_for_degrees_are_named(convention: str) -> None:
    words = CONVENTIONS[convention]
    other: AngleUnit = "rad" if words.angle == "deg" else "deg"
    numbers = words.in_units("mm", other).numbers(TILTED)
    assert doubted(numbers, convention).endswith(
        f": are the angles in {other}, not in {words.angle}?"
    )
    numbers = words.in_units("m", other).numbers(TILTED)
    assert doubted(numbers, convention).endswith(
        f": is the position in m, not in mm, and are the angles in {other}, not in {words.angle}?"
    )


@pytest.mark.parametrize(
    ("meant", "typed", "said"),
    [
        ("fanuc", "kuka", "are these numbers in the order and meaning of Fanuc WPR?"),
        ("kuka", "fanuc", "are these numbers in the order and meaning of KUKA ABC?"),
        ("ur", "kuka", "are these numbers in the order and meaning of UR?"),
        ("quaternion_xyzw", "abb", "are these numbers in the order and meaning of quaternion?"),
    ],
)
def test_another_makers_convention_is_named(meant: str, typed: str, said: str) -> None:
    words = CONVENTIONS[meant].in_units(CONVENTIONS[typed].length, CONVENTIONS[meant].angle)
    assert doubted(words.numbers(TILTED), typed).endswith(said)


def test_a_tool_is_named() -> None:
    tip = rigid(TILTED[:3, :3], TILTED[:3, 3] + 0.15 * TILTED[:3, 2])
    assert doubted(CONVENTIONS["fanuc"].numbers(tip), "fanuc") == (
        "that is 150.0 mm and 0.0 deg from the pose asked for: is this the pose of a tool, "
        "150 mm beyond the flange?"
    )


def test_beside_the_pose_there_is_no_tool() -> None:
    beside = rigid(np.eye(3), np.array([0.515, 0.1, 0.3]))
    asked = rigid(np.eye(3), np.array([0.5, 0.1, 0.3]))
    words = CONVENTIONS["quaternion_xyzw"]
    assert fault(words.numbers(beside), words, 0.95, asked, Tolerance(0.005, 0.1)) == (
        "that is 15.0 mm and 0.0 deg from the pose asked for"
    )


@pytest.mark.parametrize(
    ("beside", "beyond", "turned", "said"),
    [
        (0.0198, 0.15, 0.0, "is this the pose of a tool, 150 mm beyond the flange?"),
        (0.0202, 0.15, 0.0, ""),
        (0.0, -0.15, 0.0, ""),
        (0.0, 0.15, 4.9, "is this the pose of a tool, 150 mm beyond the flange?"),
        (0.0, 0.15, 5.1, ""),
    ],
)
def test_a_tool_is_long_along_the_flange_s_axis_and_not_turned(
    beside: float, beyond: float, turned: float, said: str
) -> None:
    place = np.array([-0.6 * beside, 0.8 * beside, beyond])
    tip = TILTED @ rigid(rotation_exp(np.radians([turned, 0.0, 0.0])), place)
    words = CONVENTIONS["quaternion_xyzw"]
    assert doubted(words.numbers(tip), "quaternion_xyzw").partition(": ")[2] == said


@pytest.mark.parametrize("convention", ["ur", "abb"])
def test_angles_in_the_opposite_order_are_named(convention: str) -> None:
    numbers = CONVENTIONS[convention].numbers(TILTED)
    typed = [*numbers[:3], *reversed(numbers[3:])]
    assert doubted(typed, convention).endswith(": are the angles in the opposite order?")


def test_a_pose_without_an_explanation_is_only_described() -> None:
    elsewhere = rigid(TILTED[:3, :3], TILTED[:3, 3] + [0.1, 0.0, 0.0])
    assert doubted(CONVENTIONS["kuka"].numbers(elsewhere), "kuka") == (
        "that is 100.0 mm and 0.0 deg from the pose asked for"
    )


@pytest.mark.parametrize(
    ("metres", "said"),
    [
        (0.001995, "that is 2.0 mm from the middle of the base"),
        (0.002005, None),
        (0.439, None),
        (0.441, "that is 0.441 m from the base, and the arm is 0.40 m long"),
    ],
)
def test_a_pose_in_the_base_or_beyond_the_arm_is_doubted(metres: float, said: str | None) -> None:
    words = CONVENTIONS["quaternion_xyzw"]
    pose = rigid(TILTED[:3, :3], metres * np.array([2.0, -1.0, 2.0]) / 3.0)
    found = fault(words.numbers(pose), words, 0.4, None, Tolerance(0.02, 0.1))
    assert (found and found.partition(":")[0]) == said


def test_an_arm_moved_by_hand_is_looked_at_twenty_times_a_second(person: Person) -> None:
    person.types(CONVENTIONS["ur"].text(AT_HOME.matrix))
    assert person.robot().period == 0.05


def test_piped_standard_input_works() -> None:
    code = (
        "from flangeye.models.loading import load_model\n"
        "from flangeye_plugins.robot.manual import ManualParams, robot_manual\n"
        "model = load_model('robots', 'aubo-i5')\n"
        "with robot_manual(model, ManualParams(convention='abb')) as robot:\n"
        "    print(robot.state().base_T_flange.translation.round(3).tolist())\n"
    )
    robot = load_model("robots", "aubo-i5")
    pose = Arm(robot).flange(starting_joints(robot, None))
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=CONVENTIONS["abb"].text(pose),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    np.testing.assert_allclose(ast.literal_eval(done.stdout), pose[:3, 3], atol=1e-3)
    assert done.stderr.split("\n")[0] == (
        "Type or paste the pose of the flange as the pendant shows it, no tool: X Y Z Q1 Q2 Q3 Q4"
    )

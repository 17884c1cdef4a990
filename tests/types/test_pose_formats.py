"""Poses as makers write them: against the definitions, against each other, and as people type."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flangeye.types.geometry import rigid, rotation_exp
from flangeye.types.pose_formats import CONVENTIONS, EULER_ORDERS, PoseConvention

ALL = sorted(CONVENTIONS)
finite = st.floats(-2.0, 2.0)


@st.composite
def poses(draw):
    vector = np.array(draw(st.tuples(*[st.floats(-3.0, 3.0)] * 3)))
    return rigid(rotation_exp(vector), np.array(draw(st.tuples(finite, finite, finite))))


def about(axis, degrees):
    return rotation_exp(np.radians(degrees) * np.eye(3)["xyz".index(axis)])


@given(poses(), st.sampled_from(ALL))
def test_a_pose_survives_being_written_and_read(pose: Any, name: Any) -> None:
    convention = CONVENTIONS[name]
    numbers = convention.numbers(pose)
    np.testing.assert_allclose(convention.matrix(numbers), pose, atol=1e-9)
    np.testing.assert_allclose(convention.read(convention.text(pose)), pose, atol=3e-5)


@settings(max_examples=40)
@given(poses(), st.sampled_from(EULER_ORDERS), st.sampled_from(["deg", "rad"]))
def test_any_order_of_angles_is_the_product_of_its_turns(pose: Any, order: Any, angle: Any) -> None:
    labels = ("X", "Y", "Z", "1", "2", "3")
    convention = PoseConvention(order, labels, order, "m", angle)
    angles = convention.numbers(pose)[3:]
    degrees = angles if angle == "deg" else np.degrees(angles)
    turns = [about(axis.lower(), value) for axis, value in zip(order, degrees, strict=True)]
    # Turns about fixed axes are applied from the left, about turned ones from the right.
    product = turns[0] @ turns[1] @ turns[2] if order.isupper() else turns[2] @ turns[1] @ turns[0]
    # Within 1e-7 rad of the orders' singularity the third angle is zero.
    np.testing.assert_allclose(product, pose[:3, :3], atol=2e-7)
    np.testing.assert_allclose(convention.matrix([0, 0, 0, *angles])[:3, :3], product, atol=1e-9)


@pytest.mark.filterwarnings("ignore:Gimbal lock")
@pytest.mark.parametrize("order", EULER_ORDERS)
@pytest.mark.parametrize("middle", [0.3, -1.2, 0.0, np.pi / 2, -np.pi / 2, np.pi])
def test_angles_are_those_of_scipy_locked_or_not(order: str, middle: float) -> None:
    convention = PoseConvention(order, ("X", "Y", "Z", "1", "2", "3"), order, "m")
    turn = Rotation.from_euler(order, [1.0, middle, -2.5])
    angles = convention.numbers(rigid(turn.as_matrix(), np.zeros(3)))[3:]
    apart = angles - turn.as_euler(order)
    np.testing.assert_allclose(np.sin(apart / 2), 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "numbers", "rotation"),
    [
        ("kuka", [30, 20, 10], about("z", 30) @ about("y", 20) @ about("x", 10)),
        ("fanuc", [10, 20, 30], about("z", 30) @ about("y", 20) @ about("x", 10)),
        ("yaskawa", [10, 20, 30], about("z", 30) @ about("y", 20) @ about("x", 10)),
        ("mitsubishi", [10, 20, 30], about("z", 30) @ about("y", 20) @ about("x", 10)),
        ("epson", [30, 20, 10], about("z", 30) @ about("y", 20) @ about("x", 10)),
        ("staubli", [10, 20, 30], about("x", 10) @ about("y", 20) @ about("z", 30)),
        ("kawasaki", [10, 20, 30], about("z", 10) @ about("y", 20) @ about("z", 30)),
        ("rpy", np.radians([10, 20, 30]), about("z", 30) @ about("y", 20) @ about("x", 10)),
        ("ur", [0, np.pi / 2, 0], about("y", 90)),
        ("abb", [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], about("z", 90)),
        ("quaternion_xyzw", [0, 0, np.sqrt(0.5), np.sqrt(0.5)], about("z", 90)),
        ("quaternion_wxyz", [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], about("z", 90)),
    ],
)
def test_each_maker_turns_about_the_axes_of_its_manual(
    name: str, numbers: Any, rotation: Any
) -> None:
    pose = CONVENTIONS[name].matrix([1, 2, 3, *numbers])
    unit = 1.0 if CONVENTIONS[name].length == "m" else 1e-3
    np.testing.assert_allclose(pose, rigid(rotation, unit * np.array([1.0, 2.0, 3.0])), atol=1e-12)


def test_the_pole_of_the_angles_has_one_answer_of_many() -> None:
    pose = rigid(about("y", 90) @ about("x", 25), np.zeros(3))
    written = CONVENTIONS["kuka"].numbers(pose)
    assert written[5] == 0.0
    np.testing.assert_allclose(CONVENTIONS["kuka"].matrix(written), pose, atol=1e-9)


KUKA = rigid(about("z", 90) @ about("y", -10) @ about("x", 180), np.array([0.4, 0.0, 0.3]))


@pytest.mark.parametrize(
    "text",
    [
        "400 0 300 90 -10 180",
        "400.0, 0.0, 300.0, 90.0, -10.0, 180.0",
        "{X 400.0,Y 0.0,Z 300.0,A 90.0,B -10.0,C 180.0,S 2,T 10}",
        "A 90 B \N{MINUS SIGN}10 C 180 X=400 Y=0 Z=300",
        "x: 400.00 mm  a: 90.00 deg\ny: 0.00 mm  b: -10.00 deg\nz: 300.00 mm  c: 180.00 deg",
        "X400 Y0 Z300 A90 B-10 C180",
        "0.4 m  0 m  0.3 m  1.5707963267948966 rad  -10°  1.8e2 deg",
    ],
)
def test_typed_and_pasted_text_is_read(text: str) -> None:
    np.testing.assert_allclose(CONVENTIONS["kuka"].read(text), KUKA, atol=1e-12)


def test_scripts_of_other_makers_are_read() -> None:
    down = rigid(about("x", 180), np.array([0.4, 0.0, 0.3]))
    rapid = "[[400,0,300],[0,1,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"
    np.testing.assert_allclose(CONVENTIONS["abb"].read(rapid), down, atol=1e-12)
    labelled = "X 400 Y 0 Z 300 q1 0 q2 1 q3 0 q4 0"
    np.testing.assert_allclose(CONVENTIONS["abb"].read(labelled), down, atol=1e-12)
    script = CONVENTIONS["ur"].in_units("m", "rad").read("p[0.4, 0, 0.3, 3.141592653589793, 0, 0]")
    np.testing.assert_allclose(script, down, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("kuka", "400 0 300", "KUKA ABC has 6 numbers (X Y Z A B C), not 3"),
        ("abb", "1 2 3 4 5 6", "ABB has 7 numbers (X Y Z Q1 Q2 Q3 Q4), not 6"),
        ("kuka", "", "KUKA ABC has 6 numbers (X Y Z A B C), not 0"),
        ("fanuc", "X 400 Y 0 Z 300 W 0 P 0", "Fanuc WPR: there is no R"),
        ("kuka", "X 400 Y 0 Z 300 W 0 P 0 R 0", "KUKA ABC: there is no A and no B and no C"),
        ("kuka", "400 deg 0 0 0 0 0", "KUKA ABC: X has the unit deg, not mm"),
        ("abb", "0 0 0 1 deg 0 0 0", "ABB: Q1 has the unit deg, not none"),
        (
            "abb",
            "0 0 0 1 0.1 0 0",
            "ABB: the quaternion's norm is 1.005; it must be 1 (within 0.001)",
        ),
        ("kuka", "1e999 0 0 0 0 0", "KUKA ABC: a number is not finite"),
    ],
)
def test_what_is_no_pose_is_refused(name: str, text: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        CONVENTIONS[name].read(text)
    assert str(error.value) == message


def test_text_is_what_a_pendant_shows() -> None:
    assert CONVENTIONS["kuka"].text(KUKA) == (
        "X 400.00 mm  Y 0.00 mm  Z 300.00 mm  A 90.000 deg  B -10.000 deg  C 180.000 deg"
    )


@pytest.mark.parametrize(
    ("rotation", "labels", "message"),
    [
        ("xyy", "XYZABC", "no rotation 'xyy'; known: vector, xyzw, wxyz, xyx, xyz"),
        ("xYz", "XYZABC", "no rotation 'xYz'"),
        ("ZYX", "XYZAB", "mine: 6 numbers need as many labels"),
    ],
)
def test_a_convention_is_checked_when_it_is_made(rotation: str, labels: str, message: str) -> None:
    with pytest.raises(ValueError) as error:
        PoseConvention("mine", tuple(labels), rotation, "m")
    assert str(error.value).startswith(message)

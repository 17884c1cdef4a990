"""Each written file, read back by a reader that is not ours, is the pose that was written.

Where PyPI has the maker's library it reads; else the maker's definition is spelt out here in
elementary rotations, not with the code that wrote the file.
"""

import io
import re
import subprocess
import sys
import tokenize
import types
import warnings
from math import cos, pi, sin
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from flangeye import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.models.robots import RobotModel
from flangeye.testing import ExportConformance
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    ArmCorrection,
    CalibratedPose,
    HandEye,
    Transform,
    TransformEstimate,
)
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_plugins.export import EXPORTS
from flangeye_plugins.export.controllers import export_robot, with_correction
from flangeye_plugins.export.documents import UrdfParams
from flangeye_plugins.export.writing import (
    LengthParams,
    NamedParams,
    NumberedParams,
    fixed,
    rounded,
)

with warnings.catch_warnings():  # robodk warns of its own __init__
    warnings.simplefilter("ignore", PendingDeprecationWarning)
    from robodk import robomath

REMARKS = ("flangeye: written by a test", "REFUSED, DO NOT USE: not -- ever")
BY_NAME = {stage.name.partition(".")[2]: stage for stage in EXPORTS}


# --- elementary rotations, degrees ---------------------------------------------------------------


def rx(deg):
    c, s = cos(deg * pi / 180), sin(deg * pi / 180)
    return np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])


def ry(deg):
    c, s = cos(deg * pi / 180), sin(deg * pi / 180)
    return np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])


def rz(deg):
    c, s = cos(deg * pi / 180), sin(deg * pi / 180)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def at(xyz, rotation, unit=1.0):
    moved = np.array(rotation, dtype=float)
    moved[:3, 3] = np.array(xyz, dtype=float) * unit
    return moved


def of_robodk(mat):
    return at(mat.Pos(), [[mat[i, j] for j in range(4)] for i in range(4)], 1e-3)


# --- the readers -----------------------------------------------------------------------------------

STORE = get_typestore(Stores.ROS2_HUMBLE)
NUMBER = r"-?\d+\.\d+"


def ros_message(values):
    """A geometry_msgs/Transform through ROS's own wire format and back."""
    msg = STORE.types["geometry_msgs/msg/Transform"](
        translation=STORE.types["geometry_msgs/msg/Vector3"](*values[:3]),
        rotation=STORE.types["geometry_msgs/msg/Quaternion"](*values[3:]),
    )
    again: Any = STORE.deserialize_cdr(STORE.serialize_cdr(msg, msg.__msgtype__), msg.__msgtype__)
    move, turn = again.translation, again.rotation
    mat = robomath.quaternion_2_pose([turn.w, turn.x, turn.y, turn.z])
    return at((move.x, move.y, move.z), of_robodk(mat))


def flags_of(words):
    return dict(zip(words[::2], words[1::2], strict=True))


def of_flags(words):
    told = flags_of(words)
    assert told.pop("--frame-id") in ("base", "flange")
    assert told.pop("--child-frame-id") == "camera"
    return ros_message(
        [float(told[f"--{name}"]) for name in ["x", "y", "z", "qx", "qy", "qz", "qw"]]
    )


def words_of_command(text):
    """Run the command in a shell, where ros2 is a function that prints its arguments."""
    script = f"ros2() {{ printf '%s\\0' ros2 \"$@\"; }}\n{text}"
    ran = subprocess.run(["sh", "-c", script], capture_output=True, check=True, cwd="/proc/self")
    assert ran.stderr == b""
    words = ran.stdout.decode().split("\0")[:-1]
    assert words[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    return words[4:]


def read_command(text):
    return of_flags(words_of_command(text))


def read_launch(text):
    return of_flags(words_of_launch(text))


def words_of_launch(text):
    """Run the launch file with stand-ins for ROS's two packages."""
    nodes: list[Any] = []

    def node(**told):
        nodes.append(told)
        return told

    launch, launch_ros = types.ModuleType("launch"), types.ModuleType("launch_ros.actions")
    vars(launch)["LaunchDescription"], vars(launch_ros)["Node"] = list, node
    names = {"launch": launch, "launch_ros": launch, "launch_ros.actions": launch_ros}
    before = {name: sys.modules.get(name) for name in names}
    sys.modules.update(names)
    try:
        space: dict[str, Any] = {}
        exec(compile(text, "launch", "exec"), space)
        assert len(space["generate_launch_description"]()) == 1
    finally:
        for name, module in before.items():
            sys.modules.pop(name) if module is None else sys.modules.update({name: module})
    assert nodes[0]["executable"] == "static_transform_publisher"
    return nodes[0]["arguments"]


def joints_of(text):
    found = {}
    for joint in ElementTree.fromstring(text).findall("joint"):
        origin = joint.find("origin")
        roll, pitch, yaw = (float(x) * 180 / pi for x in origin.get("rpy").split())
        move = [float(x) for x in origin.get("xyz").split()]
        child = joint.find("child").get("link")
        found[child] = at(move, rz(yaw) @ ry(pitch) @ rx(roll))
    return found


def read_urdf(text):
    return joints_of(text)["camera_optical_frame"]


def read_calib(text):
    told = yaml.safe_load(text)["transform"]
    move, turn = told["translation"], told["rotation"]
    return ros_message([move[a] for a in "xyz"] + [turn[a] for a in "xyzw"])


def read_opencv(text):
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    (name,) = storage.root().keys()
    assert name in ("base_T_camera", "flange_T_camera")
    return storage.getNode(name).mat()


def found_in(text: str, pattern: str) -> re.Match[str]:
    found = re.search(pattern, text)
    assert found is not None, text
    return found


def numbers_after(pattern, text):
    return [float(x) for x in re.findall(NUMBER, found_in(text, pattern)[0])]


def read_ur(text):
    mat = robomath.UR_2_Pose(numbers_after(r"(?m)^camera = p\[.*\]$", text))
    return at(mat.Pos(), of_robodk(mat))


def read_kuka(text):
    numbers = numbers_after(r"(?m)^(BASE|TOOL)_DATA\[1\]=\{X .*,Y .*,Z .*,A .*,B .*,C .*\}$", text)
    return of_robodk(robomath.KUKA_2_Pose(numbers))


def read_abb(text):
    """The RAPID value, whose brackets are Python's; q1 is the real part."""
    line = found_in(text, r"PERS wobjdata camera:=(.*);")[1]
    held, programmed, unit, user, obj = eval(line, {"TRUE": True, "FALSE": False})
    assert (programmed, unit, obj) == (True, "", [[0, 0, 0], [1, 0, 0, 0]])
    assert held in (True, False)
    mat = robomath.quaternion_2_pose(user[1])
    mat.setPos(user[0])
    return of_robodk(mat)


def labelled(text, labels):
    return [float(found_in(text, rf"(?m)^{label}: ({NUMBER})$")[1]) for label in labels]


def read_fanuc(text):
    return of_robodk(robomath.Fanuc_2_Pose(labelled(text, "XYZWPR")))


def read_yaskawa(text):
    return of_robodk(robomath.Motoman_2_Pose(labelled(text, ["X", "Y", "Z", "RX", "RY", "RZ"])))


def read_staubli(text):
    return of_robodk(robomath.Staubli_2_Pose(numbers_after(r"camera\.trsf=\{.*\}", text)))


def read_doosan(text):
    x, y, z, a, b, c = numbers_after(r"camera = posx\(.*\)", text)
    return at((x, y, z), rz(a) @ ry(b) @ rz(c), 1e-3)


def read_zivid(text):
    told = yaml.safe_load(text)
    assert told["__version__"] == {"serializer": 1, "data": 1}
    matrix = np.array(told["FloatMatrix"]["Data"])
    return at(matrix[:3, 3], matrix, 1e-3)


def read_mech_mind(text):
    numbers = labelled(text, ["X", "Y", "Z", "QW", "QX", "QY", "QZ"])
    return at(numbers[:3], of_robodk(robomath.quaternion_2_pose(numbers[3:])))


def read_halcon(text):
    told = {
        line[0]: line[1:].split() for line in text.splitlines() if line[:2] in ("f ", "r ", "t ")
    }
    assert told["f"] == ["0"]
    alpha, beta, gamma = map(float, told["r"])
    return at([float(x) for x in told["t"]], rx(alpha) @ ry(beta) @ rz(gamma))


def read_robodk(text):
    space = {"__name__": "not run"}
    exec(compile(text, "script", "exec"), space)
    return of_robodk(space["POSE"])


def read_matrix(text):
    return np.loadtxt(text.splitlines())


READERS = {
    "ros2_command": read_command,
    "ros2_launch": read_launch,
    "moveit": read_launch,
    "urdf": read_urdf,
    "easy_handeye2": read_calib,
    "opencv": read_opencv,
    "ur": read_ur,
    "kuka": read_kuka,
    "abb": read_abb,
    "fanuc": read_fanuc,
    "yaskawa": read_yaskawa,
    "staubli": read_staubli,
    "doosan": read_doosan,
    "zivid": read_zivid,
    "mech_mind": read_mech_mind,
    "halcon": read_halcon,
    "robodk": read_robodk,
    "matrix": read_matrix,
}


# --- the poses -------------------------------------------------------------------------------------

near = st.sampled_from([0.0, 1e-9, -1e-9, 1e-7, -1e-7, 1e-5, -1e-5, 1e-3])
quarter = st.sampled_from([-180.0, -90.0, 0.0, 90.0, 180.0])


@st.composite
def rotations(draw):
    """Any, or within a thousandth of a degree of where some maker's angles are singular."""
    if draw(st.booleans()):
        vector = np.array(draw(st.tuples(*[st.floats(-3.2, 3.2)] * 3)))
        return rotation_exp(vector)
    a, b, c = (draw(quarter) + draw(near) for _ in range(3))
    free = draw(st.floats(-180, 180))
    return (rz(a + free) @ ry(b) @ rx(c))[:3, :3]


@st.composite
def poses(draw):
    move = np.array(draw(st.tuples(*[st.floats(-3, 3)] * 3)))
    parent = draw(st.sampled_from([BASE, FLANGE]))
    return CalibratedPose(Transform(parent, CAMERA, rigid(draw(rotations()), move)), REMARKS)


def params_of(name: str) -> Any:
    return BY_NAME[name].params


def written(format_name, pose, **params):
    return BY_NAME[format_name](pose=pose, params=params_of(format_name)(**params))


def require_same(found, pose):
    wanted = pose.transform.matrix
    assert np.linalg.norm(found[:3, 3] - wanted[:3, 3]) < 1e-6
    turned = found[:3, :3].T @ wanted[:3, :3]
    axis = np.array(
        [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
    )
    assert np.trace(turned) > 2.9
    assert np.linalg.norm(axis) / 2 < 1e-6


def test_every_format_has_its_reader() -> None:
    assert set(READERS) == set(BY_NAME)


@pytest.mark.parametrize("name", READERS)
@settings(max_examples=40)
@given(pose=poses())
def test_what_is_written_is_read_back(name: str, pose: Any) -> None:
    require_same(READERS[name](written(name, pose).text), pose)


@pytest.mark.parametrize("name", ["zivid", "opencv", "matrix"])
def test_the_unit_is_the_one_asked_for(name: str) -> None:
    pose = CalibratedPose(Transform(BASE, CAMERA, rigid(np.eye(3), [0.1, 0.2, 0.3])))
    by_default = 1e-3 if name == "zivid" else 1.0
    for length, metres in (("m", 1.0), ("mm", 1e-3)):
        text = written(name, pose, length=length).text
        found = READERS[name](text)[:3, 3] * metres / by_default
        assert np.allclose(found, [0.1, 0.2, 0.3], atol=1e-9)


@settings(max_examples=30)
@given(pose=poses())
def test_a_urdf_hangs_the_camera_by_its_mount(
    tmp_path_factory: pytest.TempPathFactory, pose: Any
) -> None:
    """base_T_mount mount_T_optical is what was found, the mount given or from the camera's URDF."""
    roll, pitch, yaw = 10.0, -20.0, 170.0
    told = {
        "position": ["10 mm", "-20 mm", "5 mm"],
        "rpy": [f"{a} deg" for a in (roll, pitch, yaw)],
    }
    mount_T_optical = at((0.010, -0.020, 0.005), rz(yaw) @ ry(pitch) @ rx(roll))
    joints = joints_of(written("urdf", pose, mount_T_optical=told).text)
    assert np.allclose(joints["camera_optical_frame"], mount_T_optical, atol=1e-9)
    require_same(joints["camera_link"] @ joints["camera_optical_frame"], pose)

    file = tmp_path_factory.mktemp("urdf") / "camera.urdf"
    file.write_text(CAMERA_URDF)
    params = UrdfParams.model_validate({"camera_urdf": file})
    joints = joints_of(BY_NAME["urdf"](pose=pose, params=params).text)
    assert set(joints) == {"camera_link"}
    own = joints_of(CAMERA_URDF)
    chain = own["camera_depth_frame"] @ own["camera_optical_frame"]
    require_same(joints["camera_link"] @ chain, pose)
    del mount_T_optical


CAMERA_URDF = """<robot name="eye">
<link name="camera_link"/><link name="camera_depth_frame"/><link name="camera_optical_frame"/>
<joint name="a" type="fixed"><parent link="camera_link"/><child link="camera_depth_frame"/>
  <origin xyz="0.01 0.0175 0.0125" rpy="0 0 0.02"/></joint>
<joint name="b" type="fixed"><parent link="camera_depth_frame"/><child link="camera_optical_frame"/>
  <origin xyz="0 0 0" rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint>
</robot>"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("no xml", "{}:1: not valid XML: syntax error: line 1, column 0"),
        (
            "<robot/>",
            "{}: no fixed joints lead from 'camera_link' to 'camera_optical_frame'; links with a "
            "fixed joint: none",
        ),
        (
            CAMERA_URDF.replace("0 0 0.02", "${x} 0 0"),
            '{}: rpy="${{x}} 0 0" is not three finite numbers',
        ),
    ],
)
def test_a_camera_s_urdf_that_does_not_tell(tmp_path: Path, text: Any, message: str) -> None:
    file = tmp_path / "camera.urdf"
    file.write_text(text)
    pose = CalibratedPose(Transform(BASE, CAMERA, np.eye(4)))
    params = UrdfParams.model_validate({"camera_urdf": file})
    with pytest.raises(Exception) as error:
        BY_NAME["urdf"](pose=pose, params=params)
    assert str(error.value) == message.format(file)


def test_every_format_keeps_to_the_kit() -> None:
    """What is asked of a vendor's export, asked of each of ours."""
    checks = [name for name in dir(ExportConformance) if name.startswith("test_")]
    for stage in EXPORTS:
        kit = type("Kit", (ExportConformance,), {"stage": stage})()
        for check in checks:
            getattr(kit, check)()


HOSTILE = (
    "cam; touch PWNED;",
    "$(touch PWNED)",
    "`touch PWNED` & '",
    '"); raise SystemExit; ("',
    "'''\nraise SystemExit\n'''",
    '"""\nraise SystemExit\n"""',
    "x: !!python/object/apply:os.abort []",
    "a\nb: {c: [d]}",
    "--->",
    "--><link name='x'/><!-",
    "]]>&<x/>",
    "\x1b[2J\x9b1A",
    "\u2028raise SystemExit\u202e",
    "ENDMODULE\r\nMODULE x",
    "FOLD\n halt() end",
    "../../x",
    "%s {0} {name} \\",
    "%YAML:1.0 # *a &b",
    "coding: utf-7 +AAo-raise SystemExit+AAo-",
    "cam\0; touch PWNED",
    "cam\ud800; touch PWNED",
)
BENIGN = Transform(BASE, CAMERA, rigid(rotation_exp(np.array([0.1, 0.2, 0.3])), [0.1, 0.2, 0.3]))
OF_FRAMES = {
    "ros2_command": words_of_command,
    "ros2_launch": words_of_launch,
    "moveit": words_of_launch,
    "easy_handeye2": lambda text: yaml.safe_load(text)["parameters"],
    "urdf": joints_of,
}


@pytest.mark.parametrize("frame", HOSTILE)
@pytest.mark.parametrize("name", OF_FRAMES)
def test_a_hostile_frame_stays_a_string(name: str, frame: str) -> None:
    """What the target's own parser finds is the very name; who cannot hold it refuses it."""
    stage, params = BY_NAME[name], params_of(name).model_construct(child=frame)
    try:
        text = stage(pose=CalibratedPose(BENIGN), params=params).text
    except StageError as error:
        why = {
            "urdf": "a name cannot be written as XML: ",
            "ros2_command": "a frame name cannot be quoted for a shell",
        }
        assert str(error).startswith(f"export.{name}: {why[name]}")
        return
    found = OF_FRAMES[name](text)
    if name == "urdf":
        assert [*found] == [frame]
    elif name == "easy_handeye2":
        assert found["tracking_base_frame"] == frame
    else:
        assert flags_of(found)["--child-frame-id"] == frame


@pytest.mark.parametrize("remark", HOSTILE)
@pytest.mark.parametrize("name", READERS)
def test_a_hostile_remark_stays_a_comment(name: str, remark: str) -> None:
    """The target's parser finds the pose; what is not a comment is the same for any remark."""
    mark = "<!--" if name == "urdf" else written(name, CalibratedPose(BENIGN, ("x",))).text[0]

    def without_comments(pose: CalibratedPose) -> list[str]:
        text = written(name, pose).text
        assert tokenize.detect_encoding(io.BytesIO(text.encode()).readline)[0] == "utf-8"
        assert text.isascii()
        assert text.replace("\n", "").isprintable()
        require_same(READERS[name](text), pose)
        lines = [line.strip() for line in text.split("\n")]
        return [line for line in lines if not line.startswith((mark, "#", "/"))]

    hostile = without_comments(CalibratedPose(BENIGN, ("flangeye: ok", remark)))
    assert hostile == without_comments(CalibratedPose(BENIGN, ("flangeye: ok",)))


@pytest.mark.parametrize("text", [*HOSTILE, "", "a" * 65])
@pytest.mark.parametrize("name", READERS)
def test_a_hostile_name_is_refused(name: str, text: str) -> None:
    stage = BY_NAME[name]
    with pytest.raises((StageError, ValueError)):
        written(name, CalibratedPose(BENIGN), name=text)
    if text in HOSTILE:
        with pytest.raises((StageError, ValueError)):
            stage(pose=CalibratedPose(BENIGN), params=params_of(name).model_construct(name=text))
    with pytest.raises(ValueError, match="is not a valid frame name"):
        Transform(BASE, text, np.eye(4))


@pytest.mark.parametrize(
    ("name", "word"), [("ur", "end"), ("abb", "Module"), ("doosan", "while"), ("staubli", "tool")]
)
def test_a_word_of_the_controller_s_language_is_no_name(name: str, word: str) -> None:
    with pytest.raises(StageError, match="is a word of that language; choose another"):
        written(name, CalibratedPose(BENIGN), name=word)


def test_a_controller_s_frames_are_numbered_from_0_to_999_and_the_first_is_1() -> None:
    assert [NumberedParams(number=number).number for number in (0, 999)] == [0, 999]
    assert NumberedParams().number == 1
    for number in (-1, 1000):
        with pytest.raises(ValueError, match="number"):
            NumberedParams(number=number)


def test_numbers_have_nine_places_and_zero_has_no_sign() -> None:
    assert rounded(1.23456789049) == 1.23456789
    assert fixed([-1e-12, -0.0, 1e-9, 1234.5]) == [
        "0.000000000", "0.000000000", "0.000000001", "1234.500000000"
    ]  # fmt: skip


def test_a_matrix_in_millimetres_is_one_still() -> None:
    rows = LengthParams(length="mm").matrix(CalibratedPose(BENIGN))
    assert rows[3] == [0.0, 0.0, 0.0, 1.0]
    assert [row[3] for row in rows[:3]] == [100.0, 200.0, 300.0]
    np.testing.assert_allclose(np.array(rows)[:3, :3], BENIGN.rotation, atol=1e-9)


def test_a_number_of_a_controller_s_frame_is_1_or_from_0_to_999() -> None:
    assert NumberedParams().number == 1
    assert [NumberedParams(number=number).number for number in (0, 999)] == [0, 999]
    for wrong in (-1, 1000):
        with pytest.raises(ValueError, match="number"):
            NumberedParams(number=wrong)


def test_a_node_is_called_as_the_pose_and_in_a_cell_as_the_camera() -> None:
    assert (
        "name='left_static_transform'"
        in written("ros2_launch", CalibratedPose(BENIGN), name="left").text
    )
    other = Transform(BASE, "camera_b", BENIGN.matrix)
    assert "name='camera_b_static_transform'" in written("ros2_launch", CalibratedPose(other)).text


@pytest.mark.parametrize("lengths", [False, True])
def test_an_arm_with_other_zeros_stands_as_it_reports_less_these(lengths: bool) -> None:
    robot, zeros = load_model("robots", "ur5e"), 0.01 * np.arange(1.0, 7.0)
    longer: Any = 1e-3 * np.arange(18.0).reshape(6, 3) if lengths else None
    correction = ArmCorrection(np.zeros(3), joint_offsets=zeros, lengths=longer)
    corrected, joints = Arm(with_correction(robot, correction)), np.array([0.1, -1, 1, -1, -1, 0.3])
    arm = Arm(robot) if longer is None else Arm(robot).perturbed(longer)
    np.testing.assert_allclose(corrected.flange(joints), arm.flange(joints + zeros), atol=1e-12)


@pytest.mark.parametrize("lengths", [None, 1e-3 * np.arange(18.0).reshape(6, 3)])
def test_a_corrected_arm_is_a_robot_file_of_lines_that_are_read_again(lengths: Any) -> None:
    robot, zeros = load_model("robots", "ur5e"), 0.01 * np.arange(1.0, 7.0)
    correction = ArmCorrection(np.zeros(3), joint_offsets=zeros, lengths=lengths)
    file = export_robot.function(
        CalibratedPose(BENIGN, REMARKS), calibrated(correction), robot, NamedParams(name="mine")
    )
    assert file.name == "mine.yaml" and max(map(len, file.text.splitlines())) <= 200
    assert all(f"# {remark}" in file.text for remark in REMARKS)
    read = RobotModel.model_validate(yaml.safe_load(file.text))
    assert read == with_correction(robot, correction)


@pytest.mark.parametrize("correction", [None, ArmCorrection(np.zeros(3))])
def test_an_arm_whose_joints_were_not_corrected_is_no_robot_file(correction: Any) -> None:
    robot = load_model("robots", "ur5e")
    with pytest.raises(StageError, match=r"export\.robot: no joint error of the arm was estimated"):
        export_robot.function(CalibratedPose(BENIGN), calibrated(correction), robot, NamedParams())


def calibrated(correction: ArmCorrection | None) -> HandEye:
    """Return a calibration that found this wrong with its arm."""
    return HandEye(
        TransformEstimate(BENIGN, 1e-8 * np.eye(6), np.zeros(3)), (), "solve", (), correction
    )


def test_each_format_is_explained_in_the_docs() -> None:
    page = (Path(__file__).parents[3] / "docs" / "reference" / "exports.md").read_text()
    assert [name for name in BY_NAME if f"`{name}`" not in page] == []

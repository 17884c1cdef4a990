"""An arm from its URDF: the chain, the frames, the volumes, and what is said when one is wrong."""

import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye.errors import RecipeError, StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.urdf import robot_from_urdf
from flangeye.models.urdf_meshes import _outermost, capsule_of, fit_capsule, vertices
from flangeye.motion.clearance import ArmVolume
from flangeye.plugin.registry import load_registry
from flangeye.types import Warn
from flangeye.types.geometry import rotation_from_rpy
from flangeye.workflow.recipe.load import describe_recipe, load_recipe

ORIGINS = [  # of a KUKA KR 6 R900 sixx: its maker's table
    ("0 0 0.400", "0 0 -1", 170), ("0.025 0 0", "0 1 0", 120), ("0.455 0 0", "0 1 0", 156),
    ("0 0 0.035", "-1 0 0", 185), ("0.420 0 0", "0 1 0", 120), ("0.080 0 0", "-1 0 0", 350),
]  # fmt: skip


def link(i):
    return (
        f'<link name="link_{i}"><collision><geometry><mesh filename="package://kuka/m/{i}.stl" '
        'scale="0.001 0.001 0.001"/></geometry></collision></link>'
    )


def joint(i, xyz, axis, limit, kind="revolute"):
    limit = np.radians(limit)
    return (
        f'<joint name="joint_{i}" type="{kind}"><parent link="link_{i - 1}"/>'
        f'<child link="link_{i}"/><origin xyz="{xyz}"/><axis xyz="{axis}"/>'
        f'<limit lower="{-limit}" upper="{limit}" effort="0" velocity="1"/></joint>'
    )


TOOL = (
    '<link name="flange"/><joint name="f" type="fixed"><parent link="link_6"/>'
    '<child link="flange"/></joint><link name="tool0"/><joint name="t" type="fixed">'
    f'<parent link="flange"/><child link="tool0"/><origin rpy="0 {np.pi / 2} 0"/></joint>'
)
WORLD = (
    '<link name="world"/><joint name="w" type="fixed"><parent link="world"/>'
    '<child link="link_0"/><origin xyz="1 2 3"/></joint><link name="base"/>'
    '<joint name="b" type="fixed"><parent link="link_0"/><child link="base"/></joint>'
)


@pytest.fixture
def kuka(tmp_path: Path) -> Path:
    """A URDF as xacro writes it, and its meshes in a package beside it."""
    meshes = tmp_path / "kuka" / "m"
    meshes.mkdir(parents=True)
    for i in range(7):
        trimesh.creation.box(extents=(120 + 10 * i, 80, 60)).export(meshes / f"{i}.stl")
    joints = "".join(joint(i, *each) for i, each in enumerate(ORIGINS, 1))
    links = "".join(map(link, range(7)))
    path = tmp_path / "kuka" / "urdf" / "kr6.urdf"
    path.parent.mkdir()
    path.write_text(f'<robot name="kr6_r900">{links}{joints}{TOOL}{WORLD}</robot>')
    return path


def test_the_chain_is_the_makers(kuka: Path) -> None:
    """Straight ahead at zero, as KUKA's drawing has it: 25 + 455 + 420 + 80 mm, at 435 mm."""
    robot = robot_from_urdf(kuka)
    assert robot.model == "kr6_r900"
    arm = Arm(robot)
    zero = arm.flange(np.zeros(6))
    assert zero[:3, 3] == pytest.approx([0.98, 0, 0.435])
    assert zero[:3, 2] == pytest.approx([1, 0, 0])
    assert np.degrees(arm.upper) == pytest.approx([170, 120, 156, 185, 120, 350])
    bent = arm.flange(np.radians([90, -90, 0, 0, 0, 0]))  # A1 turns against z
    assert bent[:3, 3] == pytest.approx([0, 0.01, 1.355])
    solutions = arm.inverse(arm.flange(np.array([0.3, -1.0, 1.2, 0.4, 0.9, 0.2])))
    assert np.abs(solutions - [0.3, -1.0, 1.2, 0.4, 0.9, 0.2]).max(axis=1).min() < 1e-6


def test_the_slowest_joint_that_turns_bounds_its_speed(kuka: Path) -> None:
    text = kuka.read_text()
    assert robot_from_urdf(kuka).joint_speed == 1.0
    kuka.write_text(text.replace('velocity="1"', 'velocity="3.5"', 4))
    assert robot_from_urdf(kuka).joint_speed == 1.0
    kuka.write_text(text.replace('velocity="1"', 'velocity="0"'))
    assert robot_from_urdf(kuka).joint_speed == pytest.approx(np.pi)


def test_each_link_has_a_capsule_about_its_mesh(kuka: Path) -> None:
    robot = robot_from_urdf(kuka).filled()
    assert [volume.link for volume in robot.volumes] == list(range(7))
    half = np.array([0.06, 0.04, 0.03])
    assert robot.volumes[0].radius == pytest.approx(np.hypot(*half[1:]), rel=2e-3)
    assert ArmVolume(robot).axes(Arm(robot).frames(np.zeros(6))).shape == (7, 2, 3)


@given(st.integers(0, 2**32 - 1), st.integers(2, 60))
@settings(max_examples=30)
def test_a_capsule_holds_its_points_and_is_no_larger_than_a_ball_about_them(
    seed: int, count: int
) -> None:
    rng = np.random.default_rng(seed)
    points = (
        rng.normal(size=(count, 3))
        * rng.uniform(0.01, 1, 3)
        @ rotation_from_rpy(*rng.normal(size=3)).T
    )
    capsule = fit_capsule(points)
    assert capsule.distance(points).max() < 1e-9
    ball = np.linalg.norm(points - points.mean(axis=0), axis=1).max()
    assert capsule.volume < 4 / 3 * np.pi * (1.5 * ball) ** 3


@pytest.mark.parametrize("spread", [(1.0, 0.2), (1.0, 0.0)], ids=["plane", "line"])
def test_the_point_farthest_from_a_place_is_among_the_outermost(
    spread: tuple[float, float],
) -> None:
    rng = np.random.default_rng(0)
    flat = rng.normal(size=(500, 2)) * spread @ [[0.8, 0.6], [-0.6, 0.8]]
    outer = _outermost(flat)
    assert len(outer) < 50 or spread[1] == 0
    for place in rng.normal(size=(100, 2)):
        farthest = [one[((one - place) ** 2).sum(axis=1).argmax()] for one in (flat, outer)]
        assert (farthest[0] == farthest[1]).all()


@pytest.mark.parametrize("name", ["stl", "obj", "dae"])
def test_meshes_as_they_are_published(kuka: Path, name: str) -> None:
    for file in (kuka.parents[1] / "m").glob("*.stl"):
        trimesh.load_mesh(file).export(file.with_suffix(f".{name}"))
    kuka.write_text(kuka.read_text().replace(".stl", f".{name}"))
    radius = robot_from_urdf(kuka).filled().volumes[0].radius
    assert radius == pytest.approx(0.05, rel=2e-3)


def test_missing_meshes_matter_where_a_plan_needs_them(kuka: Path, tmp_path: Path) -> None:
    moved = tmp_path / "alone.urdf"
    moved.write_text(kuka.read_text().replace("package://kuka", "package://kuka_support"))
    robot = robot_from_urdf(moved)
    assert Arm(robot).n == 6
    with pytest.raises(StageError) as error:
        ArmVolume(robot)
    assert "write robot: {packages: {kuka_support: FOLDER}}, where FOLDER holds m/" in str(
        error.value
    )
    named = robot_from_urdf(moved, packages={"kuka_support": tmp_path / "kuka"}).filled()
    assert len(named.volumes) == 7


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: re.sub("<mesh [^>]*>", '<sphere radius="0"/>', t),
         "the <sphere> of link 'link_0' has a radius of 0 mm; give it a radius above zero, or remove the body"),
        (lambda t: t.replace('scale="0.001 0.001 0.001"', 'scale="1e400 1 1"', 1),
         'scale="1e400 1 1" is not three finite numbers'),
        (lambda t: re.sub("<collision>.*?</collision>", "", t), "no link of the arm has a coll"),
    ],
)  # fmt: skip
def test_bodies_matter_where_something_moves(
    kuka: Path, change: Callable[..., Any], words: str
) -> None:
    kuka.write_text(change(kuka.read_text()))
    robot = robot_from_urdf(kuka)
    assert Arm(robot).n == 6
    with pytest.raises(StageError, match=words):
        ArmVolume(robot)


def test_which_links_were_taken_is_said(kuka: Path) -> None:
    robot = robot_from_urdf(kuka)
    assert robot.notes == (f"{kuka}: base 'base', flange 'tool0'",)
    text = kuka.read_text().replace('name="base"', 'name="foot"').replace('"base"', '"foot"')
    kuka.write_text(re.sub("<collision>.*?</collision>", "", text, count=2))
    base, without = robot_from_urdf(kuka).notes
    assert base == f"{kuka}: base 'link_0', flange 'tool0'"  # not the world above it
    assert "2 of 7 links have no collision body (link_0, link_1)" in without
    kuka.write_text(re.sub("<collision>.*?</collision>", "", text))
    assert (
        "no link has a <collision> body, so that no moves can be planned"
        in (robot_from_urdf(kuka).notes[1])
    )


def test_a_gripper_is_no_flange_but_what_its_fingers_stand_on(kuka: Path) -> None:
    """The last link is taken; where the gripper has a base of its own, one of the two is asked."""

    def finger(on: str, side: int) -> str:
        return (
            f'<link name="finger_{side}"/><joint name="slide_{side}" type="prismatic">'
            f'<parent link="{on}"/><child link="finger_{side}"/><axis xyz="0 {side} 0"/>'
            '<limit lower="0" upper="0.04" velocity="1"/><mimic joint="slide_1"/></joint>'
        )

    bare = kuka.read_text().replace(TOOL, "")
    kuka.write_text(bare.replace("</robot>", f"{finger('link_6', 1)}{finger('link_6', 2)}</robot>"))
    assert "flange 'link_6'" in robot_from_urdf(kuka).notes[0]
    hand = TOOL.replace("tool0", "hand").replace('"flange"', '"palm"')
    fingers = f"{hand}{finger('hand', 1)}{finger('hand', 2)}"
    kuka.write_text(bare.replace("</robot>", f"{fingers}</robot>"))
    with pytest.raises(RecipeError, match="write flange: link_6 or palm or hand$"):
        robot_from_urdf(kuka)


def test_a_flange_that_looks_aside_is_said_with_the_line_that_turns_it(kuka: Path) -> None:
    odd = robot_from_urdf(kuka, flange="flange").notes[1]
    assert isinstance(odd, Warn)
    assert f"{kuka}: z of flange 'flange' is 90 deg to the last axis, which is x of" in odd
    line = odd.fix.partition("to the URDF: ")[2]
    kuka.write_text(kuka.read_text().replace("</robot>", f"{line}</robot>"))
    turned = robot_from_urdf(kuka, flange="flange_face")
    assert len(turned.notes) == 1
    assert Arm(turned).flange(np.zeros(6))[:3, 2] == pytest.approx([1, 0, 0], abs=1e-5)


def test_check_asks_for_the_bodies_that_a_move_needs(kuka: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "cell.yaml"
    head = "title: T\nrobot: {urdf: kuka/urdf/kr6.urdf}\nscanner: {model: phoxi-m}\n"
    head += "feature: {standard: ISO 9409-1-40-4-M6}\nsteps: ["
    tail = ", segment.flange, fit.rim, solve.robust]\n"
    registry = load_registry()
    (kuka.parents[1] / "m" / "4.stl").unlink()
    recipe.write_text(f"{head}acquire.archive: {{path: .}}{tail}")
    assert "ok, 4 steps" in describe_recipe(recipe, registry)  # nothing moves
    recipe.write_text(f"{head}acquire.simulated{tail}")
    with pytest.raises(StageError, match=r"plan its moves: .*mesh 'package://kuka/m/4\.stl'"):
        describe_recipe(recipe, registry)
    kuka.write_text(re.sub("<mesh [^>]*>", '<sphere radius="0"/>', kuka.read_text()))
    with pytest.raises(StageError, match="the <sphere> of link 'link_0' has a radius of 0 mm"):
        describe_recipe(recipe, registry)


def test_an_arm_of_five_joints_is_sent_nowhere(kuka: Path, tmp_path: Path) -> None:
    text = kuka.read_text().replace('"joint_4" type="revolute"', '"joint_4" type="fixed"')
    kuka.write_text(text)
    recipe = tmp_path / "cell.yaml"
    driver = "driver: {ur_rtde: {host: auto}}, limits: {box: {centre: [500 mm, 0 mm, 400 mm], "
    driver += "size: [800 mm, 800 mm, 800 mm]}, joint_speed: 10 deg/s}"
    head = f"title: T\nrobot: {{urdf: kuka/urdf/kr6.urdf, {driver}}}\n"
    head += "feature: {standard: ISO 9409-1-40-4-M6}\n"
    head += "scanner: {model: phoxi-m, driver: {watched_folder: {path: scans, unit: mm}}}\n"
    steps = "segment.flange, fit.rim, solve.robust]\n"
    recipe.write_text(f"{head}steps: [acquire.archive, {steps}")
    registry = load_registry()
    said = describe_recipe(recipe, registry)
    assert f"note: {kuka}: base 'base', flange 'tool0'" in said
    view = "{view: {guess: {position: [620 mm, 0 mm, 980 mm]}}}"
    recipe.write_text(f"{head}steps: [acquire.live: {view}, {steps}")
    with pytest.raises(RecipeError, match="kr6_r900 has 5 joints, .* robot: {flange: ISO 9409"):
        describe_recipe(recipe, registry)


def test_a_rail_and_a_base_of_ones_own(kuka: Path) -> None:
    text = kuka.read_text().replace(
        'name="joint_1" type="revolute"', 'name="joint_1" type="prismatic"'
    )
    kuka.write_text(text)
    arm = Arm(robot_from_urdf(kuka, base="world", flange="flange"))
    assert arm.slides.tolist() == [True] + 5 * [False]
    assert arm.flange(np.array([0.1, 0, 0, 0, 0, 0]))[:3, 3] == pytest.approx([1.98, 2, 3.335])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t[:-5], "not valid XML"),
        (lambda t: f'<!DOCTYPE r [<!ENTITY a "aa">]>{t}', "declares a document type or entities"),
        (lambda t: t.replace("0 0 0.400", "0 0 9e307"), "an <origin> reaches 9e.307 m; a URDF's"),
        (lambda t: t.replace('axis xyz="0 0 -1"', 'axis xyz="0 0 -1e-320"'), "needs a direction"),
        (lambda t: t.replace("robot", "sdf"), "is not a URDF: its root element is <sdf>"),
        (lambda t: t.replace(">", ' xmlns:xacro="http://wiki.ros.org/xacro"><xacro:macro/>', 1), "expand it: xacro"),
        (lambda t: t.replace("tool0", "a").replace("flange", "b").replace("</robot>",
         '<link name="c"/><joint name="c" type="fixed"><parent link="link_6"/><child link="c"/>'
         "</joint></robot>"), "which link is the flange, .* write flange: a or c"),
        (lambda t: t.replace("revolute", "fixed"), "no joint moves between base and flange"),
        (lambda t: t.replace("0 0 0.400", "0 0 x"), 'xyz="0 0 x" is not three finite numbers'),
        (lambda t: t.replace("0 0 0.400", "0 0"), 'xyz="0 0" is not three finite numbers'),
        (lambda t: t.replace('velocity="1"', 'velocity=""'),
         'velocity="" is not one finite number'),
        (lambda t: t.replace('velocity="1"', 'velocity="nan"', 1),
         'velocity="nan" is not one finite number'),
        (lambda t: re.sub('lower="[^"]*"', 'lower="nan"', t), 'lower="nan" is not one finite'),
        (lambda t: t.replace('axis xyz="0 0 -1"', 'axis xyz="0 0 0"'),
         r"kr6.urdf: joint axis: an axis needs a direction, for example \[0, 0, 1\]"),
        (lambda t: t.replace('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><mimic joint="joint_1"/>'),
         "joint 'joint_2' follows another one .mimic., .* robot: {flange: ISO 9409-1-50-4-M6}"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_urdf_is_one_line(
    kuka: Path, change: Callable[..., Any], words: str
) -> None:
    kuka.write_text(change(kuka.read_text()))
    with pytest.raises(RecipeError, match=words) as error:
        robot_from_urdf(kuka)
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize("kind", ["revolute", "fixed"])
def test_long_chains_take_time_with_their_length_and_messages_stay_short(
    kind: str, tmp_path: Path
) -> None:
    def steps(count: int) -> int:
        """Lines run while a chain of so many links is read: a clock would tell the load as well."""
        joints = (joint(i, "0 0 0.1", "0 0 1", 90, kind) for i in range(1, count))
        links = (f'<link name="link_{i}"/>' for i in range(count))
        path = tmp_path / "long.urdf"
        path.write_text(f'<robot name="long">{"".join(links)}{"".join(joints)}</robot>')
        told: list[object] = []
        run = 0

        def count_lines(frame: FrameType, event: str, argument: object) -> Any:
            nonlocal run
            run += 1
            return count_lines

        before = sys.gettrace()
        sys.settrace(count_lines)
        try:
            for flange in (None, "x" * 99):
                try:
                    told += robot_from_urdf(path, flange=flange).notes
                except RecipeError as error:
                    told.append(error)
        finally:
            sys.settrace(before)
        assert max(len(str(words)) for words in told) < 600
        return run

    short, long = steps(250), steps(4_000)
    assert long < 16 * 1.5 * short


@pytest.mark.parametrize(
    ("content", "name", "words"),
    [
        (b"<!DOCTYPE COLLADA [<!ENTITY a 'x'>]><COLLADA/>", "m.dae", "declares a document type"),
        (b"mtllib ../../secret.mtl\n", "m.gltf", "'.gltf' is not a mesh format; known: .stl"),
        (None, "m.stl", "is a device, a FIFO or a socket; a file is needed"),
    ],
)
def test_meshes_come_through_the_one_door(
    kuka: Path, content: bytes | None, name: str, words: str
) -> None:
    mesh = kuka.parent / name
    if content is None:
        mesh.symlink_to("/dev/zero")
    else:
        mesh.write_bytes(content)
    with pytest.raises(RecipeError, match=re.escape(words)):
        vertices(mesh)


def test_eight_lines_for_a_kuka_and_an_unknown_scanner(kuka: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "cell.yaml"
    recipe.write_text(
        "title: My cell\nrobot: {urdf: kuka/urdf/kr6.urdf}\nfeature: {standard: ISO 9409-1-40-4-M6}\n"
        "scanner: {name: ACME 3000, range: [300 mm, 900 mm]}\n"
        "steps: [acquire.archive, segment.flange, fit.rim, solve.robust]\n"
    )
    load_recipe(recipe, load_registry())
    recipe.write_text(
        recipe.read_text().replace("kr6.urdf}", "kr6.urdf, flange: ISO 9409-1-40-4-M6}")
    )
    with pytest.raises(RecipeError, match="the plate goes to feature: {standard: …}"):
        load_recipe(recipe, load_registry())


@pytest.mark.parametrize(
    ("robot", "words"),
    [
        ("{urdf: a.urdf, factory: calibration.conf}", "a urdf brings its own calibration"),
        ("{urdf: a.urdf, model: ur5}", "either a model or a urdf, not both"),
        ("{model: ur5, base: base_link}", "belong to a urdf; name the urdf too"),
        ("{urdf: a.urdf}", "robot.urdf: .*a.urdf: cannot be read"),
    ],
)
def test_what_does_not_go_together_is_refused(robot: str, words: str, tmp_path: Path) -> None:
    recipe = tmp_path / "cell.yaml"
    recipe.write_text(f"title: T\nrobot: {robot}\nsteps: [acquire.samples, solve.shah]\n")
    with pytest.raises(RecipeError, match=words):
        load_recipe(recipe, load_registry())


@pytest.mark.parametrize("radius", ["1e308", "2000"])
def test_a_body_larger_than_any_arm_is_refused_and_not_worked_on_for_ever(radius: str) -> None:
    body = ElementTree.fromstring(f'<cylinder radius="{radius}" length="0.2" />')
    with pytest.raises(RecipeError, match=r"a.urdf: a <cylinder> reaches .* m; a URDF's lengths"):
        capsule_of(body, Path("a.urdf"), {})

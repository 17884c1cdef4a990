"""An arm from its URDF: kinematics and limits; its collision bodies are read when it moves."""

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from flangeye.errors import RecipeError
from flangeye.files.regular import read_text
from flangeye.files.words import nearest, require_name
from flangeye.models.robots import FlangeDetails, Joint, Placement, RobotModel, Volume
from flangeye.models.urdf_meshes import capsule_of, mesh_of, numbers_of, require_metres
from flangeye.types import Floats, Note, Warn
from flangeye.types.geometry import (
    basis_of_plane,
    invert,
    rigid,
    rotation_from_rpy,
    rpy_from_rotation,
)
from flangeye.units import SI

URDF_BYTES = 10_000_000
TURNS = ("revolute", "continuous")
MOVES = (*TURNS, "prismatic")
LINKS_NAMED = 8
"""Links that a message names."""


@dataclass(frozen=True)
class Urdf:
    """A URDF file, read.

    Attributes:
        path: Path of the file.
        name: Name of the robot.
        links: Links by name.
        above: Link's name -> the joint that carries it.
    """

    path: Path
    name: str
    links: Mapping[str, ET.Element]
    above: Mapping[str, ET.Element]

    def chain(self, link: str) -> list[ET.Element]:
        """Return the joints from the root to a link."""
        joints: list[ET.Element] = []
        while link in self.above:
            # A damaged file may close its chain to a ring; a chain cannot have more joints than
            # links.
            joints.append(self.above[link])
            link = end_of(joints[-1], "parent")
            if len(joints) > len(self.links):
                raise RecipeError(f"{self.path}: its joints form a closed loop at link '{link}'")
        return joints[::-1]

    def moved(self) -> list[str]:
        """Return the links that a joint moves; each is visited once."""
        known: dict[str, bool] = {}
        for name in self.links:
            new, at = list[str](), name
            while at in self.above and at not in known:
                new.append(at)
                at = end_of(self.above[at], "parent")
                if len(new) > len(self.links):
                    raise RecipeError(f"{self.path}: its joints go round in a circle at '{at}'")
            moves = known.get(at, False)
            for link in reversed(new):
                moves = known[link] = moves or self.above[link].get("type") in MOVES
        return [name for name in self.links if known.get(name)]


class UrdfArm(NamedTuple):
    """An arm, the links that were taken as its base and flange, and its joints' names in order."""

    robot: RobotModel
    base: str
    flange: str
    joints: list[str]


def robot_from_urdf(
    path: Path,
    base: str | None = None,
    flange: str | None = None,
    standard: str | None = None,
    packages: Mapping[str, Path] | None = None,
) -> RobotModel:
    """Return the arm between two links of a URDF, as xacro writes one.

    Args:
        path: The file.
        base: Link that is the controller's base frame; found by its name if not given.
        flange: Link at the plate's face, z outwards; found by its name if not given.
        standard: Designation of the plate.
        packages: Folder of each package that mesh names refer to.

    Raises:
        RecipeError: It is not a URDF, or its base or flange link is ambiguous.
    """
    return arm_of(read_urdf(path), base, flange, standard, packages).robot


def arm_of(
    urdf: Urdf,
    base: str | None = None,
    flange: str | None = None,
    standard: str | None = None,
    packages: Mapping[str, Path] | None = None,
) -> UrdfArm:
    """Return the arm of a URDF that was read; see :func:`robot_from_urdf`."""
    path, flange = urdf.path, _flange(urdf, flange)
    to_flange = urdf.chain(flange)
    base = _base(urdf, base, to_flange)
    to_base = urdf.chain(base)
    shared = _shared(to_base, to_flange)
    if any(joint.get("type") in MOVES for joint in to_base[shared:]):
        raise RecipeError(
            f"{path}: base '{base}' moves relative to the arm's foot; name a link nearer to the "
            f"root"
        )
    # The controller's base may be a side branch, as ROS-Industrial's `base` is: the arm's chain
    # begins where the two part
    # `root` is the last common link of both chains.
    base_T_root = invert(_fixed(path, to_base[shared:]))
    try:
        robot = _assemble(urdf, base_T_root, to_flange[shared:], standard)
        bodies = UrdfBodies(urdf, base_T_root, to_flange[shared:], packages or {})
        robot = robot.from_urdf(bodies, tuple(_notes(urdf, robot, base, flange, bodies)))
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        what = first["msg"].removeprefix("Value error, ")
        raise RecipeError(f"{path}: {error.title.lower()} {field}: {what}") from None
    moving = [j.get("name", "") for j in to_flange[shared:] if j.get("type") in MOVES]
    return UrdfArm(robot, base, flange, moving)


def read_urdf(path: Path) -> Urdf:
    """Read a URDF file.

    Raises:
        RecipeError: It is not XML, not a URDF, or a xacro that was not expanded.
    """
    return parse_urdf(read_text(path, URDF_BYTES, RecipeError), path)


def parse_urdf(text: str, path: Path) -> Urdf:
    """Return the URDF in a text; raises as :func:`read_urdf`, of ``path``."""
    # A few nested entities expand to gigabytes
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise RecipeError(f"{path}: declares a document type or entities, which are not read")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise RecipeError(f"{path}:{error.position[0]}: not valid XML: {error}") from None
    if root.tag != "robot":
        raise RecipeError(f"{path}: is not a URDF: its root element is <{root.tag}>, not <robot>")
    if any("xacro" in element.tag for element in root.iter()):
        raise RecipeError(f"{path}: is xacro, not yet a URDF; expand it: xacro {path} > arm.urdf")
    links = {link.get("name", ""): link for link in root.findall("link")}
    above = {end_of(joint, "child"): joint for joint in root.findall("joint")}
    name = root.get("name") or path.stem
    for each in (name, *links, *above, *(end_of(joint, "parent") for joint in above.values())):
        require_name(str(path), each)
    return Urdf(path, name, links, above)


@dataclass
class UrdfBodies:
    """The collision bodies of the links between base and flange.

    Attributes:
        urdf: The file.
        base_T_first: (4, 4) pose of the chain's first link in the base [m].
        chain: The joints from there to the flange.
        packages: Folder of each package that mesh names refer to.
    """

    urdf: Urdf
    base_T_first: Floats
    chain: list[ET.Element]
    packages: Mapping[str, Path]

    @cached_property
    def volumes(self) -> tuple[Volume, ...]:
        """Return the capsules round the bodies.

        Raises:
            RecipeError: A body is missing or wrong; names its link.
        """
        volumes = tuple(volume for link in self.links() for volume in self._of(*link))
        if not volumes:
            raise RecipeError(f"{self.urdf.path}: no link of the arm has a collision body")
        return volumes

    def meshes(self) -> Iterator[tuple[int, Any]]:
        """Yield the shape of each link as a trimesh in its moving frame, and the frame's number.

        Collision meshes are preferred: they have a twentieth of the visual meshes' triangles.

        Raises:
            RecipeError: A mesh is missing or wrong.
        """
        for link, index, pose in self.links():
            of = self.urdf.links[link]
            rough = of.find("collision/geometry/mesh") is not None
            # Primitive collision shapes (boxes, cylinders) show no arm: then the visual meshes are
            # better.
            first, second = ("collision", "visual") if rough else ("visual", "collision")
            for body in of.findall(first) or of.findall(second):
                geometry = body.find("geometry")
                if geometry is not None and len(geometry):
                    mesh = mesh_of(geometry[0], self.urdf.path, self.packages)
                    yield index, mesh.apply_transform(pose @ origin_of(self.urdf.path, body))

    def without(self) -> list[str]:
        """Return the moving links that have no collision body, and none on a link fixed to them."""
        bodies: dict[int, list[str]] = {}
        for link, index, _ in self.links():
            of = self.urdf.links.get(link)
            has = of is not None and of.find("collision/geometry/*") is not None
            bodies.setdefault(index, []).append("" if has else link)
        return [links[0] for links in bodies.values() if all(links)]

    def links(self) -> Iterator[tuple[str, int, Floats]]:
        """Yield each link, the number of moving joints before it, and its pose in their frame."""
        before, moved = self.base_T_first, 0
        yield end_of(self.chain[0], "parent"), moved, before
        for joint in self.chain:
            before = before @ origin_of(self.urdf.path, joint)
            if joint.get("type") in MOVES:
                before, moved = np.eye(4), moved + 1
            yield end_of(joint, "child"), moved, before

    def _of(self, link: str, index: int, pose: Floats) -> Iterator[Volume]:
        of = self.urdf.links.get(link)
        for collision in [] if of is None else of.findall("collision"):
            geometry = collision.find("geometry")
            if geometry is None or not len(geometry):
                continue
            placed = pose @ origin_of(self.urdf.path, collision)
            capsule = capsule_of(geometry[0], self.urdf.path, self.packages)
            if not capsule.radius > 0:
                raise RecipeError(
                    f"{self.urdf.path}: the <{geometry[0].tag}> of link '{link}' has a radius of "
                    f"{1e3 * capsule.radius:g} mm; give it a radius above zero, or remove the body"
                )
            ends = [placed[:3, :3] @ end + placed[:3, 3] for end in (capsule.start, capsule.end)]
            start, end = (tuple(map(SI, point)) for point in ends)
            yield Volume(link=index, start=start, end=end, radius=SI(capsule.radius))


def _assemble(
    urdf: Urdf, base_T_first: Floats, chain: list[ET.Element], standard: str | None
) -> RobotModel:
    joints: list[Joint] = []
    before = base_T_first  # from the last moving link, or the base, to the link that is reached
    # The same walk as in UrdfBodies.links: poses start anew at each moving joint, whose motion
    # comes between.
    for joint in chain:
        # Fixed joints on the way become part of the next moving joint's origin
        before = before @ origin_of(urdf.path, joint)
        if joint.get("type") in MOVES:
            joints.append(_joint(urdf, joint, before))
            before = np.eye(4)
    if not joints:
        raise RecipeError(f"{urdf.path}: no joint moves between base and flange")
    return RobotModel(
        model=urdf.name,
        maker="",
        convention="urdf",
        joints=tuple(joints),
        flange_frame=Placement(**_pose(before)),
        flange=FlangeDetails(standard=standard),
        volumes_missing=f"the bodies of {urdf.path} were not read; name the URDF in the recipe",
        source=f"URDF {urdf.path.name}",
        **_joint_speed(urdf.path, chain),
    )


def _joint_speed(path: Path, chain: Iterable[ET.Element]) -> dict[str, SI]:
    """Return the speed of the slowest joint that turns [rad/s], where the file has any."""
    limits = [joint.find("limit") for joint in chain if joint.get("type") in TURNS]
    # Continuous joints are often written with an infinite speed, which says nothing.
    bounded = [limit for limit in limits if limit is not None and limit.get("velocity") != "inf"]
    told = [numbers_of(path, limit, "velocity", "0", 1)[0] for limit in bounded]
    speeds = [speed for speed in told if speed > 0]
    return {"joint_speed": SI(min(speeds))} if speeds else {}


def _joint(urdf: Urdf, joint: ET.Element, pose: Floats) -> Joint:
    if joint.find("mimic") is not None:
        raise RecipeError(
            f"{urdf.path}: joint '{joint.get('name')}' follows another one (mimic), which is not "
            "supported between base and flange; recordings with the flange's poses need no "
            "kinematics: robot: {flange: ISO 9409-1-50-4-M6}"
        )
    # Where the file states none, URDF's defaults hold: the axis x, and limits of 0
    axis, limit = joint.find("axis"), joint.find("limit")
    lower, upper = -2 * np.pi, 2 * np.pi
    if joint.get("type") != "continuous" and limit is not None:
        lower, upper = (numbers_of(urdf.path, limit, end, "0", 1)[0] for end in ("lower", "upper"))
    return Joint(
        axis=tuple(numbers_of(urdf.path, axis, "xyz", "1 0 0")),
        slides=joint.get("type") == "prismatic",
        lower=SI(lower),
        upper=SI(upper),
        **_pose(pose),
    )


def _notes(
    urdf: Urdf, robot: RobotModel, base: str, flange: str, bodies: UrdfBodies
) -> Iterator[Note]:
    """Yield notes on the links used as base and flange, and warnings about them."""
    yield f"{urdf.path}: base '{base}', flange '{flange}'"
    if (odd := _sideways(urdf, robot, flange)) is not None:
        yield odd
    without = bodies.without()
    if len(without) > len(robot.joints):
        yield f"{urdf.path}: no link has a <collision> body, so that no moves can be planned"
    elif without:
        yield (
            f"{urdf.path}: {len(without)} of {len(robot.joints) + 1} links have no collision body "
            f"({_some(without)}); planned moves may collide with them"
        )


def _sideways(urdf: Urdf, robot: RobotModel, flange: str) -> Warn | None:
    """Return a warning if the flange's z is not along the last joint's axis; None if it is."""
    joint, end = robot.joints[-1], robot.link_T_flange
    axis = np.asarray(joint.axis) / np.linalg.norm(joint.axis)
    # How far the flange is along the axis from the joint before shows which way is outwards.
    # An axis has no sense of its own: joints are drawn turning either way about it.
    along = axis @ (rotation_from_rpy(*joint.rpy).T @ np.asarray(joint.xyz) + end[:3, 3])
    seen = end[:3, :3].T @ axis * (-1.0 if along < 0 else 1.0)
    known = abs(along) > 1e-3
    off = np.arccos(np.clip(seen[2] if known else abs(seen[2]), -1, 1))
    # A flange's z is along the last axis; beyond this angle [rad] it is another frame of the link
    if off < np.radians(5.0) or joint.slides:
        return None
    rpy = " ".join(f"{round(angle, 6):z.6g}" for angle in rpy_from_rotation(basis_of_plane(seen).T))
    name = f"{flange}_face"
    return Warn(
        f"{urdf.path}: z of flange '{flange}' is {np.degrees(off):.0f} deg to the last axis, "
        f"which is {_axis_name(seen)} of '{flange}'; z of a flange points out of its plate",
        f"name the link whose z does (robot: {{urdf: {urdf.path.name}, flange: LINK}}), or add one "
        f'to the URDF: <link name="{name}"/><joint name="{name}" type="fixed"><parent '
        f'link="{flange}"/><child link="{name}"/><origin rpy="{rpy}"/></joint>',
    )


def _axis_name(direction: Floats) -> str:
    """Return the nearest axis of a frame: x, -y and so on."""
    k = int(np.argmax(np.abs(direction)))
    return ("-" if direction[k] < 0 else "") + "xyz"[k]


def _base(urdf: Urdf, asked: str | None, to_flange: list[ET.Element]) -> str:
    """Return the base's link.

    It is the requested link, else the frame that ROS-Industrial calls ``base``, else the parent of
    the first moving joint.
    """
    if asked is not None:
        return _known(urdf, asked, "base")
    prefixes = [name.removesuffix("base_link") for name in urdf.links if name.endswith("base_link")]
    named = [name for name in urdf.links if name in ("base", *(f"{p}base" for p in prefixes))]
    moving = [joint for joint in to_flange if joint.get("type") in MOVES]
    if not moving:
        raise RecipeError(f"{urdf.path}: no joint moves between base and flange")
    return named[0] if len(named) == 1 else end_of(moving[0], "parent")


def flange_links(urdf: Urdf) -> list[str]:
    """Return the link that is the flange by a name that makers use, or those that may be it.

    They are the ends of the arm, or the links that its gripper's fingers stand on.
    """
    # Makers' names of the flange's frame, z outwards; the surest first
    for ending in ("tool0", "flange", "link8", "link_ee", "ee_link", "end_effector", "tool_frame"):
        named = [name for name in urdf.links if name.endswith(ending)]
        if len(named) == 1:
            return named
    parents = {end_of(joint, "parent") for joint in urdf.above.values()}
    ends = [name for name in urdf.moved() if name not in parents]
    if not 1 < len(ends) <= LINKS_NAMED:
        return ends
    chains = {end: urdf.chain(end) for end in ends}
    return _before_fingers(chains) or ends


def _before_fingers(chains: Mapping[str, list[ET.Element]]) -> list[str]:
    """Return the links that a gripper's fingers stand on, and the fixed ends; empty without one."""
    first, *others = chains.values()
    shared = min(_shared(first, chain) for chain in others)
    moving = {
        end: sum(joint.get("type") in MOVES for joint in chain[shared:])
        for end, chain in chains.items()
    }
    arm = [i for i, joint in enumerate(first[:shared]) if joint.get("type") in MOVES]
    # Two arms on a torso move by more joints than it does, a gripper's fingers by fewer
    if not 0 < max(moving.values()) < len(arm):
        return []
    fixed = [end for end, count in moving.items() if not count]
    return [*(end_of(joint, "child") for joint in first[arm[-1] : shared]), *fixed]


def _flange(urdf: Urdf, asked: str | None) -> str:
    """Return the flange: as asked, or the only link that may be it."""
    if asked is not None:
        return _known(urdf, asked, "flange")
    links = flange_links(urdf)
    if len(links) == 1:
        return links[0]
    raise RecipeError(
        f"{urdf.path}: which link is the flange, with its origin in the plate's face and z "
        f"pointing outwards? "
        f"write flange: {' or '.join(links[:LINKS_NAMED]) or 'NAME'}"
    )


def _known(urdf: Urdf, asked: str, what: str) -> str:
    if asked in urdf.links:
        return asked
    hint = "; the plate goes to feature: {standard: …}" if "9409" in asked else ""
    near = nearest(asked, urdf.links) or list(urdf.links)
    raise RecipeError(f"{urdf.path}: {what}: no link '{asked}'; links: {_some(near)}{hint}")


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - LINKS_NAMED} more" if len(names) > LINKS_NAMED else ""
    return ", ".join(names[:LINKS_NAMED]) + more


def _shared(first: list[ET.Element], second: list[ET.Element]) -> int:
    """Return how many joints two chains from the root begin with in common."""
    count = 0
    while count < min(len(first), len(second)) and first[count] is second[count]:
        count += 1
    return count


def _fixed(path: Path, joints: list[ET.Element]) -> Floats:
    pose = np.eye(4)
    for joint in joints:
        pose = pose @ origin_of(path, joint)
    return pose


def origin_of(path: Path, element: ET.Element) -> Floats:
    """Return the pose (4, 4) [m] that an element's ``origin`` has in its parent.

    Raises:
        RecipeError: An attribute is not three finite numbers.
    """
    origin = element.find("origin")
    rpy = numbers_of(path, origin, "rpy", "0 0 0")
    xyz = numbers_of(path, origin, "xyz", "0 0 0")
    require_metres(path, "an <origin>", xyz)
    return rigid(rotation_from_rpy(*rpy), np.array(xyz))


def _pose(pose: Floats) -> dict[str, Any]:
    rpy = rpy_from_rotation(pose[:3, :3])
    return {"xyz": tuple(map(SI, pose[:3, 3])), "rpy": tuple(map(SI, rpy))}


def end_of(joint: ET.Element, which: str) -> str:
    """Return a joint's ``parent`` or ``child`` link, empty where it names none."""
    end = joint.find(which)
    return "" if end is None else end.get("link", "")

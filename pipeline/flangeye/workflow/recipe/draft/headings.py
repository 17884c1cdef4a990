"""Infer the meaning of a table's columns from their names: poses, points, joint angles.

A name of two frames gives owner and direction of a pose: ``gripper2base`` is a pose of the arm, and
``camera_T_target``, ``T_cam_board`` and ``cHt`` are the target's pose in the camera.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from flangeye.files.scans import CLOUD_SUFFIXES, IMAGES
from flangeye.files.tables import CellValue, Column, Table, entry_of_list, number_of
from flangeye.models.robots import joints_in_order
from flangeye.types.pose_formats import ANGLES, CONVENTIONS, LENGTHS

JOINTS_ONLY = ("joints",)
"""Stands for a rotation if the columns hold joint angles."""
_POSITION_WORDS = (
    "position", "pos", "translation", "trans", "tvec", "location", "origin", "t", "p", "xyz",
)  # fmt: skip
_TURN_WORDS: Mapping[str, str] = {
    "orientation": "q", "ori": "q", "quaternion": "q", "quat": "q", "q": "q",
    "rotation": "r", "rot": "r", "r": "r", "euler": "r", "angle": "r", "winkel": "r", "theta": "r",
    "rvec": "v", "rotvec": "v", "rodrigues": "v", "rpy": "e",
}  # fmt: skip
"""Names of rotations, and the prefixes of their columns' names."""
_OPENCV = ("rvec", "tvec")
"""OpenCV's names for the pose of an object in the camera."""
_ROTATIONS: Mapping[int, str | None] = {6: None, 7: "xyzw", 12: "matrix", 16: "matrix"}
"""Lengths of lists that are whole poses, and what their numbers are unless a name decides."""
_JOINT_HEADING = re.compile(
    r"(?:j_?\d|(?:q|a|axis|theta)_?[1-9])(?:_?(?:rad|deg|pos|position))?"
    r"|(?!.*(?:vel|eff|torque|acc|current|temp)).*joint.*"
)


SEEN = re.compile(
    r"target|mark|cam|board|tag|aruco|pattern|checker|chess|fiducial|cent(er|re)|seen|sphere|object|"
    r"optical|track|detect|vision"
)
"""Words in column names of camera measurements."""

_ARM_WORDS = re.compile(
    r"robot|arm|joint|gripper|flange|(?<!eye.in.)hand(?!.?eye)|tool|tcp|effector|"
    r"(?<![a-z])(?:ee|rob)(?![a-z])"
)

_FRAMES: Mapping[str, str] = {
    name: frame
    for frame, names in {
        "base": "b base robotbase",
        "flange": "f g e h flange gripper hand ee eef effector endeffector end tool tcp robot",
        "camera": "c cam camera sensor scanner",
        "target": "o t m target object obj board marker tag pattern checkerboard chessboard",
        "world": "w world",
    }.items()
    for name in names.split()
}
_ENTRY = re.compile(r"(?:r|m|t|rot|mat)([0-3])([0-3])")
"""Entry of a matrix in row and column: ``r11``, ``m03``."""
_TO = re.compile(r"(?<![a-zA-Z])([a-zA-Z]+)(?:2|_to_|To)([a-zA-Z]+)")
_IN = re.compile(r"(?<![a-zA-Z])([a-z]+)_?[THM]_?([a-z]+)(?![a-zA-Z])")
_OF = re.compile(r"(?<![a-zA-Z])[TH]_([a-z]+)_([a-z]+)")


def _rotations() -> dict[tuple[str, ...], tuple[str, ...]]:
    """Return the conventions of each set of names that makers give the columns of a rotation."""
    found: dict[tuple[str, ...], tuple[str, ...]] = {}
    for name, convention in CONVENTIONS.items():
        labels = tuple(label.lower() for label in convention.labels[3:])
        same = next((known for known in found if set(known) == set(labels)), labels)
        if same == labels:
            found[labels] = (*found.get(labels, ()), name)
    return found | {
        ("q0", "q1", "q2", "q3"): ("quaternion_wxyz", "quaternion_xyzw"),
        ("rx", "ry", "rz", "rw"): ("quaternion_xyzw",), ("vx", "vy", "vz"): ("vector",),
        ("ex", "ey", "ez"): ("xyz",), ("alpha", "beta", "gamma"): ("ZYX", "xyz", "XYZ", "ZYZ"),
    }  # fmt: skip


ROTATIONS = _rotations()
"""Names of a rotation's columns in the order of its conventions, and those conventions."""


@dataclass(frozen=True)
class PoseColumns:
    """Columns that hold a pose, a point or joint angles, inferred from names and numbers.

    Attributes:
        table: Table with the columns.
        columns: Names or numbers from 1: position first, then rotation.
        rotations: Possible notations of the rotation; ``point`` without one,
            :data:`JOINTS_ONLY` for joint angles.
        called: Common name of the columns; empty without one.
        length: Unit of the position, if stated in a name.
        angle: Unit of the angles, if stated in a name.
        guess: Text on what was inferred from the numbers alone; empty if names decide.
        parent_first: Whether base_to_tool names the tool's pose in the base, as ROS does.
    """

    table: Table
    columns: tuple[Column, ...]
    rotations: tuple[str, ...]
    called: str = ""
    length: str | None = None
    angle: str | None = None
    guess: str = ""
    parent_first: bool = False

    @property
    def name(self) -> str:
        """Name for messages: the file, then a colon and the columns' name."""
        return ":".join(filter(None, (self.table.name, self.called)))

    @property
    def is_pose(self) -> bool:
        """Whether the columns are a whole pose."""
        return self.rotations not in (("point",), JOINTS_ONLY)

    @property
    def may_be_joints(self) -> bool:
        """Whether the columns are joint angles, or unnamed numbers that may be."""
        numbers = [column for column in self.columns if isinstance(column, int)]
        nameless = len(numbers) == len(self.columns) == 6 and numbers == sorted(numbers)
        return self.rotations == JOINTS_ONLY or (nameless and not self.rotations)

    @property
    def role(self) -> str | None:
        """``arm`` or ``target``, from the names of columns, program or file; None if unknown."""
        # Only controllers write a maker's convention; cameras and ROS write plain ones
        if self.table.convention is not None and not self._is_echo:
            return "arm"
        if self.axes_of_motion:
            return "target"
        # rvecs and tvecs are OpenCV's names for what a camera measures (solvePnP, calibrateCamera)
        opencv = "target" if self.called.lower().removesuffix("s") in _OPENCV else None
        of_columns = role_in(self.called)
        names = [self.table.name.rpartition(":")[2], *re.split(r"[/:]", self.table.name)[::-1]]
        of_file = next((role for name in names if (role := role_in(name))), None)
        return of_columns or of_file or opencv

    @property
    def frames(self) -> tuple[str, str] | None:
        """Frames A and B of A_T_B, from a name; None if no name has them."""
        if self.axes_of_motion and self.called.startswith("transform"):
            return "target", "camera"
        names = (self.called, *re.split(r"[/:]", self.table.name)[::-1])
        found = next((found for name in names if (found := frames_in(name))), None)
        if self.parent_first and found:
            return found[::-1]
        # ROS's tf_echo prints the pose of the frame that is named last, base_to_tool0 or base2tool0
        return found[::-1] if found and self._is_echo and _TO.search(self.table.name) else found

    @property
    def axes_of_motion(self) -> str | None:
        """Axes of the camera's frame, where its poses are from images alone; else None.

        COLMAP, Metashape and nerfstudio write such files; they have no unit of length.
        """
        for beside, called, axes in (
            ("name", "camera_T_world", "optical"), ("sensor_id", "transform", "optical"),
            ("file_path", "transform_matrix", "opengl"),
        ):  # fmt: skip
            if called == self.called and beside in self.table.heading:
                return axes
        return None

    @property
    def _is_echo(self) -> bool:
        convention = self.table.convention
        return convention is not None and not CONVENTIONS[convention].makers


def as_joints(pose: PoseColumns) -> PoseColumns:
    """Return the same columns as joint angles."""
    return replace(pose, rotations=JOINTS_ONLY)


@dataclass
class Group:
    """Columns whose headings share a name before the axis, such as ``tcp_x`` and ``tcp_y``."""

    columns: dict[str, Column] = field(default_factory=dict)
    words: str = ""
    rotation: Column | None = None
    whole: Column | None = None
    many: int = 0
    length: str | None = None
    angle: str | None = None
    ordered: bool = True


@dataclass(frozen=True)
class Headings:
    """Columns of a table other than poses: times, scans, joints.

    Attributes:
        scan: Column of the scans' names.
        index: Column of whole numbers that number or name the rows.
        time: Column of the time.
        time_unit: Unit of the time.
        joints: Columns of joint angles.
        joint_unit: Unit of the joint angles, if stated in a name.
    """

    scan: Column | None = None
    index: Column | None = None
    time: Column | None = None
    time_unit: str | None = None
    joints: tuple[Column, ...] = ()
    joint_unit: str | None = None


def poses_by_name(table: Table) -> tuple[list[PoseColumns], Headings]:
    """Return the poses and points in a table with a heading, and its other named columns."""
    groups, rest = _grouped(table)
    found = [_pose(table, group) for group in groups.values()]
    return [pose for pose in found if pose is not None], rest


def _grouped(table: Table) -> tuple[dict[str, Group], Headings]:
    rest = Headings()
    groups: dict[str, Group] = {}
    lists = lists_in(table.heading)
    sizes = Counter(lists.values())
    seen: Counter[str] = Counter()
    for index, name in enumerate(table.heading):
        listed = lists.get(name, "")
        size, nth = sizes[listed], seen[listed]
        seen[listed] += bool(listed)
        joint = _JOINT_HEADING.fullmatch(name.lower().replace(" ", "_").rpartition(".")[2])
        joint = joint or _JOINT_HEADING.fullmatch(name.lower())
        # A list called q: joint angles if it has five or more, a quaternion if it has four
        joint = joint or re.fullmatch(r"(.*[._])?q", listed.lower()) if size > 4 else joint
        order = "wxyz" if "wxyz" in listed.lower() else "xyzw"
        words = _of_list(listed, order[nth]) if size in (3, 4) else _words(listed if size else name)
        if number_of(_first(table, index)) is None:
            scans = ("cloud", "scan", "file", "filename", "image", "img", "name", "path")
            if (words and words[-1].lower() in scans) or _is_file(table, index):
                rest = replace(rest, scan=name)
        elif _is_index(table, index, words):
            rest = replace(rest, index=name or index + 1)
        elif joint and not _is_quaternion(table, name):
            unit = next((u for u in ANGLES if u == words[-1].lower()), None)
            rest = replace(rest, joints=(*rest.joints, name), joint_unit=unit)
        elif size in (*_ROTATIONS, 9):
            if nth == 0:
                _put_list(groups, words, listed, size)
        elif words and not size > 4:
            time, unit = _time(words)
            if time and rest.time is None:
                rest = replace(rest, time=name, time_unit=unit)
            else:
                orders = ("xyzw", "wxyz", "zyx", "zxy", "yxz", "yzx", "xzy", "zyz", "zxz")
                plain = [each for each in words if each.lower() not in orders]
                stated = len(plain) < len(words)
                _put(groups, name, plain, listed=size == 4, ordered=stated or size != 4)
    # No arm has fewer than four joints, so j1 to j3 alone count something else
    joints = rest.joints if len(rest.joints) > 3 else ()
    return groups, replace(rest, joints=joints_in_order(map(str, joints)) or joints)


def _is_index(table: Table, index: int, words: Sequence[str]) -> bool:
    """Return whether a column numbers the rows or scans, by its name and its values."""
    called = (
        "id", "index", "idx", "i", "no", "nr", "num", "number", "n", "count", "row", "sample",
        "frame", "shot", "capture", "scan", "image", "img", "cloud", "pose", "position", "point",
        "file", "name",
    )  # fmt: skip
    return (words[-1].lower() in called if words else index == 0) and table.numbers_rows(index)


def _first(table: Table, index: int) -> CellValue:
    """Return the first cell of a column that is not empty: a target may not be seen at first."""
    cells = (cells[index] for _, cells in table.rows if index < len(cells))
    return next((cell for cell in cells if cell not in ("", " ")), "")


def _is_file(table: Table, index: int) -> bool:
    cell = str(_first(table, index))
    folder = table.files[0].parent
    if len(set(table.texts(index))) == len(table.rows) and Path(cell).suffix.lower() in (
        *CLOUD_SUFFIXES,
        *IMAGES,
    ):
        return True  # a name that two tables share, though the file itself is elsewhere
    return bool(cell) and len(cell) < 200 and (folder / cell).is_file()


def _is_quaternion(table: Table, name: str) -> bool:
    """Return whether q1 belongs to a quaternion: q1 to q4 (as in ABB), or q0 to q3."""
    alike = re.compile(re.escape(name.lower()[:-1]) + r"\d")
    called = sorted(each[-1] for each in table.heading if alike.fullmatch(each.lower()))
    return name.lower()[-2:-1] == "q" and "".join(called) in ("1234", "0123")


def lists_in(names: Sequence[str]) -> dict[str, str]:
    """Return the list name of each column that is an entry of a list: ``pose`` of ``pose.3.3``.

    Numbered columns form a list too, if their number is that of a pose or a part of one: ``tvec``
    of ``tvec_0`` or ``tvec[0]``.
    """
    found = {name: entry for name in names if (entry := entry_of_list(name))}
    sizes = Counter(listed for listed, _ in found.values())
    return {
        name: listed
        for name, (listed, entry) in found.items()
        if entry[0] == "." or sizes[listed] in (3, 4, 9, *_ROTATIONS)
    }


def _of_list(listed: str, axis: str) -> list[str]:
    """Return the words of a list's entry, the unit last: ``translation_mm`` has ``x_mm``."""
    words = _words(listed)
    unit = words.pop() if len(words) > 1 and words[-1].lower() in (*LENGTHS, *ANGLES) else ""
    return [*words, axis, *filter(None, [unit])]


def _words(name: str) -> list[str]:
    """Return the words of a column's name; R of ``R_gripper2base`` is one."""
    # Chinese beside Latin letters, or a unit's sign, ends a word: 位置X(毫米)
    apart = in_english(re.sub(r"([\u3400-\u9fff]+)", r" \1 ", name)).replace("°", " deg ")
    joined = " ".join(w for w in re.split(r"[\W_]+", apart) if w)
    for two, one in (
        (r"rot(?:ation)? vec(?:tor)?|axis angle", "rotvec"), (r"rot(?:ation)? quat\w*", "quat"),
        (r"trans(?:lation)? vec(?:tor)?", "tvec"), (r"rot(?:ation)? mat(?:rix)?", "rotation"),
        (r"rpy angles", "rpy"), (r"euler (?:angles|xyz)", "euler"),
    ):  # fmt: skip
        joined = re.sub(rf"\b(?:{two})\b", one, joined, flags=re.IGNORECASE)
    return joined.split()


def _time(words: Sequence[str]) -> tuple[bool, str | None]:
    words = [word.lower() for word in words]
    unit = words[-1] if words[-1] in ("s", "ms", "us", "ns") and len(words) > 1 else None
    called = [word for word in words if word != unit]
    return called[-1] in ("time", "timestamp", "stamp", "secs", "sec", "t"), unit


def _put(
    groups: dict[str, Group], name: str, words: list[str], listed: bool, ordered: bool
) -> None:
    """Assign a column by its name: ``robot_x_mm`` is the x of ``robot`` in millimetres.

    A list of four numbers is a quaternion, whatever its name.
    """
    last = words[-1].lower()
    unit = words.pop().lower() if last in (*LENGTHS, *ANGLES) and len(words) > 1 else None
    if _is_axis(words[0]) and not _is_axis(words[-1]):  # ``x_robot``
        words = [*words[1:], words[0]]
    axis, before = words[-1].lower(), words[:-1]
    # px is the x of a position, tx that of a translation
    if len(axis) == 2 and axis[0] in "pt" and axis[1] in "xyz":
        axis = axis[1]
    plain = axis in ("x", "y", "z", "w")
    # Behind a name of its own (orientation.roll) only a whole word is no part of the pose's name
    whole = [word for word in _TURN_WORDS if len(word) > 1]
    part, before = _without(before, (*_POSITION_WORDS, *_TURN_WORDS) if plain else whole)
    axis = ("q" if listed else _TURN_WORDS.get(part, "") if plain else "") + axis
    called = "_".join(before) or (part if part in _OPENCV else "")
    group = groups.setdefault("" if called in _OPENCV else called, Group())
    group.words = group.words or called
    group.columns.setdefault(axis, name)
    group.ordered &= ordered
    if axis in ("x", "y", "z") and unit in LENGTHS:
        group.length = unit
    elif unit in ANGLES:
        group.angle = unit


def _is_axis(word: str) -> bool:
    """Return whether a word calls one number of a pose: an axis, an angle, an entry of a matrix."""
    axes = {*"xyz", *(label for labels in ROTATIONS for label in labels)}
    return word.lower() in axes or _ENTRY.fullmatch(word.lower()) is not None


def _without(words: list[str], parts: Sequence[str]) -> tuple[str, list[str]]:
    """Return the part of a pose named by the last or first word, and the other words."""
    for at in (len(words) - 1, 0) if words else ():
        word = words[at].lower()
        if part := next((each for each in (word, word.removesuffix("s")) if each in parts), ""):
            return part, words[:at] + words[at + 1 :]
    return "", words


def _put_list(groups: dict[str, Group], words: list[str], listed: str, size: int) -> None:
    if size == 9:
        _, before = _without(words, tuple(_TURN_WORDS))
        group = groups.setdefault("_".join(before), Group(words="_".join(before)))
        group.rotation = listed
    else:
        group = groups.setdefault("_".join(words), Group(words="_".join(words)))
        group.whole, group.many = listed, size


def _pose(table: Table, group: Group) -> PoseColumns | None:
    """Return a group of columns as a pose or point; None without a position."""
    stated = (group.words, group.length, group.angle)
    if group.whole is not None:
        usual = _ROTATIONS[group.many]
        rotations = (usual,) if usual and group.many != 7 else ("xyzw", "wxyz") if usual else ()
        if group.many == 6 and table.convention:
            rotations = (table.convention,)
        return PoseColumns(table, (group.whole,), rotations, *stated)
    entries = _matrix_entries(group)
    if len(entries) in (12, 16):
        return PoseColumns(table, entries, ("matrix",), *stated)
    apart = {letter: cells for letter, cells in _counted(group).items() if len(cells) in (3, 9)}
    if sorted(map(len, apart.values())) == [3, 9]:  # r1 to r9 and t1 to t3
        turn, place = sorted(apart.values(), key=len, reverse=True)
        return PoseColumns(table, (*place, *turn), ("3x3",), *stated)
    if not {*"xyz"} <= set(group.columns):
        return None
    place = tuple(group.columns[axis] for axis in "xyz")
    if group.rotation is not None:
        return PoseColumns(table, (*place, group.rotation), ("3x3",), *stated)
    if len(entries) == 9:
        return PoseColumns(table, (*place, *entries), ("3x3",), *stated)
    turns = _turns(group)
    fitting = [names for names in ROTATIONS if set(names) <= set(turns)]
    names = max(fitting, key=len, default=None)
    if names is None:
        return PoseColumns(table, place, ("point",), *stated)
    known = (table.convention,) if table.convention else ROTATIONS[names]
    # A list of four without letters: ROS and SciPy write w last, ABB and Eigen's constructor first
    if not group.ordered and names == ("qx", "qy", "qz", "qw"):
        known = ("quaternion_xyzw", "quaternion_wxyz")
    return PoseColumns(table, (*place, *(turns[n] for n in names)), known, *stated)


def _turns(group: Group) -> dict[str, Column]:
    """Return a group's columns; an orientation of three numbers is angles, not a quaternion."""
    angles = {name.replace("q", "r"): column for name, column in group.columns.items()
              if name in ("qx", "qy", "qz")}  # fmt: skip
    return group.columns if "qw" in group.columns else group.columns | angles


def _matrix_entries(group: Group) -> tuple[Column, ...]:
    """Return the columns that are named as the entries of a matrix, row by row.

    They are called by row and column, ``r11``, or counted: ``m0`` to ``m15``.
    """
    counted = [cells for cells in _counted(group).values() if len(cells) in (12, 16)]
    if len(counted) == 1:
        return counted[0]
    named = {m.groups(): column for name, column in group.columns.items()
             if (m := _ENTRY.fullmatch(name))}  # fmt: skip
    return tuple(named[at] for at in sorted(named))


def _counted(group: Group) -> dict[str, tuple[Column, ...]]:
    """Return complete series of columns named by a letter and a number, by the letter."""
    found: dict[str, dict[int, Column]] = {}
    for name, column in group.columns.items():
        if match := re.fullmatch(r"([a-z]+)(\d+)", name):
            found.setdefault(match[1], {})[int(match[2])] = column
    return {
        letter: tuple(columns[at] for at in sorted(columns))
        for letter, columns in found.items()
        if max(columns) - min(columns) < len(columns)
    }


def frames_in(name: str) -> tuple[str, str] | None:
    """Return frames A and B of A_T_B in a name; None if it has none."""
    to = _TO.search(name)
    match = to or _IN.search(name) or _OF.search(name)
    if match is None:
        return None
    first, second = (_FRAMES.get(word.lower()) for word in match.groups())
    if first is None or second is None:
        return None
    # base2tool maps coordinates of the base to the tool's: it is tool_T_base (OpenCV's names)
    pair = (second, first) if to else (first, second)
    of_arms = {"base", "flange"}, {"world", "flange"}
    of_sights = {"camera", "target"}, {"camera", "world"}
    return pair if set(pair) in (*of_arms, *of_sights) else None


def named_parent_first(*poses: PoseColumns) -> bool:
    """Return whether ``base_to_tool`` must mean the tool in the base, unlike ``base2tool``."""
    named = all(_TO.search(pose.name) for pose in poses)
    return named and all(pose.frames and is_inverse(pose.frames) for pose in poses)


def is_inverse(frames: tuple[str, str]) -> bool:
    """Return whether a pose is flange_T_base or target_T_camera."""
    return frames[0] == "flange" or frames[1] == "camera"


def in_english(name: str) -> str:
    """Return a name with the German, French, Spanish and Chinese words of poses in English."""
    for chinese, english in (
        ("四元数", "quaternion"), ("旋转|姿态", "rotation"), ("位置|坐标|位姿", "position"),
        ("角度", "angle"), ("弧度", "rad"), ("毫米", "mm"), ("厘米", "cm"), ("序号|编号", "no"),
        ("时间", "time"), ("标定板|标记|相机", "target"), ("机器人|机械臂|法兰|末端", "robot"),
    ):  # fmt: skip
        name = re.sub(chinese, f" {english} ", name)
    for words, english in (
        ("drehung|giro|rotación|rotacion", "rotation"), ("posición|posicion|lage", "position"),
        ("grad|grados|degrés|degrees|度", "deg"), ("米", "m"), (r"n[°º]|№", "no"),
        ("ziel|zielmarke|mire|cible|marcador|marqueur", "target"), ("roboter|brazo", "robot"),
    ):  # fmt: skip
        name = re.sub(rf"(?<![^\W_])(?:{words})(?![^\W_])", english, name, flags=re.IGNORECASE)
    return name


def role_in(name: str) -> str | None:
    """Return ``arm`` or ``target`` by a name; None if it shows neither."""
    name = in_english(name)
    frames = frames_in(name.rpartition(":")[2])
    if frames is not None:
        return "target" if "camera" in frames else "arm"
    found = {"target": SEEN.search(name.lower()), "arm": _ARM_WORDS.search(name.lower())}
    # A name such as robot_marker.csv has words of both sides and decides nothing
    roles = [role for role, match in found.items() if match]
    return roles[0] if len(roles) == 1 else None

"""From the poses of a folder to the parameters of ``reader.table``."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np

from flangeye.errors import RecipeError, StageError
from flangeye.files.recording import MAX_REACH
from flangeye.files.tables import Column, Table, read_table, rows_together
from flangeye.maths.kinematics import Arm
from flangeye.maths.pose_corrections import inverted, scaled
from flangeye.models.robots import RobotModel
from flangeye.types import Floats
from flangeye.types.pose_formats import (
    APART,
    CONVENTIONS,
    LENGTHS,
    MATRIX,
    PLAIN,
    AngleUnit,
    LengthUnit,
    by_columns,
)
from flangeye.types.pose_formats import convention_of_maker as usual_of
from flangeye.workflow.recipe.draft.evidence import (
    FULL_TURN,
    Choice,
    Writing,
    mounting_of,
    poses_by_number,
    size_of,
    usual_rotations,
    writing_of,
)
from flangeye.workflow.recipe.draft.headings import (
    JOINTS_ONLY,
    Headings,
    PoseColumns,
    as_joints,
    is_inverse,
    named_parent_first,
    poses_by_name,
    role_in,
)
from flangeye.workflow.recipe.draft.survey import Questions, one_of

TURN_FIRST = "the rotation comes before the position"
NAME_THE_ARM = "name the arm: --robot NAME ('flangeye robots' lists them), or its .urdf"
WAYS = {"": ("base_T_flange", "flange_T_base"), "target-": ("camera_T_target", "target_T_camera")}


def poses_of(table: Table) -> tuple[list[PoseColumns], Headings]:
    """Return the poses and points in a table, with its other columns."""
    return poses_by_name(table) if table.heading else poses_by_number(table)


def measured(tables: Sequence[Table]) -> PoseColumns | None:
    """Return the poses that are named after a target, beside as many of the arm; None without."""
    found = [pose for table in tables for pose in poses_of(table)[0] if pose.is_pose]
    counts = {len(pose.table.rows) for pose in found if pose.role != "target"}
    named = (p for p in found if p.role == "target" and len(p.table.rows) in counts)
    return next(named, None)


def table_params(
    tables: Sequence[Table], questions: Questions, robot: RobotModel | None, scans: bool
) -> dict[str, Any]:
    """Return the parameters with which ``reader.table`` reads the poses of a folder.

    Args:
        tables: Tables of the folder.
        questions: Answers to what the tables do not show; likely answers from the data are stored
            there.
        robot: The arm, if known.
        scans: Whether there are scans beside the tables.

    Raises:
        RecipeError: There are no columns of a pose; the message names the option for them.
    """
    found = [pose for table in tables for pose in poses_of(table)[0]]
    arm = _arm(tables, found, questions)
    target = None if scans else _target(tables, found, arm, questions)
    if target is None and not scans:
        _require_as_many(tables, arm)
        arm, target = _halves(arm)
    if target and named_parent_first(arm, target):
        # Nobody records both inverses: base_to_tool and camera_to_target are named as ROS does
        arm, target = replace(arm, parent_first=True), replace(target, parent_first=True)
        questions.assumed.append(
            f"{arm.name} and {target.name}: the second frame in the first, as ROS names poses "
            "(--pose and --target-pose say otherwise)"
        )
    arm, target = _seen_together(arm, target, questions, robot)
    _ask_lengths(arm, target, questions)
    for pose in filter(None, (arm, target)):
        if MATRIX in pose.rotations and by_columns(_finite(_numbers(pose))):
            questions.assumed.append(f"{pose.name}: matrices of 16 numbers, column by column")
    if arm.rotations == JOINTS_ONLY:
        params = _of_joints(arm, questions, robot)
    else:
        params = _written(arm, questions, "", robot.maker if robot else None) | _rest(arm.table)
    called = _row_names(arm.table, target.table if target else None)
    params |= {} if called is None else {"scan": called}
    return _file(arm.table) | params | _target_params(arm, target, questions)


def _row_names(table: Table, other: Table | None) -> Column | None:
    """Return the column with the rows' names; None if tables only number their rows."""
    tables = [table, *([other] if other and other is not table else [])]
    rests = [poses_of(each)[1] for each in tables]
    column = rests[0].index
    if rests[0].scan is not None or column is None or len({rest.index for rest in rests}) > 1:
        return rests[0].scan
    # An index that rises by ones only counts the rows; with gaps it names them
    counted = ((np.diff(each.numbers([each.index(column)])[:, 0]) == 1).all() for each in tables)
    return None if all(counted) else column


def _of_joints(arm: PoseColumns, questions: Questions, robot: RobotModel | None) -> dict[str, Any]:
    """Return the parameters of joint angles, which the arm's kinematics turn into poses.

    Raises:
        RecipeError: The arm is unknown.
    """
    if robot is None:
        raise RecipeError(
            f"{arm.table.file}: {len(arm.columns)} joint angles a row become poses by the arm's "
            f"kinematics; {NAME_THE_ARM}"
        )
    unit = questions.given.get("angle") or _angle(_numbers(arm), arm)
    joints = {"joints": list(arm.columns), "joint_unit": unit}
    return {"rotation": JOINTS_ONLY[0]} | _rest(arm.table) | joints


def _file(table: Table) -> dict[str, Any]:
    parts = table.name.split(", ")
    return {"file": parts if len(parts) > 1 else table.name}


def _require_as_many(tables: Sequence[Table], arm: PoseColumns) -> None:
    """Refuse a second table whose rows cannot be paired with the arm's.

    Raises:
        StageError: There is one with another number of rows.
    """
    other = next((t for t in tables if t.files != arm.table.files), None)
    if other is not None and len(other.rows) != len(arm.table.rows):
        rows_together(arm.table, other, _row_names(arm.table, other))


def _joined(table: Table, other: Table) -> bool:
    """Return whether the rows of two tables belong together, by their names or one by one."""
    try:
        rows_together(table, other, _row_names(table, other))
    except StageError:
        return len(table.rows) == len(other.rows)
    return True


def _alone(arm: PoseColumns) -> str:
    if arm.role == "target":
        return (
            f"{arm.table.file}: has what the camera measured, but no poses of the arm; put its "
            f"poses "
            "or joint angles beside it as .csv, a row each, or add --columns NAMES"
        )
    return (
        f"{arm.table.file}: has poses of the arm, but there are no scans beside it, and no columns "
        "of what the camera saw; add --target-columns NAMES, or put the scans there"
    )


# --- whose poses they are


def _arm(
    tables: Sequence[Table], found: Sequence[PoseColumns], questions: Questions
) -> PoseColumns:
    """Return the columns of the arm's poses."""
    asked = questions.given.get("table")
    given = questions.given.get("columns")
    joints = questions.given.get("rotation") == JOINTS_ONLY[0]
    if given is not None:
        table = _table_of(tables, found, questions)
        own = [pose for pose in found if pose.table is table]
        return _named(table, given, own, JOINTS_ONLY if joints else ())
    angles = [p for p in found if p.rotations == JOINTS_ONLY] + _joints(tables)
    poses = [p for p in found if p.is_pose]
    if joints:
        poses = angles or [as_joints(p) for p in poses]
    else:
        # A file may be called after the camera and hold the arm's poses; columns say whose they are
        unclaimed = [p for p in poses if role_in(p.called) != "target"]
        poses = [p for p in poses if p.role != "target"] or angles or unclaimed
    if asked is not None:
        for pose in poses:
            if asked in (pose.name, pose.table.name):
                return pose
        known = ", ".join([pose.name for pose in poses] or [table.name for table in tables])
        raise RecipeError(f"--table {asked}: is not a table of poses; known: {known}")
    if not poses:
        seen = next((p for p in found if p.is_pose), None)
        raise RecipeError(_alone(seen) if seen else _unplain(tables[0]))
    return _likeliest(poses, questions)


def _likeliest(poses: Sequence[PoseColumns], questions: Questions) -> PoseColumns:
    """Return the pose columns that are the arm's, judged by name."""
    named = [p for p in poses if p.role == "arm"]
    likely = named or [p for p in poses if p.role is None] or list(poses)
    upright = [p for p in likely if not (p.frames and is_inverse(p.frames))] or likely
    first = upright[0]
    if len(likely) > 1 and named:
        rest = ", ".join(p.name for p in likely if p is not first)
        questions.assumed.append(f"the arm's poses: {first.name}, not {rest} (--table changes it)")
    elif len(likely) > 1 and _in_order(likely):
        questions.assumed.append(
            f"the arm's poses: {_place(first)}, which come before {_place(likely[1])} "
            "(--table or --columns changes it)"
        )
    elif len(likely) > 1:
        known = ", ".join(p.name for p in likely)
        question = f"which poses are the arm's ({known})"
        names = [name for p in likely for name in (p.name, p.table.name)]
        answer = questions.ask("table", question, None, likely[0].name, one_of(*names))
        first = next(p for p in likely if answer in (p.name, p.table.name))
    if first.guess:
        questions.assumed.append(f"{first.table.name}: {first.guess} (--columns changes it)")
    return first


def _in_order(likely: Sequence[PoseColumns]) -> bool:
    """Return whether unnamed poses are in one text, side by side or one above the other."""
    unnamed = all(not p.called for p in likely)
    return unnamed and len({p.table.files for p in likely}) == 1


def _place(pose: PoseColumns) -> str:
    if ":" in pose.table.name or not isinstance(pose.columns[0], int):
        return pose.table.name
    numbers = [column for column in pose.columns if isinstance(column, int)]
    return f"columns {min(numbers)} to {max(numbers)} of {pose.table.name}"


def _joints(tables: Sequence[Table]) -> list[PoseColumns]:
    """Return the joint angles that columns are named after."""
    rest = [(table, poses_of(table)[1]) for table in tables]
    return [PoseColumns(t, r.joints, JOINTS_ONLY, angle=r.joint_unit) for t, r in rest if r.joints]


def _table_of(tables: Sequence[Table], found: Sequence[PoseColumns], questions: Questions) -> Table:
    asked = questions.given.get("table")
    for table in tables:
        if asked == table.name:
            return table
    if asked is not None:
        known = ", ".join(table.name for table in tables)
        raise RecipeError(f"--table {asked}: is not a table of poses; known: {known}")
    arms = [p.table for p in found if p.role == "arm"] or [p.table for p in found if p.role is None]
    return (arms or list(tables))[0]


def _unplain(table: Table) -> str:
    shown = ", ".join(dict.fromkeys(table.heading)) or f"{len(table.rows[0][1])} numbers a row"
    return (
        f"{table.file}: it is not clear from {shown} which columns are the arm's pose; add "
        "--columns with names or numbers from 1, position first: --columns x,y,z,a,b,c --rotation "
        "kuka; or those of the joint angles: --columns 1,2,3,4,5,6 --rotation joints"
    )


def _named(
    table: Table, given: str, known: Sequence[PoseColumns], rotations: tuple[str, ...] = ()
) -> PoseColumns:
    """Return the columns that an option names, with the units that the heading states."""
    columns: list[Column] = [
        int(word) if word.isdigit() else word for word in map(str.strip, given.split(","))
    ]
    many = len(table.indices(columns))
    usual = {3: ("point",), 12: (MATRIX,), 16: (MATRIX,), 7: ("xyzw", "wxyz")}.get(many, ())
    same = next((p for p in known if set(p.columns) == set(columns)), None)
    named = same or PoseColumns(table, (), usual)
    kept = rotations or named.rotations or usual
    return replace(named, columns=tuple(columns), rotations=kept, guess="")


def _target(
    tables: Sequence[Table], found: Sequence[PoseColumns], arm: PoseColumns, questions: Questions
) -> PoseColumns | None:
    """Return the target's columns: by name, or else others with the same number of rows."""
    given = questions.given.get("target-columns")
    if given is not None:
        named = [p.table for p in found if p.table is not arm.table and p.role == "target"]
        table = _holding(given, [arm.table, *named, *tables])
        return _named(table, given, [p for p in found if p.table is table])
    timed = poses_of(arm.table)[1].time is not None
    others = [
        p for p in found
        if p != arm and p.role != "arm" and p.rotations != JOINTS_ONLY
        and (_joined(arm.table, p.table)
             or (timed and poses_of(p.table)[1].time is not None))
    ]  # fmt: skip
    if not others and arm.role is None:
        others = [
            p for p in found if p.rotations != JOINTS_ONLY and p != arm and p.columns != arm.columns
        ]
    seen = [p for p in others if p.role == "target"] or others
    whole = [p for p in seen if p.is_pose] or seen
    if len(whole) > 1:
        rest = ", ".join(p.name for p in whole[1:])
        questions.assumed.append(f"what the camera saw: {whole[0].name}, not {rest}")
    elif whole and whole[0].role is None and not whole[0].is_pose:
        questions.assumed.append(
            f"what the camera saw: the points {', '.join(map(str, whole[0].columns))} of "
            f"{whole[0].table.name} (--target-columns changes it)"
        )
    return whole[0] if whole else None


def _holding(given: str, tables: Sequence[Table]) -> Table:
    """Return the first table with the columns that an option names."""
    first = given.split(",")[0].strip()
    fitting = [t for t in tables if first.isdigit() or first in t.heading
               or any(name.startswith(f"{first}.") for name in t.heading)]  # fmt: skip
    return (fitting or list(tables))[0]


def _halves(arm: PoseColumns) -> tuple[PoseColumns, PoseColumns]:
    """Return the first and the second half of a table's rows, where both can be poses.

    Raises:
        RecipeError: The halves cannot be poses.
    """
    table = arm.table
    if len(table.files) > 1 or ":" in table.name or len(table.rows) % 2 or table.heading:
        raise RecipeError(_alone(arm))
    folder = table.files[0].parent
    for _ in range(len(table.name.split("/")) - 1):
        folder = folder.parent
    first, second = (read_table(folder, f"{table.name}:{k}/2") for k in (1, 2))
    count = len(first.rows)
    told = f"rows 1 to {count} are the arm's, {count + 1} to {2 * count} the target's"
    return replace(arm, table=first, guess=told), replace(arm, table=second, guess=told)


# --- how they are written


def _numbers(pose: PoseColumns) -> Floats:
    """Return the numbers of a pose, row by row; NaN in empty cells, and in a pose of zeros."""
    numbers = pose.table.numbers(pose.table.indices(pose.columns), empty=True)
    if pose.is_pose:
        numbers[~numbers.any(axis=1)] = np.nan
    return numbers


def _seen_together(
    arm: PoseColumns, target: PoseColumns | None, questions: Questions, robot: RobotModel | None
) -> tuple[PoseColumns, PoseColumns | None]:
    """Return arm's and target's columns, and store likely answers inferred from their poses.

    Unnamed numbers are joint angles if only this interpretation agrees with the target's rotation.

    Raises:
        RecipeError: Unnamed numbers fit neither, or the halves of a table are not arm and target.
    """
    if target is None or not target.is_pose or not _joined(arm.table, target.table):
        return _within_reach(arm, robot), target
    tried = (
        (a, t, choice)
        for a in _orders(arm, questions, "")
        for t in _orders(target, questions, "target-")
        if (choice := _choice(a, t, questions, robot)) is not None
    )
    found = next(tried, None)
    if found is None:
        if ":1/2" in arm.table.name:
            raise RecipeError(_alone(arm))
        if (
            arm.rotations != JOINTS_ONLY
            and arm.may_be_joints
            and not questions.given.get("rotation")
        ):
            raise RecipeError(_neither(arm, robot))
        return arm, target
    arm, target, choice = found
    numbers, seen = _both(arm, target)
    for pose, prefix, writing in ((arm, "", choice.arm), (target, "target-", choice.target)):
        if pose.guess == TURN_FIRST:
            questions.assumed.append(
                f"{pose.table.name}: {TURN_FIRST} ({choice.told}; --{prefix}columns says otherwise)"
            )
        questions.likely[f"{prefix}rotation"] = (writing.rotation, choice.told)
        questions.likely[f"{prefix}angle"] = (writing.angle, choice.told)
    if choice.arm.kinematics is not None and arm.rotations != JOINTS_ONLY:
        arm = as_joints(arm)
        questions.assumed.append(f"{_place(arm)}: joint angles ({choice.told}; --rotation says "
                                 "otherwise)")  # fmt: skip
    poses, marks = choice.arm.poses(numbers), choice.target.poses(seen)
    if poses is None or marks is None:
        return arm, target
    if target.axes_of_motion:
        marks = _measured(poses, marks, target, questions)
    _store_mounting((arm, poses), (target, marks), questions)
    return arm, target


def _store_mounting(
    arm: tuple[PoseColumns, Floats], target: tuple[PoseColumns, Floats], questions: Questions
) -> None:
    """Store where the camera is, and which way round the target's poses are, if they show it."""
    asked, frames, seen = questions.given, arm[0].frames, target[0].frames
    way = asked.get("pose") or WAYS[""][bool(frames and is_inverse(frames))]
    camera, upright = asked.get("camera"), asked.get("target-pose")
    ways = WAYS["target-"][:: -1 if seen and is_inverse(seen) else 1]
    mounting = mounting_of(
        arm[1] if way == "base_T_flange" else inverted(arm[1]), target[1],
        [camera] if camera else ["base", "flange"], [upright] if upright else ways,
    )  # fmt: skip
    if mounting is not None:
        questions.likely["camera"] = (mounting.camera, mounting.told)
        questions.likely["target-pose"] = (mounting.target, mounting.told)


def _measured(poses: Floats, marks: Floats, target: PoseColumns, questions: Questions) -> Floats:
    """Return poses from images alone in metres, and store the scale and axes that correct them."""
    inverse = bool(target.frames and is_inverse(target.frames))
    size = size_of(poses, inverted(marks) if inverse else marks)
    if size is None:
        return marks
    questions.mended = {"scale": float(f"{size:.6g}")}
    if target.axes_of_motion != "optical":
        questions.mended["axes"] = target.axes_of_motion
    questions.assumed.append(
        f"{target.table.name}: poses from images alone have no scale; by the arm's motion one unit "
        f"is {size:.4g} m if the arm carries the camera (the target's scale: in the recipe changes "
        "it)"
    )
    return scaled(marks, np.full(3, size))


def _orders(pose: PoseColumns, questions: Questions, prefix: str) -> list[PoseColumns]:
    """Return a pose's possible column orders; unnamed ones may have the rotation first."""
    if not pose.may_be_joints or pose.rotations or questions.given.get(f"{prefix}columns"):
        return [pose]
    turned = replace(pose, columns=(*pose.columns[3:], *pose.columns[:3]), guess=TURN_FIRST)
    return [pose, turned]


def _both(arm: PoseColumns, target: PoseColumns) -> tuple[Floats, Floats]:
    """Return the numbers of arm and target in rows where both are complete."""
    order, _ = rows_together(arm.table, target.table, _row_names(arm.table, target.table))
    numbers, rows = _numbers(arm), _numbers(target)
    unseen = np.full(rows.shape[1], np.nan)
    seen = np.array([unseen if row is None else rows[row] for row in order])
    kept = np.isfinite(numbers).all(axis=1) & np.isfinite(seen).all(axis=1)
    return numbers[kept], seen[kept]


def _choice(
    arm: PoseColumns, target: PoseColumns, questions: Questions, robot: RobotModel | None
) -> Choice | None:
    """Return the conventions of both tables, as far as their numbers show them."""
    numbers, seen = _both(arm, target)
    return writing_of(
        numbers, _writings(arm, numbers, questions, "", robot),
        seen, _writings(target, seen, questions, "target-", None),
    )  # fmt: skip


def _within_reach(arm: PoseColumns, robot: RobotModel | None) -> PoseColumns:
    """Return numbers as joint angles, where the arm cannot reach them as positions."""
    if robot is None or not arm.may_be_joints or len(robot.joints) != len(arm.columns):
        return arm
    numbers = _numbers(arm)
    scale = LENGTHS[_unit(_length(numbers, arm))]
    farthest = np.nanmax(np.linalg.norm(scale * numbers[:, :3], axis=1), initial=0.0)
    return as_joints(arm) if farthest > robot.length else arm


def _neither(arm: PoseColumns, robot: RobotModel | None) -> str:
    named = f" nor as joint angles of {robot.model}" if robot else f"; joint angles? {NAME_THE_ARM}"
    return (
        f"{arm.table.file}: {len(arm.columns)} numbers a row; their rotation agrees with the "
        f"target's in no usual convention of poses{named}; or say --rotation (kuka, "
        "vector, …)"
    )


def _writings(
    pose: PoseColumns, numbers: Floats, questions: Questions, prefix: str, robot: RobotModel | None
) -> list[Writing]:
    """Return the possible conventions of a pose's numbers, the most likely first."""
    given = questions.given.get(f"{prefix}rotation")
    joints = _as_angles(pose, numbers, robot) if given in (None, JOINTS_ONLY[0]) else []
    if pose.rotations == JOINTS_ONLY:
        return joints
    usual = usual_of(robot.maker if robot else None)
    named = [given] if given else list(pose.rotations or usual_rotations())
    if not given and usual and (not pose.rotations or usual in pose.rotations):
        named = [usual, *named]
    length = questions.given.get(f"{prefix}length") or _length(numbers, pose)
    asked = questions.given.get(f"{prefix}angle")
    found: dict[tuple[str, str], Writing] = {}
    for name in named:
        angles = [asked or _angle(numbers, pose)]
        if not asked and not pose.angle and angles == ["rad"] and _has_angles(name):
            angles.append("deg")
        plain = CONVENTIONS[name].rotation if name in CONVENTIONS else name
        for angle in angles if _has_angles(name) else ["rad"]:
            found.setdefault((plain, angle), Writing(name, _unit(length), _turn_unit(angle)))
    return [*found.values(), *joints]


def _as_angles(pose: PoseColumns, numbers: Floats, robot: RobotModel | None) -> list[Writing]:
    """Return joint angles as a hypothesis, if the arm has this number of joints."""
    if robot is None or len(robot.joints) != numbers.shape[1] or not pose.may_be_joints:
        return []
    angles = as_joints(pose)
    return [Writing(JOINTS_ONLY[0], "m", _turn_unit(_angle(_numbers(angles), angles)), Arm(robot))]


def _unit(word: str) -> LengthUnit:
    return next((unit for unit in get_args(LengthUnit) if unit == word), "m")


def _turn_unit(word: str) -> AngleUnit:
    return "deg" if word == "deg" else "rad"


def _has_angles(rotation: str) -> bool:
    plain = CONVENTIONS[rotation].rotation if rotation in CONVENTIONS else rotation
    return plain not in (MATRIX, APART, "point", "joints", "xyzw", "wxyz")


def _written(
    pose: PoseColumns, questions: Questions, prefix: str, maker: str | None
) -> dict[str, Any]:
    """Return the notation of a pose or point: rotation, units, columns, and direction."""
    numbers = _numbers(pose)
    rotation = questions.given.get(f"{prefix}rotation") or _rotation(pose, questions, prefix, maker)
    length = questions.given.get(f"{prefix}length") or _length(numbers, pose)
    params: dict[str, Any] = {"rotation": rotation, "length": length}
    if _has_angles(rotation):
        likely, _ = questions.likely.get(f"{prefix}angle", (_angle(numbers, pose), ""))
        params["angle"] = questions.given.get(f"{prefix}angle") or likely
    params["columns"] = list(pose.columns)
    if rotation != "point":
        params["pose"] = _direction(pose, questions, prefix)
    return params


def _rotation(pose: PoseColumns, questions: Questions, prefix: str, maker: str | None) -> str:
    key = f"{prefix}rotation"
    usual = usual_of(maker)
    plain = {CONVENTIONS[n].rotation if n in CONVENTIONS else n for n in pose.rotations}
    if len(plain) == 1:
        return pose.rotations[0]
    if usual and CONVENTIONS[usual].count - 3 != len(pose.table.indices(pose.columns)) - 3:
        usual = None
    if pose.rotations and usual not in pose.rotations:
        # Of conventions with equal names, what most files hold: A, B, C; quaternions
        # without names
        likely = ("kuka", "quaternion_xyzw", "xyzw")
        usual = pose.rotations[0] if pose.rotations[0] in likely else None
    if not prefix and usual and usual == usual_of(maker) and key not in questions.likely:
        usual = _usual_in_its_unit(pose, usual, questions)
    shown = ", ".join(map(str, pose.columns[3:] or pose.columns))
    joints = ", or joints, with --robot" if pose.may_be_joints and not prefix else ""
    known = f"{', '.join(CONVENTIONS)}, vector, xyz, ZYX, …{joints}"
    question = f"rotation convention of columns {shown} of {pose.table.name}"
    example = f"vector, or --{key} xyz for roll, pitch, yaw"
    if not prefix:
        example += "; or name the arm with --robot: the maker's convention is then used"
    names = one_of(*CONVENTIONS, *PLAIN, "point", "joints", MATRIX, APART)
    return questions.ask(key, question, usual, example, names, known)


def _usual_in_its_unit(pose: PoseColumns, usual: str, questions: Questions) -> str:
    """Return the likely convention of an arm, whose maker's may not be that of these numbers.

    Numbers in degrees where the maker writes radians come from another program: a UR's rotation
    vector converted to degrees, or roll, pitch and yaw under the same names. Scans should decide.
    A rotation vector is never longer than half a turn, so longer rows are angles.
    """
    numbers = _numbers(pose)
    unit, own = _angle(numbers, pose), CONVENTIONS[usual].angle
    if unit == own or not _has_angles(usual):
        return usual
    questions.rivals = usual_rotations()
    told = f"{usual} writes {own}, and these are {unit}"
    longest = np.nanmax(np.linalg.norm(numbers[:, 3:6], axis=1), initial=0.0)
    half_turn = 180.5 if unit == "deg" else np.pi + 0.01  # written with few digits
    if CONVENTIONS[usual].rotation == "vector" and longest > half_turn:
        told = f"a row of {longest:.0f} {unit} is no rotation vector, so roll, pitch, yaw"
        usual = "xyz"
    questions.likely["rotation"] = (usual, told)
    return usual


def _length(numbers: Floats, pose: PoseColumns) -> str:
    if pose.length is not None:
        return pose.length
    return "mm" if _reach(numbers, pose) > MAX_REACH else "m"


def _finite(numbers: Floats) -> Floats:
    return numbers[np.isfinite(numbers).all(axis=1)]


def _reach(numbers: Floats, pose: PoseColumns) -> float:
    """Return the largest coordinate of positions."""
    of_matrix = slice(12, 15) if by_columns(_finite(numbers)) else [3, 7, 11]
    places = numbers[:, of_matrix if MATRIX in pose.rotations else slice(3)]
    return float(np.nanmax(np.abs(places), initial=0.0))


def _ask_lengths(arm: PoseColumns, target: PoseColumns | None, questions: Questions) -> None:
    """Ask for the unit of positions that are too far for metres and too near for millimetres."""
    nearest = 150.0  # no arm stays so near its base [mm]
    unclear = {
        prefix: pose
        for prefix, pose in (("", arm), ("target-", target))
        if pose is not None and pose.is_pose and pose.length is None
        and MAX_REACH < _reach(_numbers(pose), pose) < nearest
    }  # fmt: skip
    if "" not in unclear:
        return
    reach = _reach(_numbers(arm), arm)
    question = (
        f"unit of the positions of {arm.name}, which reach {reach:.0f}: far for m, near for mm"
    )
    answer = questions.ask("length", question, None, "cm", one_of(*get_args(LengthUnit)))
    if "target-" in unclear and questions.given.get("target-length") is None:
        questions.given["target-length"] = answer


def _angle(numbers: Floats, pose: PoseColumns) -> str:
    if pose.angle is not None:
        return pose.angle
    turns = numbers if pose.rotations == JOINTS_ONLY else numbers[:, 3:6]
    return "deg" if np.nanmax(np.abs(turns), initial=0) > FULL_TURN else "rad"


def _direction(pose: PoseColumns, questions: Questions, prefix: str) -> str:
    """Return the direction of poses: by an answer, by the data, or by a name."""
    ways = WAYS[prefix]
    named = ways[is_inverse(pose.frames)] if pose.frames else None
    likely = questions.likely.get(f"{prefix}pose")
    if questions.given.get(f"{prefix}pose") is None and named is not None:
        if likely is None or likely[0] == named:
            return named
        name = pose.called or pose.table.name
        questions.likely[f"{prefix}pose"] = (likely[0], f"{likely[1]}; {name} says {named}")
    whose = "the arm's" if not prefix else "the target's"
    question = f"direction of {whose} poses ({' or '.join(ways)})"
    return questions.ask(f"{prefix}pose", question, named or ways[0], check=one_of(*ways))


def _target_params(
    arm: PoseColumns, target: PoseColumns | None, questions: Questions
) -> dict[str, Any]:
    if target is None:
        return {}
    params = _written(target, questions, "target-", None)
    if target.table is not arm.table:
        rest = {k: v for k, v in _rest(target.table).items() if k in ("time", "time_unit")}
        params = _file(target.table) | params | rest
    return {"target": params}


def _rest(table: Table) -> dict[str, Any]:
    """Return the columns of a table that are not poses."""
    rest = poses_of(table)[1]
    params: dict[str, Any] = {}
    if rest.time is not None:
        unit = rest.time_unit or _time_unit(table, rest.time)
        params |= {"time": rest.time} | ({"time_unit": unit} if unit else {})
    if rest.joints:
        angles = table.numbers(table.indices(rest.joints))
        degrees = np.nanmax(np.abs(angles)) > FULL_TURN
        unit = rest.joint_unit or ("deg" if degrees else "rad")
        params |= {"joints": list(rest.joints), "joint_unit": unit}
    return params


def _time_unit(table: Table, column: Column) -> str | None:
    """Return the unit of times since 1970 by their size, where no name has it; None for seconds."""
    latest = np.nanmax(np.abs(table.numbers([table.index(column)])))
    # Seconds since 1970 are some 1e9 until the year 5000
    return next(
        (u for u, least in (("ns", 1e17), ("us", 1e14), ("ms", 1e11)) if latest > least), None
    )

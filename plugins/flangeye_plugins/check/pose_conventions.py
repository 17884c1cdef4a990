"""Find rotations read in a wrong convention, and inverted poses."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np

from flangeye import StageError, part
from flangeye.estimation.session.readings import Reading, likely, optical, other_axes
from flangeye.maths.pose_corrections import inverted, reread, scaled, transposed
from flangeye.types.pose_formats import (
    EULER_ORDERS,
    QUATERNIONS,
    RotationConvention,
    describe_rotation,
    is_known,
    other_conventions,
    plain_rotation,
)
from flangeye.workflow.doctor.diagnosis import (
    OR_ELSE,
    Finding,
    Findings,
    NotApplicable,
    PoseChange,
    RecordedSession,
)
from flangeye_plugins.check.equations import equations_of
from flangeye_plugins.check.fitting import (
    arm_possessive,
    best_of,
    explained,
    fit,
    fit_of,
    helps,
    pairs_of,
)

_FLIPPED: Mapping[str, tuple[PoseChange, str]] = {
    "inverted": (
        inverted,
        "poses are flange_T_base (or the camera is on the flange where the recipe has it beside "
        "the arm, or the reverse)",
    ),
    "transposed": (transposed, "rotations are transposed: matrices were stored column by column"),
}


class Reread(NamedTuple):
    """A session whose rotations were read again in another convention.

    Attributes:
        session: The session with rotations read in the other convention.
        whose: Which rotations, such as "the robot's rotations".
        read_as: Convention that the recipe states.
        written_as: Convention in which they were read again.
    """

    session: RecordedSession
    whose: str
    read_as: str
    written_as: str


@part("check.convention")
def convention(session: RecordedSession) -> Findings:
    """Find rotations that fit far better when their numbers are read in another convention."""
    session.require_poses()
    tried = [*_written_otherwise(session)] or [*_of_arms(session), *_of_markers(session)]
    evidence = best_of(fit_of(session), fit(equations_of(*(each.session for each in tried))))
    found = tried[evidence.which]
    if evidence.probability < 1 and helps(session, found.session):
        what = f"{found.whose} were read as {found.read_as}, and fit as {found.written_as}"
        yield evidence.finding("pose convention", what, found.session)


def _written_otherwise(session: RecordedSession) -> Iterator[Reread]:
    """Yield the recordings read again, their written numbers taken in another convention."""
    if session.again is None:
        return
    arm, target = _said(session), _said(session, "target")
    whose: list[tuple[str, RotationConvention | None, bool, bool]] = [
        ("the robot's rotations", arm, True, False),
        ("the markers' rotations", target, False, True),
        ("the rotations of robot and markers", arm if arm == target else None, True, True),
    ]
    for name, said, of_arm, of_target in whose:
        if said is None:
            continue
        for other in other_conventions(*said):
            changes = {"rotation": other[0], "angle": other[1]}
            with suppress(StageError):  # the numbers are not poses in it
                read = session.again(changes if of_arm else {}, changes if of_target else {})
                if read.ids == session.ids:
                    yield Reread(read, name, describe_rotation(*said), describe_rotation(*other))


def _said(session: RecordedSession, of: str | None = None) -> RotationConvention | None:
    """Return the convention of rotations that the recipe states; None if it states none."""
    stated = _params(session, of)
    rotation = stated.get("rotation")
    return (str(rotation), stated.get("angle")) if is_known(rotation) else None


def _params(session: RecordedSession, of: str | None = None) -> Mapping[str, Any]:
    """Return the reader's options in the recipe, for the arm or for the target."""
    if isinstance(session.reader, str):
        return {}
    ((_, params),) = session.reader.items()
    stated = params.get(of) if params and of else params
    return stated if isinstance(stated, Mapping) else {}


def _of_arms(session: RecordedSession) -> Iterator[Reread]:
    for arms in session.arms:
        whose = "the" if session.seconds is None else arm_possessive(arms, session)
        for read_as, written_as in _readings(_stated(session)):
            reread_session = session.corrected(
                _rereading(read_as, written_as), arms, robot={"rotation": [read_as, written_as]}
            )
            yield Reread(
                reread_session,
                f"{whose} rotations",
                describe_rotation(read_as),
                describe_rotation(written_as),
            )


def _of_markers(session: RecordedSession) -> Iterator[Reread]:
    """Yield the markers' rotations read in other conventions, alone and with the arms'."""
    if not _has_ready_made_markers(session):
        return
    stated = _stated(session, "target")
    for read_as, written_as in _readings(stated):
        change = _rereading(read_as, written_as)
        told = {"rotation": [read_as, written_as]}
        alone = _with_markers(session, change).read_with(target=told)
        yield Reread(
            alone,
            "the markers' rotations",
            describe_rotation(read_as),
            describe_rotation(written_as),
        )
        if stated == _stated(session):
            both = _with_markers(session, change).corrected(change, "both", robot=told, target=told)
            whose = "the rotations of robot and markers"
            yield Reread(both, whose, describe_rotation(read_as), describe_rotation(written_as))


def _has_ready_made_markers(session: RecordedSession) -> bool:
    """Whether the recordings hold markers' poses, which may be written in any way."""
    return session.acquire == "acquire.samples" and bool(np.isfinite(session.rotations).any())


def _with_markers(session: RecordedSession, change: PoseChange) -> RecordedSession:
    """Return the session with the markers' poses changed."""
    rotations, centres = np.array(session.rotations), np.array(session.centres)
    shown = np.isfinite(rotations).all(axis=(1, 2))
    poses = np.tile(np.eye(4), (int(shown.sum()), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations[shown], centres[shown]
    changed = change(poses)
    rotations[shown], centres[shown] = changed[:, :3, :3], changed[:, :3, 3]
    return replace(session, rotations=rotations, centres=centres)


def _rereading(read_as: str, written_as: str) -> PoseChange:
    return lambda poses: reread(poses, read_as, written_as)


def _readings(stated: str | None) -> Iterator[tuple[str, str]]:
    """Yield each pair of conventions, assumed and possible, that have the same number of values."""
    # What three angles mean on the arms that are sold, and rotation vectors
    common = ("vector", "ZYX", "xyz", "XYZ", "zyx", "ZYZ", "zyz", "ZXZ")
    for read_as in [stated] if stated else [*QUATERNIONS, *common]:
        others = QUATERNIONS if read_as in QUATERNIONS else ("vector", *EULER_ORDERS)
        if not stated and read_as not in QUATERNIONS:
            others = common
        yield from ((read_as, other) for other in others if other != read_as)


def _stated(session: RecordedSession, of: str | None = None) -> str | None:
    """Return the recipe's stated convention of the arm's or target's rotations, if any."""
    said = _said(session, of)
    return said and plain_rotation(said[0])


@part("check.direction")
def direction(session: RecordedSession) -> Findings:
    """Find poses of the base in the flange, where the recipe expects the flange in the base."""
    session.require_poses()
    tried = [*_turned_round(session), *_transposed_markers(session)]
    evidence = best_of(fit_of(session), fit(equations_of(*(each for each, _, _ in tried))))
    corrected_session, whose, way = tried[evidence.which]
    if evidence.probability == 1 or not helps(session, corrected_session):
        return
    name, what = "pose direction", f"{whose} {_FLIPPED[way][1]}"
    fix = corrected_session.step()
    if way == "inverted" and _may_be_mounted_otherwise(session):
        readings = [_after_inverting(each) for each in _likely_readings(corrected_session)]
        name, what, fix, corrected_session = _choices(session, readings)
    yield evidence.finding(name, what, corrected_session, fix)


@part("check.exchanged")
def exchanged(session: RecordedSession) -> Findings:
    """Find poses of robot and marker that are both inverted, by where camera and target are.

    Both readings fit the data alike, so only plausible distances decide.
    """
    session.require_poses()
    if not np.isfinite(session.rotations).any() or not _may_be_mounted_otherwise(session):
        raise NotApplicable("it needs one arm, and whole poses of a target at an unknown place")
    if not explained(session) or Reading() in (readings := _likely_readings(session)):
        return
    carried, standing = _distances(session)
    carried_by = {"target": ("marker", "camera"), "camera": ("camera", "marker")}
    name, told, fix, corrected_session = _choices(session, readings)
    what = (
        f"as the poses are read, the {carried_by[session.carried][0]} is {carried:.2f} m from the "
        f"flange that carries it, and the {carried_by[session.carried][1]} {standing:.2f} m from "
        f"the base; the poses fit as well, at more usual distances, if {told}"
    )
    misfit = fit_of(session).misfit()
    # Whatever explains errors comes first
    yield Finding(name, what, fix, (), misfit, misfit, 0.0, 0.0, corrected_session)


@part("check.axes")
def axes(session: RecordedSession) -> Findings:
    """Find a camera frame whose axes are not x right, y down, z forward."""
    session.require_samples()
    if not _has_ready_made_markers(session):
        raise NotApplicable("the markers were found in images or clouds, whose frame is known")
    if (found := other_axes(session.centres[session.seen])) is None or not explained(session):
        return
    # What is seen elsewhere because the poses mean something else is no matter of axes
    if _may_be_mounted_otherwise(session) and Reading() not in _likely_readings(session):
        return
    turn = optical(found)
    read = session.read_with(target={"axes": found})
    mended = replace(read, centres=session.centres @ turn.T, rotations=turn @ session.rotations)
    who = {"opengl": "OpenGL, z backward", "ros": "a ROS body frame, x forward"}
    what = f"the camera's axes are those of {who[found]}: the targets lie in that direction"
    # What explains errors comes first
    yield Finding("camera axes", what, mended.step(), gain=0.0, corrected_session=mended)


@part("check.mirrored")
def mirrored(session: RecordedSession) -> Findings:
    """Find positions with the wrong sign along an axis, or with two columns exchanged."""
    session.require_samples()
    # Where each axis would do, one that leaves targets before the camera; beside z, y (OpenGL)
    before = bool(np.nanmedian(session.centres[:, 2]) > 0)
    turned = session.changes.get("stretch", (1.0, 1.0, 1.0))[2] < 0
    axes = sorted(range(3), key=lambda at: ((at == 2) == before, (at == 1) != turned))
    tried = [
        (*_negated("target", "xyz"[axis]), session.stretched(np.where(np.arange(3) == axis, -1, 1)))
        for axis in axes
    ]
    if session.uses_poses and session.seconds is None:
        tried += [(*_negated("robot", axis), _with_negated(session, axis)) for axis in "xyz"]
    tried += _with_exchanged_columns(session)
    evidence = best_of(fit_of(session), fit(equations_of(*(each for _, _, each in tried))))
    name, what, found = tried[evidence.which]
    if evidence.probability < 1 and helps(session, found):
        yield evidence.finding(name, what, found)


def _negated(whose: str, axis: str) -> tuple[str, str]:
    what = f"the {axis} of the {whose}'s positions is negated: they fit with its sign changed"
    return "mirrored axis", what


def _with_negated(session: RecordedSession, axis: str) -> RecordedSession:
    sign = np.array([-1.0 if each == axis else 1.0 for each in "xyz"])
    return session.corrected(lambda poses: scaled(poses, sign), robot={"mirrored": axis})


def _with_exchanged_columns(session: RecordedSession) -> Iterator[tuple[str, str, RecordedSession]]:
    """Yield the recordings read with two of a table's position columns exchanged."""
    for whose, of in (("robot", None), ("target", "target")):
        columns = _params(session, of).get("columns")
        if session.again is None or _said(session, of) is None or not isinstance(columns, list):
            continue
        for first, second in ((0, 1), (0, 2), (1, 2)):
            other = list(columns)
            other[first], other[second] = columns[second], columns[first]
            changes = {"columns": tuple(other)}
            read = session.again({} if of else changes, changes if of else {})
            axes = " and ".join(("xyz"[first], "xyz"[second]))
            what = f"the columns of {axes} of the {whose}'s positions are exchanged"
            yield "exchanged columns", what, read


def _distances(session: RecordedSession) -> tuple[float, float]:
    """Return how far the carried device is from the flange, and the fixed one from the base [m]."""
    found = fit_of(session).unknowns
    near, far = found.place[0].mean(axis=0), found.position[0]
    if session.carried == "camera":
        near, far = far, near
    return float(np.linalg.norm(near)), float(np.linalg.norm(far))


def _turned_round(session: RecordedSession) -> Iterator[tuple[RecordedSession, str, str]]:
    for arms in session.arms:
        whose = "the" if session.seconds is None else arm_possessive(arms, session)
        for way, (change, _) in _FLIPPED.items():
            yield session.corrected(change, arms, robot={way: True}), whose, way


def _transposed_markers(session: RecordedSession) -> Iterator[tuple[RecordedSession, str, str]]:
    """Yield the session with ready-made markers' matrices transposed, alone and with the arms'."""
    if not _has_ready_made_markers(session):
        return
    alone = _with_markers(session, transposed)
    yield alone.read_with(target={"transposed": True}), "the markers'", "transposed"
    told = {"transposed": True}
    both = alone.corrected(transposed, robot=told, target=told)
    yield both, "robot's and markers'", "transposed"


def _may_be_mounted_otherwise(session: RecordedSession) -> bool:
    """Whether inverted poses have the same equations as other mountings of camera and target."""
    unknown = not np.isfinite(session.places).any()
    return session.links is None and session.seconds is None and unknown


def _likely_readings(session: RecordedSession) -> list[Reading]:
    return likely(pairs_of(session), *_distances(session), session.robot)


def _after_inverting(reading: Reading) -> Reading:
    """Convert a reading of inverted arm poses to one of the poses as recorded."""
    if reading.exchanged:
        return reading._replace(marker_inverted=not reading.marker_inverted)
    return reading._replace(robot_inverted=not reading.robot_inverted)


def _choices(
    session: RecordedSession, readings: Sequence[Reading]
) -> tuple[str, str, str, RecordedSession]:
    """Return the mistake's name and text, the lines to choose from, and the corrected session."""
    in_hand = session.carried == "camera"
    what = ", or ".join(dict.fromkeys(each.mistake(in_hand) for each in readings))
    made = [_read_so(session, each) for each in readings]
    fits = ": the samples fit all of these equally" if len(made) > 1 else ""
    name = "mounting" if readings[0].remounted else "pose direction"
    return name, what + fits, OR_ELSE.join(dict.fromkeys(line for line, _ in made)), made[0][1]


def _read_so(session: RecordedSession, reading: Reading) -> tuple[str, RecordedSession]:
    """Return the recipe's lines for a reading, and the session read with it."""
    if not reading.remounted:
        mended = _rewritten(session, reading)
        return mended.step(), mended
    name = "eye-on-base" if session.carried == "camera" else "eye-in-hand"
    held: Literal["camera", "target"] = "target" if name == "eye-on-base" else "camera"
    line = f"configuration: {{name: {name}, place: unknown}}"
    if not (reading.exchanged or reading.robot_inverted or reading.marker_inverted):
        return line, replace(session, carried=held)
    mended = replace(_rewritten(session, reading), carried=held)
    return f"{mended.step()}\n  {line}", mended


def _rewritten(session: RecordedSession, reading: Reading) -> RecordedSession:
    """Return the session whose poses are read so, with the camera where it was."""
    shown = session.where(np.asarray(np.isfinite(session.rotations).all(axis=(1, 2))))
    session = shown if reading.exchanged or reading.marker_inverted else session
    told: dict[str, Any] = {"exchanged": True} if reading.exchanged else {}
    told |= {"robot": {"inverted": True}} if reading.robot_inverted else {}
    told |= {"target": {"inverted": True}} if reading.marker_inverted else {}
    read = replace(session.read_with(**told), motions=None)
    if session is not shown:
        return replace(read, poses=inverted(session.poses))
    pairs = reading.of(pairs_of(session))
    turns, centres = pairs.marker[:, :3, :3], pairs.marker[:, :3, 3]
    return replace(read, poses=pairs.robot, rotations=turns, centres=centres)

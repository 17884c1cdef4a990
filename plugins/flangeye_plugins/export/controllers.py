"""Formats that are a template and a convention: robot controllers, and plain numbers.

A template's ``{0}``, ``{1}``, … are the numbers of the pose in the format's convention, ``{sort}``
is the first or the second of two words: for a camera beside the robot, or on the arm.

Sources: ABB RAPID reference (wobjdata, identifiers); Doosan DRL manual (posx); FANUC operator's
manual (direct entry); KUKA KSS ``$config.dat``; Staubli VAL 3 reference (trsf); URScript manual
(pose); Yaskawa operator's manual (user frames); MVTec HALCON ``write_pose``, whose Rodriguez form
(``f 1``) is the tangent of half the angle and ends at half a turn, so angles are written. The keys
of Mech-Mind's ``extri_param.json`` are not public: its numbers are to be typed in.
"""

from __future__ import annotations

import keyword
from dataclasses import dataclass

import numpy as np
import yaml

from flangeye import StageError, stage
from flangeye.maths.kinematics import perturbed
from flangeye.models.robots import RobotModel
from flangeye.types import ArmCorrection, CalibratedPose, ExportedFile, HandEye
from flangeye.types.pose_formats import CONVENTIONS, PoseConvention
from flangeye_plugins.export.writing import (
    NamedParams,
    NumberedParams,
    numbers_of,
    require_identifier,
)


def _words(text: str) -> frozenset[str]:
    return frozenset(text.lower().split())


_PYTHON = _words(" ".join(keyword.kwlist))


@dataclass(frozen=True)
class ControllerFormat:
    """A format made of a template and a convention.

    Attributes:
        meaning: First line of its documentation.
        file: Name of the file.
        mark: Characters that begin a comment line.
        text: The template, behind the remarks.
        use: Where the file goes in the other program.
        convention: Convention of the numbers.
        sort: ``{sort}`` of a camera beside the robot, and of one on the arm.
        params: ``NamedParams``, or ``NumberedParams`` for ``{number}``.
        reserved: Reserved words of the language, in lower case, which cannot be names.
    """

    meaning: str
    file: str
    mark: str
    text: str
    use: str
    convention: str | PoseConvention
    sort: tuple[str, str] = ("", "")
    params: type[NamedParams] = NamedParams
    reserved: frozenset[str] = frozenset()

    def write(self, pose: CalibratedPose, params: NamedParams) -> ExportedFile:
        """Return the file of a pose."""
        numbers = numbers_of(self.convention, pose.transform.matrix)
        words = {
            "name": require_identifier(params.name, self.reserved),
            "number": getattr(params, "number", None),
            # A camera beside the robot is a fixed frame there, one on the arm is a tool
            "sort": self.sort[0 if pose.stands else 1],
            "remarks": pose.comment(self.mark),
        }
        name, text, use = (x.format(*numbers, **words) for x in (self.file, self.text, self.use))
        return ExportedFile(name, text, use)


CONTROLLERS = {
    "ur": ControllerFormat(
        "Write the pose as a URScript variable for Universal Robots' features and pose_trans.",
        "{name}.script",
        "#",
        "{remarks}{name} = p[{0}, {1}, {2}, {3}, {4}, {5}]\n",
        "a URScript file; the pose of a feature, relative to {sort}",
        CONVENTIONS["ur"].in_units("m", "rad"),
        ("the base", "the flange: pose_trans(get_actual_tcp_pose(), …)"),
        reserved=_PYTHON | _words("end halt local then thread"),
    ),
    "kuka": ControllerFormat(
        "Write a KUKA base, or a tool where the arm carries the camera.",
        "{name}.kuka.dat",
        ";",
        "{remarks}{sort}_DATA[{number}]={{X {0},Y {1},Z {2},A {3},B {4},C {5}}}\n"
        '{sort}_NAME[{number},]="{name}"\n',
        "the lines of {sort} {number} in R1/System/$config.dat",
        "kuka",
        # A camera beside the robot is a fixed frame, one on the arm is a tool
        ("BASE", "TOOL"),
        NumberedParams,
    ),
    "abb": ControllerFormat(
        "Write a RAPID module with the pose as the user frame of a work object.",
        "{name}.mod",
        "!",
        "{remarks}MODULE {name}_data\n  PERS wobjdata {name}:="
        '[{sort},TRUE,"",[[{0},{1},{2}],[{3},{4},{5},{6}]],[[0,0,0],[1,0,0,0]]];\nENDMODULE\n',
        "load the module; robhold is TRUE where the arm carries the camera",
        "abb",
        ("FALSE", "TRUE"),
        reserved=_words(
            "alias and backward case connect const default div do else elseif endfor endfunc "
            "endif endmodule endproc endrecord endtest endtrap endwhile error exit false for from "
            "func goto if inout local mod module nostepin not noview or pers proc raise readonly "
            "record retry return step sysmodule test then to trap true trynext undo var viewonly "
            "while with xor"
        ),
    ),
    "fanuc": ControllerFormat(
        "Write the numbers of a Fanuc user frame, or of a tool frame where the arm carries it.",
        "{name}.fanuc.txt",
        "!",
        "{remarks}{sort}[{number}] ({name}), mm and deg\n"
        "X: {0}\nY: {1}\nZ: {2}\nW: {3}\nP: {4}\nR: {5}\n",
        "enter under SETUP, Frames, {sort} {number}, Direct Entry",
        "fanuc",
        ("UFRAME", "UTOOL"),
        NumberedParams,
    ),
    "yaskawa": ControllerFormat(
        "Write the numbers of a Yaskawa user frame, or of a tool where the arm carries the camera.",
        "{name}.yaskawa.txt",
        "'",
        "{remarks}{sort} {number} ({name}), mm and deg\n"
        "X: {0}\nY: {1}\nZ: {2}\nRX: {3}\nRY: {4}\nRZ: {5}\n",
        "enter under ROBOT, {sort}",
        "yaskawa",
        ("USER FRAME", "TOOL"),
        NumberedParams,
    ),
    "staubli": ControllerFormat(
        "Write the pose as the transformation of a VAL 3 frame or tool.",
        "{name}.val3.txt",
        "//",
        "{remarks}{name}.trsf={{{0},{1},{2},{3},{4},{5}}}\n",
        "a line of VAL 3; declare it a {sort}",
        "staubli",
        ("frame, its father world", "tool, its father flange"),
        reserved=_words(
            "and begin bool call case default dio do else elseif end endfor endif endswitch "
            "endwhile false for frame if joint mdesc not num or point program return sio start "
            "stop string switch then to tool trsf true until wait while xor"
        ),
    ),
    "doosan": ControllerFormat(
        "Write the pose as a DRL variable, as user coordinates and tools take it.",
        "{name}.drl",
        "#",
        "{remarks}{name} = posx({0}, {1}, {2}, {3}, {4}, {5})\n",
        "a line of DRL; relative to {sort}",
        "doosan",
        ("DR_BASE", "the flange"),
        reserved=_PYTHON,
    ),
    "mech_mind": ControllerFormat(
        "Write position and quaternion for Mech-Mind's dialogs; not a file of its own format.",
        "{name}.mech_mind.txt",
        "#",
        "{remarks}{name}: metres, quaternion w x y z\n"
        "X: {0}\nY: {1}\nZ: {2}\nQW: {3}\nQX: {4}\nQY: {5}\nQZ: {6}\n",
        "type the numbers in, and mind the unit that the dialog shows",
        "quaternion_wxyz",
    ),
    "halcon": ControllerFormat(
        "Write a pose file that HALCON's read_pose reads.",
        "{name}.halcon.dat",
        "#",
        "# 3D POSE PARAMETERS: rotation and translation\n{remarks}\n"
        "# Used representation type:\nf 0\n\n"
        "# Rotation angles [deg] or Rodriguez vector:\nr {3} {4} {5}\n\n"
        "# Translation vector (x y z [m]):\nt {0} {1} {2}\n",
        "read_pose ('{name}.halcon.dat', Pose)",
        "halcon",
    ),
}
"""Controllers' formats by name."""


@stage("export.robot")
def export_robot(
    pose: CalibratedPose, calibration: HandEye, robot: RobotModel, params: NamedParams
) -> ExportedFile:
    """Write the corrected arm as a robot file: ``robot: {model: NAME.yaml}``.

    Joint zeros become part of ``theta``. The poses in an archive are still those of the arm as its
    controller reports it; with this file they follow from the recorded joints.

    Raises:
        StageError: No error of the arm's joints was found.
    """
    corrected = calibration.as_corrected()
    correction = corrected.correction if corrected else None
    if correction is None or correction.joint_offsets is None:
        raise StageError(
            "export.robot: no joint error of the arm was estimated; add refine.arm, or read in its "
            "notes why it estimated none"
        )
    # Only what differs from the defaults: the file is read and edited by people
    document = with_correction(robot, correction).model_dump(mode="json", exclude_defaults=True)
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)
    comment = f"{pose.comment('#')}# Corrected arm: differs from the controller's own model.\n"
    return ExportedFile(
        f"{params.name}.yaml", comment + text, "name it in a recipe: robot: {model: …}"
    )


def with_correction(robot: RobotModel, correction: ArmCorrection) -> RobotModel:
    """Return the arm with joint zeros and lengths corrected."""
    n = len(robot.joints)
    zeros = np.zeros(n) if correction.joint_offsets is None else correction.joint_offsets
    # Joint offsets add to the angles that the controller reports, as theta does
    lengths = np.zeros((n, 3)) if correction.lengths is None else correction.lengths
    joints = [
        joint.model_copy(
            update={
                **perturbed(joint, robot.convention, np.asarray(row)),
                "theta": joint.theta + float(zero),
            }
        )
        for joint, zero, row in zip(robot.joints, zeros, lengths, strict=True)
    ]
    source = f"{robot.source}; joint zeros and lengths corrected by flangeye"
    return robot.model_copy(update={"joints": tuple(joints), "source": source})

"""Frames and tools of robot controllers, each as its maker writes a pose.

ABB's RAPID: a work object, mm, quaternion with its real part first. Doosan's DRL: ``posx(x, y, z,
A, B, C)``, mm and degrees, Rz(A) Ry(B) Rz(C). Fanuc: a user frame, mm and degrees, Rz(R) Ry(P)
Rx(W). KUKA, KSS ``$config.dat``: a base or tool, mm and degrees, Rz(A) Ry(B) Rx(C). Staubli's VAL
3: mm and degrees, Rx Ry Rz about turned axes. Universal Robots: a feature ``p[x, y, z, rx, ry,
rz]``, metres, rotation vector. Yaskawa: a user frame, mm and degrees, Rz Ry Rx about fixed axes.
"""

from __future__ import annotations

from flangeye import stage
from flangeye.maths.pose_formats import CONVENTIONS
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import NamedParams, NumberedParams, fixed, labelled, numbers_of


@stage("export.abb")
def export_abb(pose: CalibratedPose, params: NamedParams) -> ExportedFile:
    """Write a RAPID module with the pose as the user frame of a work object."""
    numbers = numbers_of("abb", pose)
    held = "FALSE" if pose.stands else "TRUE"
    frame = f"[[{','.join(numbers[:3])}],[{','.join(numbers[3:])}]]"
    text = (
        f"{pose.comment('!')}MODULE {params.name}_data\n"
        f'  PERS wobjdata {params.name}:=[{held},TRUE,"",{frame},[[0,0,0],[1,0,0,0]]];\n'
        "ENDMODULE\n"
    )
    use = "load the module; robhold is TRUE where the arm carries the camera"
    return ExportedFile(f"{params.name}.mod", text, use)


@stage("export.doosan")
def export_doosan(pose: CalibratedPose, params: NamedParams) -> ExportedFile:
    """Write the pose as a DRL variable, as user coordinates and tools take it."""
    text = f"{pose.comment('#')}{params.name} = posx({', '.join(numbers_of('doosan', pose))})\n"
    carrier = "DR_BASE" if pose.stands else "the flange"
    return ExportedFile(f"{params.name}.drl", text, f"a line of DRL; relative to {carrier}")


@stage("export.fanuc")
def export_fanuc(pose: CalibratedPose, params: NumberedParams) -> ExportedFile:
    """Write the numbers of a Fanuc user frame, or of a tool frame where the arm carries it."""
    sort = "UFRAME" if pose.stands else "UTOOL"
    lines = "\n".join(labelled("fanuc", pose, ": "))
    text = f"{pose.comment('!')}{sort}[{params.number}] ({params.name}), mm and deg\n{lines}\n"
    use = f"enter under SETUP, Frames, {sort} {params.number}, Direct Entry"
    return ExportedFile(f"{params.name}.fanuc.txt", text, use)


@stage("export.kuka")
def export_kuka(pose: CalibratedPose, params: NumberedParams) -> ExportedFile:
    """Write a KUKA base, or a tool where the arm carries the camera."""
    sort = "BASE" if pose.stands else "TOOL"
    frame = f"{{{','.join(labelled('kuka', pose))}}}"
    text = (
        f"{pose.comment(';')}{sort}_DATA[{params.number}]={frame}\n"
        f'{sort}_NAME[{params.number},]="{params.name}"\n'
    )
    use = f"the lines of {sort.lower()} {params.number} in R1/System/$config.dat"
    return ExportedFile(f"{params.name}.kuka.dat", text, use)


@stage("export.staubli")
def export_staubli(pose: CalibratedPose, params: NamedParams) -> ExportedFile:
    """Write the pose as the transformation of a VAL 3 frame or tool."""
    numbers = ",".join(numbers_of("staubli", pose))
    text = f"{pose.comment('//')}{params.name}.trsf={{{numbers}}}\n"
    sort = "frame, its father world" if pose.stands else "tool, its father flange"
    return ExportedFile(f"{params.name}.val3.txt", text, f"a line of VAL 3; declare it a {sort}")


@stage("export.ur")
def export_ur(pose: CalibratedPose, params: NamedParams) -> ExportedFile:
    """Write the pose as a URScript variable, as features and pose_trans take it."""
    in_metres = CONVENTIONS["ur"].in_units("m", "rad")
    numbers = ", ".join(fixed(in_metres.numbers(pose.transform.matrix)))
    text = f"{pose.comment('#')}{params.name} = p[{numbers}]\n"
    carrier = "the base" if pose.stands else "the flange: pose_trans(get_actual_tcp_pose(), …)"
    use = f"a URScript file; the pose of a feature, relative to {carrier}"
    return ExportedFile(f"{params.name}.script", text, use)


@stage("export.yaskawa")
def export_yaskawa(pose: CalibratedPose, params: NumberedParams) -> ExportedFile:
    """Write the numbers of a Yaskawa user frame, or of a tool where the arm carries the camera."""
    sort = "USER FRAME" if pose.stands else "TOOL"
    lines = "\n".join(labelled("yaskawa", pose, ": "))
    text = f"{pose.comment(chr(39))}{sort} {params.number} ({params.name}), mm and deg\n{lines}\n"
    return ExportedFile(f"{params.name}.yaskawa.txt", text, "enter under ROBOT, " + sort)

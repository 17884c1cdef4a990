"""From where the arm is to above the seam's start; before that, whether the finger is seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flangeye.catalogue import RobotModel
from flangeye.errors import StageError
from flangeye.kinematics import Arm
from flangeye.types import Transform
from flangeye_plugins.welding.chronicle import Chronicle
from flangeye_plugins.welding.execution import Cell
from flangeye_plugins.welding.path import Path
from flangeye_plugins.welding.settings import WeldTactileParams

Floats = NDArray[np.float64]

WATCHED = 2.0
"""How long the finger is watched before the arm moves [s]."""

AT_REST = 0.5e-3
"""A tip that touches nothing is displaced by less [m]."""

HIGHER = 0.05
"""How far above the clearance the way from joint to joint ends [m]."""


def approach(
    cell: Cell, model: RobotModel, plan: Path, chronicle: Chronicle, params: WeldTactileParams
) -> None:
    """Bring the tip above the planned start, the tool along the seam.

    Raises:
        StageError: The finger is not seen, or is deformed though nothing should touch it.
        DeviceError: The arm is lost on the way.
    """
    if params.mode != "vision":
        _watch(cell, chronicle)
    place = plan.at(params.inset)
    angle = float(np.arctan2(place.tangent[1], place.tangent[0]) + np.radians(params.turned))
    above = np.array([*place.point, place.height + params.clearance])
    target = cell.tool.base_T_flange(above, angle)
    _go_above(cell, model, cell.tool.base_T_flange(above + [0.0, 0.0, HIGHER], angle), params)
    cell.drive.robot.move_linear(target, params.approach_speed, cell.drive.limits.acceleration)
    cell.drive.settle()
    for sight in cell.eyes.seen():  # what was seen on the way is no news to the controller
        chronicle.before(sight)


def _watch(cell: Cell, chronicle: Chronicle) -> None:
    """Look at the finger for a while; nothing moves."""
    began = cell.drive.tick().time_ns
    felt: list[Floats] = []
    seen = 0
    while cell.drive.tick().time_ns - began < WATCHED * 1e9 and len(felt) < 10:
        for sight in cell.eyes.seen():
            seen += 1
            chronicle.before(sight)
            if sight.feeling is not None:
                felt.append(np.asarray(sight.feeling.displacement))
    if not felt:
        what = "no tag is in view" if seen else "the camera gives no images"
        raise StageError(
            f"weld.tactile: {what}; is the finger's light on, the lens clean, and is the tag the "
            "one its file names?"
        )
    off = float(np.linalg.norm(np.median(felt, axis=0)))
    if off > AT_REST:
        raise StageError(
            f"weld.tactile: the tip is displaced by {off * 1e3:.1f} mm though nothing should touch "
            "it; free it, or calibrate the finger again: flangeye tactile calibrate"
        )


def _go_above(cell: Cell, model: RobotModel, target: Transform, params: WeldTactileParams) -> None:
    solutions = Arm(model).inverse(target.matrix)
    if not len(solutions):
        raise StageError("weld.tactile: the arm cannot reach the place above the seam's start")
    here = np.asarray(cell.drive.latest.state().joints)
    joints = solutions[int(np.argmin(np.abs(solutions - here).max(axis=1)))]
    speed = min(params.approach_joint_speed, cell.drive.limits.joint_speed)
    cell.drive.robot.move_joints(joints, speed, np.radians(60.0))
    cell.drive.settle()

"""The arm as it was found to be, as a robot file that a recipe can name."""

from __future__ import annotations

import numpy as np
import yaml

from flangeye import StageError, stage
from flangeye.maths.kinematics import altered
from flangeye.models.robots import RobotModel
from flangeye.types import ArmCorrection, CalibratedPose, ExportedFile, HandEye
from flangeye_plugins.export.writing import NamedParams


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
            "export.robot: no error of the arm's joints was found; add refine.arm, or see in its "
            "notes why it left them out"
        )
    document = with_correction(robot, correction).model_dump(mode="json", exclude_defaults=True)
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)
    comment = f"{pose.comment('#')}# The arm corrected, not as its controller has it.\n"
    return ExportedFile(
        f"{params.name}.yaml", comment + text, "name it in a recipe: robot: {model: …}"
    )


def with_correction(robot: RobotModel, correction: ArmCorrection) -> RobotModel:
    """Return the arm with joint zeros and lengths corrected."""
    n = len(robot.joints)
    zeros = np.zeros(n) if correction.joint_offsets is None else correction.joint_offsets
    lengths = np.zeros((n, 3)) if correction.lengths is None else correction.lengths
    joints = [
        joint.model_copy(
            update={
                **altered(joint, robot.convention, np.asarray(row)),
                "theta": joint.theta + float(zero),
            }
        )
        for joint, zero, row in zip(robot.joints, zeros, lengths, strict=True)
    ]
    source = f"{robot.source}; joint zeros and lengths corrected by flangeye"
    return robot.model_copy(update={"joints": tuple(joints), "source": source})

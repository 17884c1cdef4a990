"""A UR's factory calibration: the arm as built, read from files that its users have.

There are two such files. ``calibration.conf`` of the controller (in ``/root/.urcontrol``) holds
corrections to the Denavit-Hartenberg table. The file that the ROS driver's
``calibration_correction`` writes, in the format of ``default_kinematics.yaml``, holds the joints'
origins.
"""

import configparser
import math
from pathlib import Path
from typing import Any

import numpy as np

from flangeye.errors import RecipeError
from flangeye.files.regular import read_text
from flangeye.files.words import reason_of
from flangeye.files.yaml_lines import YAML_BYTES, read_yaml
from flangeye.models.robots import Joint, RobotModel, Volume
from flangeye.types.geometry import rotation_from_rpy

LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
PLACE = ("x", "y", "z", "roll", "pitch", "yaw")


def as_built(robot: RobotModel, path: Path) -> RobotModel:
    """Return the arm as its maker measured it.

    Args:
        robot: The model's nominal arm.
        path: ``calibration.conf``, or the ROS driver's kinematics ``.yaml``.

    Raises:
        RecipeError: The file is not a UR's, cannot be read, or belongs to another arm.
    """
    if robot.maker != "Universal Robots" or robot.convention != "standard":
        raise RecipeError(
            f"{path}: only arms of Universal Robots have a factory calibration; {robot.model} has "
            f"none"
        )
    if not path.is_file():
        raise RecipeError(f"{path}: no such file; copy calibration.conf from the controller")
    if path.suffix in (".yaml", ".yml"):
        return _from_ros(robot, path)
    return _from_controller(robot, path)


def _from_controller(robot: RobotModel, path: Path) -> RobotModel:
    parser = configparser.ConfigParser(inline_comment_prefixes=("#", ";"))
    deltas = ("delta_theta", "delta_a", "delta_d", "delta_alpha")
    try:
        parser.read_string(read_text(path, YAML_BYTES, RecipeError))
        rows = [_numbers(parser["mounting"][name]) for name in deltas]
    except (configparser.Error, KeyError, ValueError, OSError) as error:
        raise RecipeError(
            f"{path}: not a controller's calibration.conf: {reason_of(error)}; it has a section "
            f"[mounting] with {', '.join(deltas)}, each [six numbers]"
        ) from None
    if {len(row) for row in rows} != {len(robot.joints)}:
        raise RecipeError(f"{path}: {len(robot.joints)} numbers are needed in each row")
    joints = [
        joint.model_copy(
            update={
                # The controller stores differences to the nominal table, in SI units.
                "theta": joint.theta + theta,
                "a": joint.a + a,
                "d": joint.d + d,
                "alpha": joint.alpha + alpha,
            }
        )
        for joint, theta, a, d, alpha in zip(robot.joints, *rows, strict=True)
    ]
    return _sourced(robot, path, joints=tuple(joints))


def _numbers(text: str) -> list[float]:
    numbers = [float(word) for word in text.strip().strip("[]").split(",")]
    if not all(map(math.isfinite, numbers)):
        raise ValueError("a number is not finite")
    return numbers


def _from_ros(robot: RobotModel, path: Path) -> RobotModel:
    given: Any = read_yaml(path).data
    links: Any = given.get("kinematics") if isinstance(given, dict) else None
    try:
        places = [[float(links[link][key]) for key in PLACE] for link in LINKS]
    except (TypeError, KeyError, ValueError) as error:
        raise RecipeError(
            f"{path}: not a kinematics file of the ROS driver: {error}; it has 'kinematics' with "
            f"{', '.join(LINKS)}, each with {', '.join(PLACE)}"
        ) from None
    # The file's origins replace the nominal lengths and twists; limits and axes stay
    joints = tuple(
        Joint.model_construct(
            **{
                **nominal.model_dump(),
                "a": 0.0,
                "d": 0.0,
                "alpha": 0.0,
                "xyz": tuple(place[:3]),
                "rpy": tuple(place[3:]),
            }
        )
        for nominal, place in zip(robot.joints, places, strict=True)
    )
    volumes = tuple(_in_urdf_frame(volume, robot) for volume in robot.volumes)
    return _sourced(robot, path, joints=joints, volumes=volumes, convention="urdf")


def _in_urdf_frame(volume: Volume, robot: RobotModel) -> Volume:
    """Return a volume in the frame a URDF gives its link: before the link's own ``a, alpha``."""
    # Capsules are given in Denavit-Hartenberg frames, the ROS file in URDF frames.
    if volume.link == 0:
        return volume
    joint = robot.joints[volume.link - 1]
    # A standard DH link ends with Tx(a) Rx(alpha); the URDF's link frame is before these
    turn = rotation_from_rpy(joint.alpha, 0.0, 0.0)
    ends = {
        name: tuple(turn @ np.array(getattr(volume, name)) + [joint.a, 0.0, 0.0])
        for name in ("start", "end")
    }
    return volume.model_copy(update=ends)


def _sourced(robot: RobotModel, path: Path, **changes: Any) -> RobotModel:
    source = f"{robot.source}; factory calibration from {path.name}"
    return robot.model_copy(update={**changes, "source": source})

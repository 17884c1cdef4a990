"""From what was heard on a graph to the sections of a recipe: which arm, which camera, and how."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flangeye.devices import DeviceError
from flangeye.models.graph import Ask, Topic
from flangeye.models.urdf import NAMED, UrdfArm, arm_of, flange_links, parse_urdf
from flangeye.types import Floats
from flangeye_plugins.ros2.client import Message
from flangeye_plugins.ros2.messages import CLOUD, IMAGE, JOINT_STATE, TRAJECTORY, decoded, frame_of

NONE = "none"
"""The answer that there is no controller, or no trigger."""

TRIGGERS = re.compile(r"capture|trigger|acquire|scan|grab|snap|frame", re.IGNORECASE)
"""What services are called that take a scan, and not those that switch an arm on."""


class Heard(NamedTuple):
    """A topic that was listened to: how often it comes [Hz], and its newest message."""

    topic: Topic
    rate: float
    newest: Message | None

    @property
    def frame(self) -> str:
        """The frame of its messages, empty where none came."""
        return frame_of(self.newest.data) if self.newest else ""

    @property
    def line(self) -> str:
        """What it is, for people."""
        name, kind = self.topic.name, self.topic.type.rpartition("/")[2]
        often = f"{self.rate:.3g} Hz" if self.newest else "silent"
        frame = f", frame {self.frame}" if self.frame else ""
        return f"{name}: {kind}, {often}{frame}, by {' and '.join(self.topic.publishers)}"


def described_arm(text: str, path: Path, ask: Ask) -> tuple[UrdfArm, dict[str, Any]]:
    """Return the arm of a URDF that is to be saved at ``path``, and its section of a recipe.

    Raises:
        RecipeError: It is none, or does not tell which link is the base.
    """
    packages, urdf, flange = packages_of(text), parse_urdf(text, path), None
    links = flange_links(urdf)
    if len(links) > 1:  # of a gripper, or of a camera that the arm carries
        question = f"which link is the flange, z outwards ({', '.join(links[:NAMED])})"
        flange = ask("flange", question, None, links[0])
    found = arm_of(urdf, flange=flange, packages=packages)
    section: dict[str, Any] = {"urdf": path.name, "base": found.base, "flange": found.flange}
    if packages:
        section["packages"] = {name: str(folder) for name, folder in packages.items()}
    return found, section


def packages_of(text: str) -> dict[str, Path]:
    """Return the folders of the packages that a URDF's meshes are in, as the terminal has them."""
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    found = {}
    for name in dict.fromkeys(re.findall(r"package://([^/\"]+)/", text)):
        folders = (Path(prefix) / "share" / name for prefix in prefixes if prefix)
        if folder := next((each for each in folders if each.is_dir()), None):
            found[name] = folder
    return found


def states_of(heard: Sequence[Heard], joints: Sequence[str]) -> tuple[str, Floats]:
    """Return the topic that has all joints of an arm, and their angles (n,) now [rad].

    Raises:
        DeviceError: None has; says which joints each has.
    """
    told = []
    for each in heard:
        if each.topic.type == JOINT_STATE and each.newest:
            state = decoded(each.newest.data, JOINT_STATE)
            angles = dict(zip(state.name, state.position, strict=False))
            if set(joints) <= set(angles):
                return each.topic.name, np.array([angles[joint] for joint in joints])
            told.append(f"{each.topic.name} has {', '.join(state.name) or 'none'}")
    raise DeviceError(
        f"no JointState topic has the joints of the robot_description, {', '.join(joints)}: "
        f"{'; '.join(told) or 'none was heard'}"
    )


def arm_driver(
    topics: Iterable[Topic], joints: Sequence[str], states: str, ask: Ask
) -> dict[str, Any]:
    """Return the driver of an arm as a recipe names it, with its parameters."""
    listening = [t.name for t in topics if t.type == TRAJECTORY and t.subscribers]
    question = f"which controller moves the arm; {NONE}: others do, by hand or by a program"
    told = f" ({', '.join(listening)})" if len(listening) > 1 else ""
    chosen = ask("trajectory", question + told, _only(listening, NONE))
    params: dict[str, Any] = {"joints": list(joints)}
    if states != "/joint_states":
        params["joint_states"] = states
    if chosen == NONE:
        return {"ros2_freedrive": params}
    return {"ros2": params | {"trajectory": chosen}}


def scans_of(heard: Sequence[Heard], ask: Ask) -> Heard:
    """Return the topic of the scans: clouds, or depth images.

    Raises:
        DeviceError: There is none, or not the one that was asked for.
    """
    clouds = [each for each in heard if each.topic.type == CLOUD]
    depths = [each for each in heard if each.topic.type == IMAGE and "depth" in each.topic.name]
    found = {each.topic.name: each for each in clouds or depths}
    chosen = ask("scans", f"which topic has the scans ({', '.join(found)})", _only([*found], None))
    every = {each.topic.name: each for each in heard if each.topic.type in (CLOUD, IMAGE)}
    if chosen not in every:
        raise DeviceError(
            f"nobody publishes clouds or depth images on {chosen}; there are: "
            f"{', '.join(every) or 'none'}"
        )
    return every[chosen]


def scanner_driver(scans: Heard, triggers: Iterable[str], ask: Ask) -> dict[str, Any]:
    """Return the parameters of ``scanner.ros2``; one that is silent has to be triggered.

    Args:
        scans: The topic of its scans.
        triggers: Services that may take one.
        ask: For which does.
    """
    params: dict[str, Any] = {"cloud" if scans.topic.type == CLOUD else "depth": scans.topic.name}
    if scans.newest is None:
        namespace = f"{scans.topic.name.split('/')[1]}/"
        likely = [t for t in triggers if TRIGGERS.search(t) and t.startswith(f"/{namespace}")]
        question = f"{scans.topic.name} is silent: which service (std_srvs/Trigger) takes a scan"
        trigger = ask("trigger", question, _only(likely, None), "/camera/capture")
        if trigger != NONE:
            params["trigger"] = trigger
    return params


def _only(names: Sequence[str], otherwise: str | None) -> str | None:
    return names[0] if len(names) == 1 else otherwise if not names else None

"""What a name says of the poses that it names: whose they are, and which way round.

A name of two frames says both: ``gripper2base`` is a pose of the arm, ``camera_T_target``,
``T_cam_board`` and ``cHt`` are the target's as the camera sees it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

SEEN = re.compile(
    r"target|marker|cam|board|tag|cent(er|re)|seen|sphere|object|optical|track|detect"
)
"""In the name of what a camera measured."""
_ARM = re.compile(r"robot|arm|joint|gripper|flange|hand|tool|tcp|effector|(?<![a-z])ee(?![a-z])")
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
_ARMS = ({"base", "flange"}, {"world", "flange"})
_SIGHTS = ({"camera", "target"}, {"camera", "world"})
_TO = re.compile(r"(?<![a-zA-Z])([a-zA-Z]+)(?:2|_to_|To)([a-zA-Z]+)")
_IN = re.compile(r"(?<![a-zA-Z])([a-z]+)_?[TH]_?([a-z]+)(?![a-zA-Z])")
_OF = re.compile(r"(?<![a-zA-Z])[TH]_([a-z]+)_([a-z]+)")


def frames_in(name: str) -> tuple[str, str] | None:
    """Return frames A and B of A_T_B, as a name says; None where it does not."""
    to = _TO.search(name)
    match = to or _IN.search(name) or _OF.search(name)
    if match is None:
        return None
    first, second = (_FRAMES.get(word.lower()) for word in match.groups())
    if first is None or second is None:
        return None
    pair = (second, first) if to else (first, second)
    return pair if set(pair) in _ARMS or set(pair) in _SIGHTS else None


def is_inverse(frames: tuple[str, str]) -> bool:
    """Return whether a pose is flange_T_base or target_T_camera."""
    return frames[0] == "flange" or frames[1] == "camera"


def role_in(name: str) -> str | None:
    """Return ``arm`` or ``target``, as a name says; None where it does not."""
    frames = frames_in(name.rpartition(":")[2])
    if frames is not None:
        return "target" if "camera" in frames else "arm"
    found = {"target": SEEN.search(name.lower()), "arm": _ARM.search(name.lower())}
    roles = [role for role, match in found.items() if match]
    return roles[0] if len(roles) == 1 else None

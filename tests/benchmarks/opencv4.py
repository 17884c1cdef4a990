"""OpenCV 4's hand-eye functions on our sessions; needs OpenCV 4 and numpy only. See hand_eye.py."""

import json
import sys
from typing import Any

import cv2
import numpy as np

CV: Any = cv2  # the stubs of OpenCV 5 do not know its functions of OpenCV 4

AX_XB = {
    "tsai_lenz": "TSAI",
    "park_martin": "PARK",
    "horaud_dornaika": "HORAUD",
    "andreff": "ANDREFF",
    "daniilidis": "DANIILIDIS",
}
AX_ZB = {"shah": "SHAH", "li": "LI"}


def solve(name, carried, seen):
    """Return X (4, 4), gripper_T_camera."""
    parts = carried[:, :3, :3], carried[:, :3, 3], seen[:, :3, :3], seen[:, :3, 3]
    out = np.eye(4)
    if name in AX_XB:
        method = getattr(cv2, f"CALIB_HAND_EYE_{AX_XB[name]}")
        out[:3, :3], shift = CV.calibrateHandEye(*map(list, parts), method=method)
        out[:3, 3] = shift.ravel()
        return out
    # Their world is the target, their camera ours: world2cam, base2gripper.
    inverse = np.linalg.inv(carried)
    method = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{AX_ZB[name]}")
    _, _, rotation, shift = CV.calibrateRobotWorldHandEye(
        list(seen[:, :3, :3]), list(seen[:, :3, 3]), list(inverse[:, :3, :3]),
        list(inverse[:, :3, 3]), method=method,
    )  # fmt: skip
    out[:3, :3], out[:3, 3] = rotation, shift.ravel()
    return np.linalg.inv(out)


def main(path):
    held = np.load(path)
    figures: dict[str, Any] = {"opencv": cv2.__version__}
    for case in sorted({key.split("/")[0] for key in held}):
        carried, seen, truth = (held[f"{case}/{part}"] for part in ("carried", "seen", "truth"))
        figures[case] = {}
        for name in [*AX_XB, *AX_ZB]:
            found = np.array([solve(name, c, s) for c, s in zip(carried, seen, strict=True)])
            cosines = (np.einsum("nij,nij->n", found[:, :3, :3], truth[:, :3, :3]) - 1) / 2
            turn = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
            shift = np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1) * 1e3
            figures[case][name] = [float(np.sqrt(np.mean(e**2))) for e in (turn, shift)]
    json.dump(figures, sys.stdout, indent=2)


if __name__ == "__main__":
    main(sys.argv[1])

"""A person brings tip and torch to a mark, the tool turned otherwise each time: where they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from flangeye.devices import Robot
from flangeye.models.finger import Calibration, Finger
from flangeye.types import Floats
from flangeye_plugins.weld.touch.pivot import Pivot, pivot
from flangeye_plugins.weld.touch.tag_observation import TagReading
from flangeye_plugins.weld.touch.tip_displacement import Interpreter

ATTITUDES = (
    "as it welds",
    "leaning to the left by 20 deg",
    "leaning to the right by 20 deg",
    "leaning forwards by 20 deg",
    "leaning back by 20 deg",
    "turned by 40 deg about its axis, and leaning forwards",
    "turned by 40 deg the other way, and leaning to the left",
)
"""How the tool stands each time: a cone about the mark."""


class Pivoted(NamedTuple):
    """Both points of the tool."""

    tip: Pivot
    torch: Pivot


class Hand:
    """Asks a person to bring a point to the mark, and looks where the arm then is."""

    def __init__(
        self, robot: Robot, ask: Callable[[str], None], look: Callable[[], list[TagReading]]
    ) -> None:
        """Take the arm, the prompt, and what reads the finger where the arm now stands."""
        self._robot, self._ask, self._look = robot, ask, look

    def tip(self, finger: Finger, calibration: Calibration) -> Pivot:
        """Return where the tip is: its finger gives way, and says by how much."""
        feels = Interpreter(finger.model_copy(update={"calibration": calibration}))
        poses, displaced = [], []
        for attitude in ATTITUDES:
            self._ask(f"Bring the tip into the mark, hardly pressing, the tool {attitude}")
            readings = self._look()
            felt = [feels.feel(reading, 0).displacement for reading in readings]
            if felt:
                displaced.append(finger.flange_R_tool @ np.mean(felt, axis=0))
                poses.append(self._stands())
        return pivot("tip", poses, displaced)

    def torch(self) -> Pivot:
        """Return where the torch's end is."""
        poses = []
        for attitude in ATTITUDES:
            self._ask(f"Bring the torch's end to the mark, not pressing, the tool {attitude}")
            poses.append(self._stands())
        return pivot("torch", poses)

    def _stands(self) -> Floats:
        return self._robot.state().base_T_flange.matrix


def with_body(finger: Finger, found: Pivoted) -> Finger:
    """Return a finger's file with its tip and torch as they were found, and how well.

    The tool's x is the direction from torch to tip, seen along the flange's z, to which its own
    axis is parallel. What is uncertain of the torch is so relative to the tip.
    """
    away = found.tip.point - found.torch.point
    direction = float(np.arctan2(away[1], away[0]))
    placed = finger.model_copy(update={"direction": direction})
    relative = found.tip.covariance + found.torch.covariance
    along, across, _ = np.sqrt(np.diag(placed.flange_R_tool.T @ relative @ placed.flange_R_tool))
    told = {
        "tip": tuple(found.tip.point.tolist()),
        "torch": float(np.hypot(away[0], away[1])),
        "torch_aside": 0.0,
        "torch_up": float(placed.flange_R_tool[:, 2] @ -away),
        "torch_sigma": float(across),
        "along_sigma": float(along),
        "tip_sigma": float(np.sqrt(np.linalg.eigvalsh(found.tip.covariance)[-1])),
    }
    return placed.model_copy(update=told)


def summary_lines(found: Pivoted) -> list[str]:
    """Return what was found, for people."""
    tip, torch = (
        "'" + ", ".join(f"{x * 1e3:.2f} mm" for x in point.point) + "'" for point in found
    )
    return [
        _line("tip", found.tip),
        _line("torch", found.torch),
        "check      bring either to a point that the scanner saw, X,Y,Z in a calibration's RUN:",
        f"           flangeye touch RUN --seen X,Y,Z --tip {tip}",
        f"           flangeye touch RUN --seen X,Y,Z --tip {torch}",
    ]


def _line(name: str, found: Pivot) -> str:
    point = ", ".join(f"{x * 1e3:.2f}" for x in found.point)
    sigma = ", ".join(f"{x * 1e3:.2f}" for x in np.sqrt(np.diag(found.covariance)))
    return (
        f"{name:<10} at ({point}) mm in the flange, standard deviations ({sigma}) mm, "
        f"{found.rms * 1e3:.2f} mm unexplained"
    )

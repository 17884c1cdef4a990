"""What the paper prints: millimetres and degrees, as printed."""

from __future__ import annotations

from collections.abc import Mapping

AXES = ("x", "y", "z", "roll", "pitch", "yaw")

TABLE_1: Mapping[str, tuple[float, ...]] = {
    "UR5 PhoXi M": (11.60, 2.81, 5.55, 0.49, -0.89, -0.47),
    "UR10e PhoXi M": (0.60, 1.75, -0.41, 0.10, -0.04, -0.23),
    "Franka PhoXi M": (4.34, -4.06, -0.13, -0.30, -0.34, -0.07),
    "Aubo i5 PhoXi S": (-0.26, -0.27, -0.35, 0.14, 0.04, 0.01),
}
"""Table 1: errors with all sample points."""

KINECT = (-11.11, 3.90, 7.15, -0.15, 0.92, 1.56)
"""Section 4.2: UR10e and Azure Kinect."""

TABLE_2: Mapping[str, tuple[float, ...]] = {
    "4 pairs": (-1.94, -0.90, -0.86, -0.07, 0.04, -0.10),
    "16 pairs": (-0.98, -1.01, -0.83, -0.07, 0.09, -0.11),
}
"""Table 2: Photoneo's software with a sphere."""

GROWTH = 1 / 7
"""Section 3.1: growth of the translational deviation with noise, iterative to all data."""
WITHIN_TEN, WITHIN_TWENTY = 1.0, 0.2
"""Section 3.1: translational deviations after so many poses, at 1 mm of noise."""
YAW = 0.2
"""Section 3.1: the largest rotational deviation, at 1 mm of noise."""

"""``scan``, ``seam`` and ``weld`` stages. What they need differs much: ``context`` gives it."""

from __future__ import annotations

from typing import Any

import numpy as np

from flangeye import types as t
from flangeye.testing.base import Conformance
from flangeye.testing.judge import plain, require, require_covariance, require_round_trip
from flangeye.testing.solving import CAMERA, WORK, observed, reference_solution, work_points


def verified() -> t.VerifiedHandEye:
    """Return the kit's calibration, as if it had passed."""
    solved = reference_solution(observed(work_points()))
    return t.VerifiedHandEye(solved.camera, solved.pairs, solved.method)


def straight_seam() -> t.Seam:
    """Return a seam of 0.1 m across the kit's work, open upwards."""
    points = WORK + np.linspace([-0.05, 0.0, 0.0], [0.05, 0.0, 0.0], 21)
    up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    return t.Seam(points, up, np.tile(1e-8 * np.eye(3), (len(points), 1, 1)), source="kit")


class OnceConformance(Conformance):
    """Base of the three: one answer a run."""

    gives: type

    def answer(self) -> Any:
        """Return what the stage gives."""
        value = self.call({t.VerifiedHandEye: verified(), t.Seam: straight_seam()})
        require(
            isinstance(value, self.gives),
            f"gave {type(value).__name__}, not a {self.gives.__name__}",
        )
        return value

    def test_it_gives_the_same_twice(self) -> None:
        """Equal input and seed, equal output, to the last bit."""
        require(plain(self.answer()) == plain(self.answer()), "two calls with equal input differ")

    def test_its_answer_survives_the_log(self) -> None:
        """Written to MCAP and read back, it is the same."""
        require_round_trip(self.answer())


class ScanConformance(OnceConformance):
    """A ``scan`` stage: a WorkpieceScan out."""

    kind = "scan"
    gives = t.WorkpieceScan

    def test_its_points_are_in_the_camera_in_metres(self) -> None:
        """In the scanner's frame and within its range."""
        cloud = self.answer().cloud
        require(cloud.frame == t.CAMERA, f"the cloud is in '{cloud.frame}', not in '{t.CAMERA}'")
        depth = float(np.median(np.linalg.norm(cloud.points(), axis=1)))
        near, far = self.scanner.near / 20, self.scanner.far * 20
        require(near < depth < far, f"the scan's middle is {depth:.3g} m away: not in metres?")


class SeamConformance(OnceConformance):
    """A ``seam`` stage: a Seam in the robot's base out."""

    kind = "seam"
    gives = t.Seam

    def test_it_lies_in_the_cell_in_metres(self) -> None:
        """Not in the camera's frame, not in millimetres."""
        far = float(np.linalg.norm(self.answer().points_in_base - CAMERA[:3, 3], axis=1).max())
        limit = 5 * self.scanner.far
        require(far < limit, f"the seam is {far:.3g} m from the camera, which sees {limit / 5:.3g}")

    def test_its_covariances_are_covariances(self) -> None:
        """Symmetric, no negative variance."""
        for matrix in self.answer().covariance:
            require_covariance(matrix, "a point's covariance")


class WeldConformance(OnceConformance):
    """A ``weld`` stage: a WeldReport out."""

    kind = "weld"
    gives = t.WeldReport

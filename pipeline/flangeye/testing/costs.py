"""``cost`` and ``error`` parts: what ``solve.iterative`` minimises, and how it measures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from flangeye import types as t
from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.testing.base import Conformance
from flangeye.testing.judge import (
    require,
    require_close,
    require_refusal,
    require_repeats,
    require_type,
)
from flangeye.testing.solving import CAMERA, observed, work_points
from flangeye.types import Floats

AT = np.array([0.05, -0.03, 0.7])
"""Where the work is, in ``camera`` [m]."""


def pose_error(shift: Floats, turn: Floats | None = None) -> t.PoseError:
    """Return an error that moves the work by ``shift`` [m] and turns it about itself [rad]."""
    rotation = rotation_exp(np.zeros(3) if turn is None else turn)
    return t.PoseError(rigid(rotation, AT + shift - rotation @ AT), AT, CAMERA[:3, :3])


class CostConformance(Conformance):
    """A ``cost`` part: PoseError in, one number out; less is better."""

    kind = "cost"

    def cost(self, error: t.PoseError) -> float:
        """Return the part's number."""
        return require_type(self.call(None, error), float)

    def test_it_gives_the_same_twice(self) -> None:
        """Equal errors, equal costs, to the last bit."""
        error = pose_error(np.array([1e-3, 2e-3, -1e-3]), np.array([1e-3, 0, 2e-3]))
        require_repeats(lambda: self.cost(error))

    def test_no_error_costs_nothing(self) -> None:
        """Zero at zero."""
        require(abs(self.cost(pose_error(np.zeros(3)))) < 1e-12, "no error has a cost")

    def test_an_error_costs_something(self) -> None:
        """Finite and positive in a general direction."""
        cost = self.cost(pose_error(np.array([1e-3, 2e-3, -1e-3])))
        require(np.isfinite(cost) and cost > 0, f"an error of 2 mm costs {cost}")

    def test_it_scales_with_the_error(self) -> None:
        """Twice the error never costs less."""
        costs = [self.cost(pose_error(k * np.array([1e-3, 2e-3, -1e-3]))) for k in (1, 2, 4)]
        require(costs[0] < costs[1] < costs[2], f"1, 2, 4 times the error cost {costs}")

    def test_an_error_and_its_mirror_cost_the_same(self) -> None:
        """There is no good side to be off on."""
        shift = np.array([1e-3, 2e-3, -1e-3])
        here, there = self.cost(pose_error(shift)), self.cost(pose_error(-shift))
        require(
            np.isclose(here, there, rtol=1e-6), f"an error costs {here:.6g}, its mirror {there:.6g}"
        )


class ErrorConformance(Conformance):
    """An ``error`` part: a candidate pose and poses kept from it in, PoseError or None out."""

    kind = "error"

    def measured(self, candidate: Floats, kept: Sequence[t.Observation]) -> Any:
        """Return the part's answer."""
        pose = t.Transform(t.BASE, t.CAMERA, candidate)
        return self.call({}, pose, list(kept))

    def test_it_gives_the_same_twice(self) -> None:
        """Equal input, equal output, to the last bit."""
        require_repeats(lambda: self.measured(CAMERA, observed(work_points())))

    def test_the_true_pose_has_next_to_no_error(self) -> None:
        """What is left is the noise."""
        off = np.linalg.norm(self.measured(CAMERA, observed(work_points())).displacement())
        require(off < 0.1e-3, f"the true pose is said to be {1e3 * off:.3f} mm off")

    def test_a_candidate_that_is_off_is_off_by_so_much(self) -> None:
        """3 mm, at the work, in metres."""
        candidate = CAMERA.copy()
        candidate[:3, 3] += [1e-3, -2e-3, 2e-3]
        off = np.linalg.norm(self.measured(candidate, observed(work_points())).displacement())
        require(abs(off - 3e-3) < 0.1e-3, f"3 mm are said to be {1e3 * off:.3f} mm")

    def test_too_little_is_refused(self) -> None:
        """No pose kept."""
        require_refusal(lambda: self.measured(CAMERA, []), type(None), "no pose kept")

    def test_it_measures_in_the_cameras_frame(self) -> None:
        """The motion takes what was measured onto what the candidate predicts."""
        candidate = CAMERA.copy()
        candidate[:3, 3] += [1e-3, -2e-3, 2e-3]
        off = self.measured(candidate, observed(work_points())).displacement()
        expected = -CAMERA[:3, :3].T @ np.array([1e-3, -2e-3, 2e-3])
        require_close(off, expected, 0.1e-3, "the error of a candidate, in camera [m]")

"""Conformance of ``scan``, ``seam`` and ``weld`` stages (with ``context``), and controllers."""

from typing import Any, get_args

import numpy as np

from flangeye import types as t
from flangeye.motion.seam_following import Command, FollowingTask, Phase, ToolPose, Touch
from flangeye.testing.base import (
    Conformance,
    require,
    require_covariance,
    require_repeats,
    require_round_trip,
    require_type,
)
from flangeye.testing.solving import TRUE_CAMERA, WORK, observed, reference_solution, work_points


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
    """Base of the conformance classes of scan, seam and weld stages: one answer per run."""

    gives: type

    def answer(self) -> Any:
        """Return the stage's output."""
        value = self.call({t.VerifiedHandEye: verified(), t.Seam: straight_seam()})
        return require_type(value, self.gives)

    def test_it_gives_the_same_twice(self) -> None:
        """Two calls with equal input and seed give equal output, to the last bit."""
        require_repeats(self.answer)

    def test_its_answer_survives_the_log(self) -> None:
        """The answer is unchanged after it is written to MCAP and read back."""
        require_round_trip(self.answer())


class ScanConformance(OnceConformance):
    """A ``scan`` stage: returns a WorkpieceScan."""

    kind = "scan"
    gives = t.WorkpieceScan

    def test_its_points_are_in_the_camera_in_metres(self) -> None:
        """The scan's points are in the scanner's frame and within its range, in metres."""
        cloud = self.answer().cloud
        require(cloud.frame == t.CAMERA, f"the cloud is in '{cloud.frame}', not in '{t.CAMERA}'")
        depth = float(np.median(np.linalg.norm(cloud.points(), axis=1)))
        near, far = self.scanner.near / 20, self.scanner.far * 20
        require(near < depth < far, f"the scan's middle is {depth:.3g} m away: not in metres?")


class SeamConformance(OnceConformance):
    """A ``seam`` stage: returns a Seam in the robot's base."""

    kind = "seam"
    gives = t.Seam

    def test_it_lies_in_the_cell_in_metres(self) -> None:
        """The seam lies in the robot's base, within the cell, in metres."""
        far = float(np.linalg.norm(self.answer().points_in_base - TRUE_CAMERA[:3, 3], axis=1).max())
        limit = 5 * self.scanner.far
        require(far < limit, f"the seam is {far:.3g} m from the camera, which sees {limit / 5:.3g}")

    def test_its_covariances_are_covariances(self) -> None:
        """Each point's covariance is symmetric and has no negative variance."""
        for matrix in self.answer().covariance:
            require_covariance(matrix, "a point's covariance")


class WeldConformance(OnceConformance):
    """A ``weld`` stage: returns a WeldReport."""

    kind = "weld"
    gives = t.WeldReport


def straight_task() -> FollowingTask:
    """Return a seam of 0.1 m along x, to be followed at 5 mm/s with 2 mm of deflection."""
    along = np.arange(0.0, 0.1 + 1e-9, 0.5e-3)
    points = np.column_stack([along, 0 * along, 0 * along])
    return FollowingTask(
        points, np.tile([1.0, 0.0], (len(points), 1)), step=0.5e-3, torch_distance=40e-3, side=1.0,
        speed=5e-3, deflection=2e-3, preload=1.5e-3, servo_gain=3.0, height_gain=3.0,
        lateral_speed=5e-3, turn_rate=np.deg2rad(20.0),
    )  # fmt: skip


class ControllerConformance(Conformance):
    """A ``controller`` part: takes poses and touches, returns one command per cycle.

    The test moves the tool along the plan for ten seconds with the requested deflection. It does
    not judge the path that the commands describe.
    """

    kind = "controller"

    def commands(self) -> list[Command]:
        """Return the controller's commands."""
        controller, task = self.call(None, straight_task()), straight_task()
        felt, given = np.array([0.0, -task.deflection, -task.preload]), []
        period = 8e-3  # between two cycles of a controller [s]
        for i in range(round(10.0 / period)):
            time = i * period
            pose = ToolPose(time, np.array([task.speed * time, 0.0, 0.0]), 0.0)
            given.append(controller.step(pose, [Touch(time, felt)]))
            require(
                controller.phase in get_args(Phase),
                f"phase '{controller.phase}' is none of {', '.join(get_args(Phase))}",
            )
        return given

    def test_it_commands_the_same_twice(self) -> None:
        """Two runs with equal input give equal commands, to the last bit."""
        first, again = ([(*c.velocity, c.turn) for c in self.commands()] for _ in range(2))
        require(first == again, "two runs with equal input differ")

    def test_its_commands_are_finite_and_turn_no_faster_than_allowed(self) -> None:
        """Every command has three finite velocities [m/s] and an allowed turn rate [rad/s]."""
        limit = straight_task().turn_rate
        for command in self.commands():
            require(
                np.shape(command.velocity) == (3,)
                and bool(np.isfinite([*command.velocity, command.turn]).all()),
                f"commanded {command}: three finite velocities and a turn are expected",
            )
            require(
                abs(command.turn) <= limit * (1 + 1e-9),
                f"commanded a turn of {command.turn:.3g} rad/s, {limit:.3g} are allowed",
            )

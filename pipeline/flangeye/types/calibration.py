"""The camera's pose, before and after it was verified."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.json_schema import SkipJsonSchema

from flangeye.types.arrays import Array, Floats, Indices, Note, freeze
from flangeye.types.features import Observation
from flangeye.types.frames import BASE, FrameMismatchError, TransformEstimate


@dataclass(frozen=True, eq=False)
class Pair:
    """One observation after solving.

    Attributes:
        observation: The observation used.
        residual: (3,) measured centre, mapped to ``base``, minus where the arm as its controller
            reports it has the TCP or the target [m].
        used: Whether it took part in the estimate.
        reason: Why it did not.
    """

    observation: Observation
    residual: Array
    used: bool = True
    reason: str | None = None

    def __post_init__(self) -> None:
        freeze(self, residual=(3,))


@dataclass(frozen=True, eq=False)
class SmoothField:
    """A smooth displacement of the flange over the workspace: the arm's remaining errors.

    A Gaussian process of low order: the features of the squared-exponential kernel up to the
    second power of the place. Evaluated by :mod:`flangeye.maths.arm_correction`.

    Attributes:
        about: (3,) middle of the calibration's poses, in ``base`` [m].
        length: Correlation length of the field [m].
        weights: (K,) weights of the features [m].
    """

    about: Array
    length: float
    weights: Array

    def __post_init__(self) -> None:
        k = len(self.weights)
        freeze(self, about=(3,), weights=(k,))


@dataclass(frozen=True, eq=False)
class ArmCorrection:
    """Estimated errors of an arm against its controller's model.

    Attributes:
        tool_offset: (3,) the seen circle's centre in ``flange`` [m].
        joint_offsets: (n,) to add to the joint angles [rad], or None.
        joints: (n,) joint angles of one pose of the session [rad]. Where a pose comes without
            joint angles, inverse kinematics starts from these; with ``joint_offsets``.
        lengths: (n, 3) to add to each joint's Denavit-Hartenberg ``a``, ``d`` [m] and ``alpha``
            [rad], or None; with ``joint_offsets``.
        field: Smooth displacement of where the arm reports the flange's origin, to add to it in
            ``base``; the camera's pose holds for the arm as reported with or without it.
    """

    tool_offset: Array
    joint_offsets: Array | None = None
    joints: Array | None = None
    field: SmoothField | None = None
    lengths: Array | None = None

    def __post_init__(self) -> None:
        freeze(self, tool_offset=(3,))

    @property
    def of_arm(self) -> bool:
        """Whether the correction changes the arm, not only the circle's place on the flange."""
        return self.joint_offsets is not None or self.field is not None


@dataclass(frozen=True, eq=False)
class CorrectedArm:
    """The pose for the corrected arm; pose and correction belong together.

    Attributes:
        camera: As in :class:`HandEye`.
        correction: Errors of the arm to correct; None in a cell.
        others: As in :class:`HandEye`.
        arms: As in :class:`HandEye`.
        shared: As in :class:`HandEye`.
        expected: As in :class:`HandEye`, of the corrected arm.
    """

    camera: TransformEstimate
    correction: ArmCorrection | None
    others: tuple[TransformEstimate, ...] = ()
    arms: Mapping[str, ArmCorrection] = field(default_factory=dict)
    shared: Array = field(default_factory=lambda: np.zeros(0))
    expected: ExpectedError | None = None

    def __post_init__(self) -> None:
        freeze(self, shared=(len(self.shared),))


@dataclass(frozen=True)
class ExpectedError:
    """Expected error when the arm is sent to a scanned point.

    Attributes:
        rms: Root mean square over the work [m].
        p95: 95 % of the errors are below [m].
    """

    rms: float
    p95: float


@dataclass(frozen=True, eq=False)
class HandEye:
    """A calibration that is not verified yet.

    Attributes:
        camera: The camera's pose in the frame that carries it: ``base_T_camera`` where it stands
            beside the robot, ``flange_T_camera`` where the robot moves it. The best there is for
            the arm as its controller reports it.
        pairs: Every observation the solver pulled.
        method: Stage that solved it.
        notes: Warnings and records.
        correction: What it found wrong with the arm and this pose holds with and without.
        others: The configuration's other unknowns, such as ``base_T_target``.
        corrected: Where another pose is the best for the corrected arm: that pose, with its
            correction.
        expected: The error to expect at the work; None where it was not estimated.
        true: The unknowns in the arms' true bases, with all that the arms may do wrong alike at
            every pose in their covariances: for metrology, not for sending the arm anywhere.
        arms: Correction of each arm of a cell, by the arm's name.
        shared: (k,) how much it found of each error that the features share (such as the camera's,
            :class:`PoseFeature`), in standard deviations; none where it looked for none.
        without: Takes indices of pairs and returns the answer that the others give, where the
            solver knows it without solving again, with the covariances of all; it raises as the
            solver does.
    """

    camera: TransformEstimate
    pairs: tuple[Pair, ...]
    method: str
    notes: tuple[Note, ...] = ()
    correction: ArmCorrection | None = None
    others: tuple[TransformEstimate, ...] = ()
    corrected: CorrectedArm | None = None
    expected: ExpectedError | None = None
    true: tuple[TransformEstimate, ...] = ()
    arms: Mapping[str, ArmCorrection] = field(default_factory=dict)
    shared: Array = field(default_factory=lambda: np.zeros(0))
    without: Annotated[SkipJsonSchema[Callable[[Indices], HandEye] | None], Field(exclude=True)] = (
        None  # no log holds it
    )

    def __post_init__(self) -> None:
        freeze(self, shared=(len(self.shared),))

    def as_reported(self) -> HandEye:
        """Return the calibration without the corrected arm's pose: for the arm as reported only."""
        known = self.correction and replace(
            self.correction, joint_offsets=None, field=None, lengths=None
        )
        return replace(self, correction=known, corrected=None, arms={})

    def as_corrected(self) -> HandEye | None:
        """Return the answer for the corrected arm; None if no correction was estimated."""
        if self.corrected is not None:
            found = self.corrected
            answer = replace(self, camera=found.camera, correction=found.correction)
            answer = replace(answer, shared=found.shared, expected=found.expected)
            others = found.others or self.others
            return replace(answer, others=others, corrected=None, arms=found.arms)
        known = (self.correction, *self.arms.values())
        return self if any(each is not None and each.of_arm for each in known) else None

    @property
    def base_T_camera(self) -> TransformEstimate:
        """The camera's pose in the robot's base; only for a camera fixed there."""
        if self.camera.transform.parent != BASE:
            raise FrameMismatchError(
                f"the calibration is {self.camera.transform.name}, and base_T_camera is needed"
            )
        return self.camera

    @property
    def transforms(self) -> dict[str, TransformEstimate]:
        """Every estimate by its name, the camera's first."""
        return {x.transform.name: x for x in (self.camera, *self.others)}


@dataclass(frozen=True, eq=False)
class PoseError:
    """Error of a candidate calibration, and the point at which it matters.

    Attributes:
        motion: (4, 4) motion in ``camera`` from measured to predicted points.
        at: (3,) where the work is, in ``camera`` [m].
        base_R_camera: (3, 3) rotation of the candidate, to express the error in ``base``.
    """

    motion: Array
    at: Array
    base_R_camera: Array

    def __post_init__(self) -> None:
        freeze(self, motion=(4, 4), at=(3,), base_R_camera=(3, 3))

    def displacement(self, at: Floats | None = None) -> Floats:
        """Return the displacement (3,) of a place, by default the work, in ``camera`` [m]."""
        at = self.at if at is None else at
        return np.asarray(self.motion[:3, :3] @ at + self.motion[:3, 3] - at)


@dataclass(frozen=True, eq=False)
class Verification:
    """Output of a ``verify`` stage.

    Attributes:
        passed: Whether the calibration may be used.
        reason: One line: the figure and its limit.
        figures: Named results in SI units.
        errors: Per-pose errors on poses that took no part [m], by observation id.
        advice: The next step after a failure; empty if the verification knows none.
        units: Unit of each figure: ``m``, ``rad``, ``share``, ``relative`` (a ratio less 1), or
            empty for a plain number. A report shows m in mm, rad in degrees, and so on; it
            guesses the unit of a figure that is not listed from its name.
    """

    passed: bool
    reason: str
    figures: Mapping[str, float]
    errors: Mapping[str, float] = field(default_factory=dict)
    advice: str = ""
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class VerifiedHandEye(HandEye):
    """A calibration that passed every verification; only the runner makes one."""

    verifications: Mapping[str, Verification] = field(default_factory=dict)


Solver = Callable[[Sequence[Observation]], HandEye]
"""Solves a subset of the observations again, with the recipe's own solve and refine steps."""

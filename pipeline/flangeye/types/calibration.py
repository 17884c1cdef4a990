"""The camera's pose, before and after it was verified."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from flangeye.types.arrays import Array, freeze
from flangeye.types.features import Observation
from flangeye.types.frames import BASE, FrameMismatchError, TransformEstimate


@dataclass(frozen=True, eq=False)
class Pair:
    """One observation after solving.

    Attributes:
        observation: What went in.
        residual: (3,) measured centre, mapped to ``base``, minus where the calibration expects
            it: at the TCP (corrected, where the solver corrects the arm), or at the target [m].
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
class ArmCorrection:
    """What a solver found wrong with where the arm says its flange is.

    Attributes:
        tool_offset: (3,) the seen circle's centre in ``flange`` [m].
        joint_offsets: (n,) to add to the joint angles [rad], or None.
        joints: (n,) a configuration of the arm on the branch that it was in [rad], from which
            the angles of a pose without any are found; with ``joint_offsets``.
    """

    tool_offset: Array
    joint_offsets: Array | None = None
    joints: Array | None = None

    def __post_init__(self) -> None:
        freeze(self, tool_offset=(3,))


@dataclass(frozen=True, eq=False)
class HandEye:
    """A calibration that nobody has verified yet.

    Attributes:
        camera: The camera's pose in the frame that carries it: ``base_T_camera`` where it stands
            beside the robot, ``flange_T_camera`` where the robot moves it.
        pairs: Every observation the solver pulled.
        method: Stage that solved it.
        notes: What the solver wants the person to know.
        correction: What it found wrong with the arm; the pose holds with it.
        others: The configuration's other unknowns, such as ``base_T_target``.
    """

    camera: TransformEstimate
    pairs: tuple[Pair, ...]
    method: str
    notes: tuple[str, ...] = ()
    correction: ArmCorrection | None = None
    others: tuple[TransformEstimate, ...] = ()

    @property
    def base_T_camera(self) -> TransformEstimate:
        """The camera's pose in the robot's base, for those who can use nothing else."""
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
    """How far a candidate calibration is off, and where that matters.

    Attributes:
        motion: (4, 4) in ``camera``; takes what was measured onto what was predicted.
        at: (3,) where the work is, in ``camera`` [m].
        base_R_camera: (3, 3) of the candidate, to express the error in ``base``.
    """

    motion: Array
    at: Array
    base_R_camera: Array

    def __post_init__(self) -> None:
        freeze(self, motion=(4, 4), at=(3,), base_R_camera=(3, 3))


@dataclass(frozen=True, eq=False)
class Verification:
    """What a ``verify`` stage found.

    Attributes:
        passed: Whether the calibration may be used.
        reason: One line: the figure and the limit it was held against.
        figures: Named results in SI units.
        errors: Per-pose errors on poses that took no part [m], by observation id.
    """

    passed: bool
    reason: str
    figures: Mapping[str, float]
    errors: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class VerifiedHandEye(HandEye):
    """A calibration that passed every verification; only the runner makes one."""

    verifications: Mapping[str, Verification] = field(default_factory=dict)


Solver = Callable[[Sequence[Observation]], HandEye]
"""Solves a subset of the observations again, with the recipe's own solve and refine steps."""

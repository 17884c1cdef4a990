"""The schema of ``result.json``: a model for each section."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from flangeye.types import Transform


def _listed(value: Any) -> Any:
    """Return the numbers of an array, for parts that are read off the types of a run."""
    return value.tolist() if hasattr(value, "tolist") else value


Vector = Annotated[list[float], BeforeValidator(_listed)]
Point = Annotated[Vector, Field(min_length=3, max_length=3)]
Matrix = Annotated[list[list[float]], BeforeValidator(_listed)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", defer_build=True, from_attributes=True)


class TransformResult(_Part):
    """An estimated transform."""

    matrix: Matrix = Field(description="4x4, maps child coordinates to parent coordinates.")
    covariance: Matrix = Field(
        description="6x6, order (rotation [rad], translation [m]), of a left perturbation in the "
        "parent frame, the translation taken at `about`."
    )
    about: Point = Field(description="Point in the parent frame [m].")
    unobservable: Matrix | None = Field(
        None,
        description="Directions (rotation, translation), about the same point, along which the "
        "estimate is arbitrary and the covariance says nothing.",
    )
    shares: dict[str, Matrix] = Field(
        {}, description="6x6 parts of the covariance by cause; the remainder is the uncertainty of "
        "the causes' sizes."
    )  # fmt: skip

    @model_validator(mode="after")
    def _are_of_a_transform(self) -> Self:
        """Check the sizes, which JSON leaves open."""
        sizes = {"matrix": (self.matrix, 4), "covariance": (self.covariance, 6)}
        sizes |= {f"shares.{cause}": (share, 6) for cause, share in self.shares.items()}
        for name, (rows, count) in sizes.items():
            if len(rows) != count or any(len(row) != count for row in rows):
                raise ValueError(f"'{name}' is not {count}x{count}")
        if any(len(direction) != 6 for direction in self.unobservable or []):
            raise ValueError("a direction of 'unobservable' has not 6 components")
        _require_covariance(self.covariance)
        Transform.named("base_T_camera", self.matrix)  # which refuses what is not rigid
        return self

    @property
    def sigma(self) -> list[float | None]:
        """Standard deviations about and along the parent's axes [rad, m]; None if unknown."""
        free = [max(map(abs, column)) for column in zip(*(self.unobservable or []), strict=True)]
        # An axis with a larger share in a direction that was not measured has no deviation of its
        # own
        return [
            None if free and free[i] > 0.01 else math.sqrt(max(row[i], 0.0))
            for i, row in enumerate(self.covariance)
        ]


def _require_covariance(rows: Matrix) -> None:
    """Refuse variances below zero, and correlations beyond one."""
    variances = [row[i] for i, row in enumerate(rows)]
    bounds = [[(1 + 1e-6) * a * b for b in variances] for a in variances]
    pairs = ((x * x, bound) for row, of in zip(rows, bounds, strict=True)
             for x, bound in zip(row, of, strict=True))  # fmt: skip
    if any(variance < 0 for variance in variances) or any(square > most for square, most in pairs):
        raise ValueError("'covariance' has a variance below 0, or a correlation beyond 1")


class ObservationResult(_Part):
    """One capture and its outcome; measured values are null if it was rejected early."""

    id: str
    centre_in_camera: Point | None = None
    normal_in_camera: Point | None = None
    radii: dict[str, float] | None = None
    covariance: Matrix | None = Field(None, description="3x3, of the centre [m^2].")
    arc_coverage: float | None = Field(None, description="Share of the rim that was seen.")
    clocking: float | None = Field(None, description="Angle of the hole pattern [rad], if seen.")
    tcp_in_base: Point | None = None
    camera: str | None = Field(None, description="Which camera of a cell saw it.")
    target: str | None = Field(None, description="Which target of a cell it saw.")
    residual: float | None = Field(None, description="Distance of mapped centre and TCP [m].")
    residual_in_base: Point | None = Field(None, description="Mapped centre minus TCP [m].")
    used: bool
    reason: str | None = Field(None, description="Why it was not used.")

    @model_validator(mode="after")
    def _are_of_space(self) -> Self:
        """Check the sizes, which JSON leaves open."""
        points = (
            self.centre_in_camera, self.normal_in_camera, self.tcp_in_base, self.residual_in_base,
            *(self.covariance or []),
        )  # fmt: skip
        if any(point is not None and len(point) != 3 for point in points):
            raise ValueError("a point of it has not 3 coordinates")
        if self.covariance is not None and len(self.covariance) != 3:
            raise ValueError("'covariance' is not 3x3")
        _require_covariance(self.covariance or [])
        return self


class HoldoutResult(_Part):
    """Errors on poses that took no part in the estimate."""

    folds: int
    rms: float
    median: float
    p95: float
    figures: dict[str, float] = Field(description="Everything else verify.holdout reports.")


class VerificationResult(_Part):
    """One verify step."""

    passed: bool
    reason: str
    figures: dict[str, float]
    errors: dict[str, float] = Field(description="Per pose, by observation id [m].")


class WorkspaceResult(_Part):
    """Where the work is."""

    centre: Point
    size: Point


class ExpectedErrorResult(_Part):
    """Expected error when the arm is sent to a scanned point."""

    rms: float = Field(description="Root mean square over the work [m].")
    p95: float = Field(description="95 % of the errors are below [m].")


class TransformErrorResult(_Part):
    """Simulation only: true error of one transform."""

    rotation: float = Field(description="[rad]")
    translation: float = Field(description="Error of the point its covariance is taken about [m].")


class TruthResult(_Part):
    """Simulation only: the calibration's true error."""

    base_T_camera: Matrix | None = Field(None, description="Where the camera is, if it stands.")
    transforms: dict[str, Matrix] = Field(
        default_factory=dict, description="Every unknown, as it really is."
    )
    errors: dict[str, TransformErrorResult] = Field(
        default_factory=dict, description="Error of every unknown, where its covariance is taken."
    )
    error_at_centroid: float = Field(description="At the workspace's centre [m].")
    rms_over_workspace: float = Field(description="Over the workspace box [m].")
    rotation_error: float = Field(description="[rad]")
    at_work: float | None = Field(
        None,
        description="Where the arm is not what it reports: rms distance, at poses that took no "
        "part, between where the camera says the target is and where the controller has it, the "
        "correction of the circle's place applied if there is one [m].",
    )
    at_work_corrected: float | None = Field(
        None, description="The same of the pose for the corrected arm, and that arm [m]."
    )


class SeamTruthResult(_Part):
    """Simulation only: true error of the planned seam."""

    rms: float = Field(description="Distance of the planned points from the true seam [m].")
    max: float
    inside: float = Field(description="Share of the planned points whose tube holds it.")


class SeamResult(_Part):
    """The planned seam, in the base."""

    source: str
    length: float = Field(description="[m]")
    points: Matrix = Field(description="(N, 3) along the root of the groove [m].")
    openings: Matrix = Field(description="(N, 3) unit vectors towards the torch.")
    covariance: list[Matrix] = Field(description="(N, 3, 3) of the points [m^2].")
    tube: Vector = Field(description="(N) with 95 % the seam is not further off than this [m].")
    half_angle: float | None = Field(None, description="Half angle of the groove [rad].")
    half_width: float | None = Field(
        None, description="Half width of the groove at its shoulders [m]."
    )
    figures: dict[str, float] = Field(description="What the seam step reports.")
    notes: list[str]
    truth: SeamTruthResult | None = None


class WeldTruthResult(_Part):
    """Simulation only: the torch's true distance across the seam, after the lead-in."""

    rms: float = Field(description="[m]")
    max: float


class WeldResult(_Part):
    """The torch's result."""

    mode: str
    completed: bool
    reason: str = Field(description="Why it ended early; empty when it did not.")
    seconds: float = Field(description="From the first cycle to the last.")
    correction_rms: float | None = Field(
        None, description="From the plan to the seam as it was felt, across it [m]."
    )
    phases: dict[str, float] = Field(description="Time in each phase of the controller [s].")
    figures: dict[str, float]
    truth: WeldTruthResult | None = None


class FieldResult(_Part):
    """A smooth displacement over the workspace; flangeye.maths.arm_correction evaluates it."""

    about: Point = Field(description="Middle of the calibration's poses, in the base [m].")
    length: float = Field(description="Correlation length of the field [m].")
    weights: Vector = Field(description="Weights of the K features [m].")


class CorrectionResult(_Part):
    """Estimated errors of the arm, with which its poses can be corrected."""

    tool_offset: Point = Field(description="The circle's centre in the flange frame [m].")
    joint_offsets: Vector | None = Field(None, description="To add to the joint angles [rad].")
    joints: Vector | None = Field(
        None, description="A configuration on the branch of the arm that was calibrated [rad]."
    )
    lengths: Matrix | None = Field(
        None, description="nx3, to add to each joint's a, d [m] and alpha [rad]."
    )
    field: FieldResult | None = Field(
        None, description="Smooth displacement of the flange, to add to where the arm reports it."
    )


class AnswerResult(_Part):
    """The pose for one arm: as its controller reports it, or corrected."""

    transforms: dict[str, TransformResult]
    correction: CorrectionResult | None = Field(
        None, description="The arm correction that these poses require."
    )
    arms: dict[str, CorrectionResult] = Field(
        default_factory=dict, description="The same of a cell's arms, by their names."
    )
    expected_rms: float | None = Field(
        None,
        description="Error to expect at the work, rms [m].",
    )
    holdout_rms: float | None = Field(None, description="On poses held out, over all of them [m].")


class AnswersResult(_Part):
    """The two answers, side by side: never mix the pose of one with the arm of the other."""

    as_reported: AnswerResult = Field(description="For the arm as its controller reports it.")
    corrected: AnswerResult | None = Field(
        None, description="For the arm with its error corrected; null: no error was found."
    )


class StageTiming(_Part):
    """Duration of one step, without the steps it pulls from."""

    seconds: float
    calls: int
    idle: float | None = Field(
        None,
        description="Share of a live session in which the arm stood while nothing was exposed.",
    )


class WarningResult(_Part):
    """A warning, and what to do about it."""

    text: str = Field(description="What is wrong, one line.")
    fix: str = Field(description="A command, a line of the recipe, or what to do at the cell.")


class Provenance(_Part):
    """Provenance of the result."""

    versions: dict[str, str]
    plugins: dict[str, str]
    recipe: str
    recipe_hash: str = Field(description="SHA-256 of recipe.resolved.yaml.")
    input_hash: str = Field(description="Hash of everything the captures are made from.")
    seed: int
    notes: list[str] = Field(description="Notes of the source and the steps.")


class Result(_Part):
    """The whole document."""

    format: int = Field(1, description="Version of this contract.")
    title: str
    status: Literal["verified", "unverified", "refused", "incomplete"] = Field(
        description="unverified: there was no verify step; incomplete: of a run that was killed."
    )
    refused: str | None = Field(None, description="Why.")
    method: str | None = Field(None, description="The solve step.")
    transforms: dict[str, TransformResult] = Field(
        description="The best for the arm as its controller reports it."
    )
    correction: CorrectionResult | None = Field(
        None, description="Where on the flange the circle is, if not at its origin."
    )
    answers: AnswersResult | None = Field(
        None, description="The transforms for the arm as it reports, and those for it corrected."
    )
    expected_error: ExpectedErrorResult | None = Field(
        None,
        description="The error to expect at the work, with the transforms for the arm as its "
        "controller reports it; null where the solver does not estimate it.",
    )
    true: dict[str, TransformResult] = Field(
        default_factory=dict,
        description="The transforms in the arm's true base, for metrology: their covariances "
        "include arm errors common to all poses.",
    )
    observations: list[ObservationResult]
    workspace: WorkspaceResult | None = None
    holdout: HoldoutResult | None = None
    verifications: dict[str, VerificationResult]
    truth: TruthResult | None = None
    seam: SeamResult | None = None
    weld: WeldResult | None = None
    simulated: bool = Field(
        False, description="The captures are a simulator's: nothing real has been calibrated."
    )
    warnings: list[WarningResult] = Field(
        default_factory=list, description="What is to be done, and the line that does it."
    )
    notes: list[str] = Field(default_factory=list, description="Notes of the steps.")
    exports: dict[str, str] = Field(
        default_factory=dict, description="What export steps wrote: file name -> content."
    )
    timing: dict[str, StageTiming]
    provenance: Provenance

    @model_validator(mode="after")
    def _names_are_of_transforms(self) -> Self:
        """Check the names that exports write into other programs' files."""
        for name, found in self.transforms.items():
            Transform.named(name, found.matrix)
        return self

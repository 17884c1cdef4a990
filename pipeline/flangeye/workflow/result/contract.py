"""The schema of ``result.json``: a model for each section."""

import math
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from flangeye.files.described import Described
from flangeye.types import Transform


def _listed(value: Any) -> Any:
    """Return the numbers of an array, for parts that are read off the types of a run."""
    return value.tolist() if hasattr(value, "tolist") else value


NumberList = Annotated[list[float], BeforeValidator(_listed)]
PointList = Annotated[NumberList, Field(min_length=3, max_length=3)]
Matrix = Annotated[list[list[float]], BeforeValidator(_listed)]


class _ResultPart(Described):
    model_config = ConfigDict(extra="forbid", defer_build=True, from_attributes=True)


class TransformResult(_ResultPart):
    """An estimated transform with its uncertainty."""

    matrix: Matrix
    """4x4, maps child coordinates to parent coordinates."""
    covariance: Matrix
    """6x6, order (rotation [rad], translation [m]), of a left perturbation in the parent frame, the
    translation taken at `about`."""
    about: PointList
    """Point in the parent frame [m]."""
    unobservable: Matrix | None = None
    """Directions (rotation, translation), about the same point, along which the estimate is
    arbitrary and the covariance says nothing."""
    shares: dict[str, Matrix] = Field({})
    """6x6 parts of the covariance by cause; the remainder is the uncertainty of the causes'
    sizes."""

    @model_validator(mode="after")
    def _are_of_a_transform(self) -> Self:
        """Check the arrays' sizes, which JSON Schema does not state."""
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


class ObservationResult(_ResultPart):
    """One capture and its outcome; measured values are null if it was rejected early."""

    id: str
    centre_in_camera: PointList | None = None
    normal_in_camera: PointList | None = None
    radii: dict[str, float] | None = None
    covariance: Matrix | None = None
    """3x3, of the centre [m^2]."""
    arc_coverage: float | None = None
    """Share of the rim that was seen."""
    clocking: float | None = None
    """Angle of the hole pattern [rad], if seen."""
    tcp_in_base: PointList | None = None
    camera: str | None = None
    """Which camera of a cell saw it."""
    target: str | None = None
    """Which target of a cell it saw."""
    residual: float | None = None
    """Distance of mapped centre and TCP [m]."""
    residual_in_base: PointList | None = None
    """Mapped centre minus TCP [m]."""
    used: bool
    reason: str | None = None
    """Why it was not used."""

    @model_validator(mode="after")
    def _are_of_space(self) -> Self:
        """Check the arrays' sizes, which JSON Schema does not state."""
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


class HoldoutResult(_ResultPart):
    """Errors on poses that took no part in the estimate."""

    folds: int
    rms: float
    median: float
    p95: float
    figures: dict[str, float]
    """Everything else verify.holdout reports."""


class VerificationResult(_ResultPart):
    """Result of one verify step."""

    passed: bool
    reason: str
    figures: dict[str, float]
    errors: dict[str, float]
    """Error of each pose [m], by observation id."""
    advice: str = ""
    """The next step after a failure; empty if the verification knows none."""
    units: dict[str, str] = Field(default_factory=dict)
    """Unit of each figure: m, rad, share, relative (a ratio less 1), or empty for a number."""


class WorkspaceResult(_ResultPart):
    """Where the work is."""

    centre: PointList
    size: PointList


class ExpectedErrorResult(_ResultPart):
    """Expected error when the arm is sent to a scanned point."""

    rms: float
    """Root mean square over the work [m]."""
    p95: float
    """95 % of the errors are below [m]."""


class TransformErrorResult(_ResultPart):
    """Simulation only: true error of one transform."""

    rotation: float
    """[rad]"""
    translation: float
    """Error of the point its covariance is taken about [m]."""


class TruthResult(_ResultPart):
    """Simulation only: the calibration's true error."""

    base_T_camera: Matrix | None = None
    """The camera's true pose, if it is fixed in the base."""
    transforms: dict[str, Matrix] = Field(default_factory=dict)
    """True value of every unknown."""
    errors: dict[str, TransformErrorResult] = Field(default_factory=dict)
    """Error of every unknown, at the point about which its covariance is taken."""
    error_at_centroid: float
    """Error at the workspace's centre [m]."""
    rms_over_workspace: float
    """Rms error over the workspace box [m]."""
    rotation_error: float
    """[rad]"""
    at_work: float | None = None
    """For an arm with errors: rms distance, at poses not used, between the target's position by the
    camera and by the controller [m]. The correction of the circle's place is applied, if any."""
    at_work_corrected: float | None = None
    """The rms distance ``at_work`` for the corrected arm, with the camera's pose for that arm
    [m]."""


class SeamTruthResult(_ResultPart):
    """Simulation only: true error of the planned seam."""

    rms: float
    """Distance of the planned points from the true seam [m]."""
    max: float
    inside: float
    """Share of the planned points at which the true seam is inside the tube."""


class SeamResult(_ResultPart):
    """The planned seam, in the base."""

    source: str
    length: float
    """[m]"""
    points: Matrix
    """(N, 3) along the root of the groove [m]."""
    openings: Matrix
    """(N, 3) unit vectors towards the torch."""
    covariance: list[Matrix]
    """(N, 3, 3) of the points [m^2]."""
    tube: NumberList
    """(N,) radius about each point within which the seam is with 95 % probability [m]."""
    half_angle: float | None = None
    """Half angle of the groove [rad]."""
    half_width: float | None = None
    """Half width of the groove at its shoulders [m]."""
    figures: dict[str, float]
    """Report of the seam step."""
    notes: list[str]
    truth: SeamTruthResult | None = None


class WeldTruthResult(_ResultPart):
    """Simulation only: the torch's true distance across the seam, after the lead-in."""

    rms: float
    """[m]"""
    max: float


class WeldResult(_ResultPart):
    """Result of the weld."""

    mode: str
    completed: bool
    reason: str
    """Why it ended early; empty when it did not."""
    seconds: float
    """Time from the first cycle to the last."""
    correction_rms: float | None = None
    """Lateral distance from the plan to the measured seam [m]."""
    phases: dict[str, float]
    """Time in each phase of the controller [s]."""
    figures: dict[str, float]
    truth: WeldTruthResult | None = None


class FieldResult(_ResultPart):
    """A smooth displacement over the workspace; flangeye.maths.arm_correction evaluates it."""

    about: PointList
    """Middle of the calibration's poses, in the base [m]."""
    length: float
    """Correlation length of the field [m]."""
    weights: NumberList
    """Weights of the K features [m]."""


class CorrectionResult(_ResultPart):
    """Estimated errors of the arm, with which its poses can be corrected."""

    tool_offset: PointList
    """The circle's centre in the flange frame [m]."""
    joint_offsets: NumberList | None = None
    """Offsets to add to the joint angles [rad]."""
    joints: NumberList | None = None
    """A configuration on the branch of the arm that was calibrated [rad]."""
    lengths: Matrix | None = None
    """nx3, to add to each joint's a, d [m] and alpha [rad]."""
    field: FieldResult | None = None
    """Smooth displacement of the flange, to add to where the arm reports it."""


class AnswerResult(_ResultPart):
    """The pose for one arm: as its controller reports it, or corrected."""

    transforms: dict[str, TransformResult]
    correction: CorrectionResult | None = None
    """The arm correction that these poses require."""
    arms: dict[str, CorrectionResult] = Field(default_factory=dict)
    """The correction of each arm of a cell, by the arm's name."""
    expected_rms: float | None = None
    """Error to expect at the work, rms [m]."""
    holdout_rms: float | None = None
    """Error on held-out poses, over all of them [m]."""


class AnswersResult(_ResultPart):
    """The two answers, side by side: never mix the pose of one with the arm of the other."""

    as_reported: AnswerResult
    """Answer for the arm as its controller reports it."""
    corrected: AnswerResult | None = None
    """Answer for the arm with its error corrected; null if no error was found."""


class StageTiming(_ResultPart):
    """Duration of one step, without the steps it pulls from."""

    seconds: float
    calls: int
    idle: float | None = None
    """Share of a live session in which the arm stood still and no scan was exposed."""


class WarningResult(_ResultPart):
    """A warning, and what to do about it."""

    text: str
    """The mistake, in one line."""
    fix: str
    """A command, a line of the recipe, or what to do at the cell."""


class Provenance(_ResultPart):
    """Provenance of the result."""

    versions: dict[str, str]
    plugins: dict[str, str]
    recipe: str
    recipe_hash: str
    """SHA-256 of recipe.resolved.yaml."""
    input_hash: str
    """Hash of everything the captures are made from."""
    seed: int
    notes: list[str]
    """Notes of the source and the steps."""


class Result(_ResultPart):
    """The content of ``result.json``."""

    format: int = 1
    """Version of this contract."""
    title: str
    status: Literal["verified", "unverified", "refused", "incomplete"]
    """unverified: there was no verify step; incomplete: of a run that was killed."""
    refused: str | None = None
    """What is wrong, and how it is known."""
    advice: str = ""
    """The next step after a refusal; empty where none is known."""
    method: str | None = None
    """The solve step."""
    transforms: dict[str, TransformResult]
    """The best for the arm as its controller reports it."""
    correction: CorrectionResult | None = None
    """Where on the flange the circle is, if not at its origin."""
    answers: AnswersResult | None = None
    """The transforms for the arm as its controller reports it, and for the corrected arm."""
    expected_error: ExpectedErrorResult | None = None
    """The error to expect at the work, with the transforms for the arm as its controller reports
    it; null where the solver does not estimate it."""
    true: dict[str, TransformResult] = Field(default_factory=dict)
    """The transforms in the arm's true base, for metrology: their covariances include arm errors
    common to all poses."""
    observations: list[ObservationResult]
    workspace: WorkspaceResult | None = None
    holdout: HoldoutResult | None = None
    verifications: dict[str, VerificationResult]
    truth: TruthResult | None = None
    seam: SeamResult | None = None
    weld: WeldResult | None = None
    simulated: bool = False
    """The captures are simulated: no real cell has been calibrated."""
    warnings: list[WarningResult] = Field(default_factory=list)
    """Action to take, and the line that does it."""
    notes: list[str] = Field(default_factory=list)
    """Notes of the steps."""
    exports: dict[str, str] = Field(default_factory=dict)
    """Files written by export steps: name -> content."""
    timing: dict[str, StageTiming]
    provenance: Provenance

    @model_validator(mode="after")
    def _names_are_of_transforms(self) -> Self:
        """Check the names that exports write into other programs' files."""
        for name, found in self.transforms.items():
            Transform.named(name, found.matrix)
        return self

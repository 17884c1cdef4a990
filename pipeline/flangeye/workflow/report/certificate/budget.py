r"""The uncertainty of a point that the calibration maps, contribution by contribution.

The calibration's own uncertainty is that of six correlated quantities, a rotation
:math:`\varphi` and a translation :math:`\tau` about the point :math:`q` of ``result.json``. A
point :math:`p` is moved by :math:`\varphi \times (p - q) + \tau`, so the sensitivities are
:math:`-[p - q]_\times` and one. A user of the matrix has to add contributions that occur anew at
every point, such as the robot's repeatability.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Literal

import numpy as np

from flangeye.errors import StageError
from flangeye.maths.statistics import corners_of
from flangeye.models.scanners import ScannerModel
from flangeye.types import Floats
from flangeye.types.geometry import levers
from flangeye.workflow.result.contract import Result, TransformResult, WorkspaceResult


def propagated(sensitivities: Floats, standard: Floats, correlation: Floats) -> Floats:
    """Return the (m, m) covariance of m results of n inputs (GUM, equation 13).

    Args:
        sensitivities: (m, n) derivatives of the results by the inputs.
        standard: (n,) standard uncertainties of the inputs.
        correlation: (n, n) correlation matrix of the inputs.
    """
    scaled = np.asarray(sensitivities) * standard
    return np.asarray(scaled @ correlation @ scaled.T)


def correlation_of(covariance: Floats) -> tuple[Floats, Floats]:
    """Return standard uncertainties (n,) and correlations (n, n) of a covariance (n, n)."""
    standard = np.sqrt(np.diag(covariance))
    safe = np.where(standard > 0, standard, 1.0)
    correlation = covariance / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    return standard, np.asarray(correlation)


def effective_freedom(contributions: Floats, freedoms: Floats) -> float:
    """Return the degrees of freedom of a sum of independent parts (Welch-Satterthwaite, G.2b).

    Args:
        contributions: (n,) standard uncertainties of the parts, in the unit of the result.
        freedoms: (n,) degrees of freedom of each part; infinite for a known one.
    """
    fourth = float(np.sum(np.asarray(contributions) ** 4 / freedoms))
    total = float(np.sum(np.asarray(contributions) ** 2))
    return total**2 / fourth if fourth > 0 else float("inf")


def coverage_factor(freedom: float, probability: float = 0.95) -> float:
    """Return the coverage factor k for a coverage probability (Student's t)."""
    from scipy.special import ndtri, stdtrit

    upper = 0.5 * (1.0 + probability)
    return float(ndtri(upper) if np.isinf(freedom) else stdtrit(freedom, upper))


@dataclass(frozen=True)
class Conditions:
    """Ambient conditions stated by the user, as they are not measured.

    Attributes:
        temperature: Temperature of the air [°C], or None.
        spread: Difference between highest and lowest temperature during use [K], or None.
        place: Place of the calibration.
        operator: Name of the operator.
    """

    temperature: float | None = None
    spread: float | None = None
    place: str = ""
    operator: str = ""


@dataclass(frozen=True, eq=False)
class Contribution:
    """One row of a budget.

    Attributes:
        name: Name of the input quantity.
        kind: Type of evaluation: A from a series of measurements, B otherwise.
        standard: Standard uncertainty [rad or m].
        unit: ``rad`` or ``m``.
        sensitivity: (3,) derivative of the point's coordinates by it.
        freedom: Degrees of freedom; infinite for a known uncertainty.
        evidence: Source of the figure.
        bound: Whether no such error was detected; ``standard`` is then the detection limit.
    """

    name: str
    kind: Literal["A", "B"]
    standard: float
    unit: Literal["rad", "m"]
    sensitivity: Floats
    freedom: float
    evidence: str
    bound: bool = False

    @property
    def size(self) -> float:
        """Shift of the point by this contribution, one standard uncertainty [m]."""
        return float(np.linalg.norm(self.sensitivity) * self.standard)


@dataclass(frozen=True, eq=False)
class Budget:
    """Uncertainty budget of one point.

    Attributes:
        point: (3,) point in the parent frame [m].
        contributions: The input quantities.
        correlation: (n, n) among them.
    """

    point: Floats
    contributions: Sequence[Contribution]
    correlation: Floats

    @cached_property
    def covariance(self) -> Floats:
        """Covariance (3, 3) of the point [m^2]."""
        sensitivities = np.stack([c.sensitivity for c in self.contributions], axis=1)
        return propagated(sensitivities, self._standard, self.correlation)

    @property
    def standard(self) -> Floats:
        """Combined standard uncertainty (3,) along x, y, z [m]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def freedom(self) -> Floats:
        """Effective degrees of freedom (3,) along x, y, z."""
        freedoms = np.array([c.freedom for c in self.contributions])
        rows = np.stack([c.sensitivity * c.standard for c in self.contributions], axis=1)
        return np.array([effective_freedom(row, freedoms) for row in rows])

    @property
    def coverage(self) -> Floats:
        """Coverage factors k (3,) for 95 % along x, y, z."""
        return np.array([coverage_factor(f, 0.95) for f in self.freedom])

    @property
    def expanded(self) -> Floats:
        """Expanded uncertainties (3,) along x, y, z [m]."""
        return np.asarray(self.coverage * self.standard)

    @property
    def correlated(self) -> list[tuple[str, str, float]]:
        """Pairs of contributions correlated by more than 0.3, largest first."""
        names = [c.name for c in self.contributions]
        pairs = zip(*np.triu_indices(len(names), 1), strict=True)
        found = [(names[i], names[j], float(self.correlation[i, j])) for i, j in pairs]
        # Correlations larger than this are named
        return sorted((x for x in found if abs(x[2]) >= 0.3), key=lambda x: -abs(x[2]))

    @property
    def _standard(self) -> Floats:
        return np.array([c.standard for c in self.contributions])


def budget_of(result: Result) -> Budget:
    """Return the calibration's own budget at the least certain corner of the workspace.

    Raises:
        StageError: The run has no calibration, or the workspace is unknown.
    """
    _, estimate = _estimate_of(result)
    point = _worst_corner(result, estimate)
    standard, correlation = correlation_of(np.array(estimate.covariance))
    sensitivities = levers(point - np.array(estimate.about)).T
    evidence = _evidence(result)
    causes = product((("Rotation about", "rad"), ("Translation along", "m")), "xyz")
    return Budget(
        point,
        [
            Contribution(f"{what} {axis}", "A", u, unit, c, np.inf, evidence)  # type: ignore[arg-type]
            for ((what, unit), axis), c, u in zip(
                causes, sensitivities, standard.tolist(), strict=True
            )
        ],
        correlation,
    )


def use_budget_of(
    result: Result, scanner: ScannerModel | None, conditions: Conditions = Conditions()
) -> Budget:
    """Return the budget of one point that is scanned and then driven to."""
    calibration = budget_of(result)
    parts = [
        *_each_axis("Calibration", "A", calibration.standard, "the table above"),
        *_of_one_pose(result),
        *(_each_axis(*_distortion(scanner)) if scanner else ()),
        *(
            _each_axis(*_expansion(calibration.point, conditions.spread))
            if conditions.spread
            else ()
        ),
    ]
    correlation = np.eye(len(parts))
    correlation[:3, :3] = correlation_of(calibration.covariance)[1]
    return Budget(calibration.point, parts, correlation)


@dataclass(frozen=True)
class Share:
    """The part of the calibration's uncertainty at the work due to one cause.

    Attributes:
        cause: The cause.
        standard: Standard uncertainty due to it [m].
        evidence: Source of the figure.
    """

    cause: str
    standard: float
    evidence: str


def shares_of(result: Result) -> list[Share]:
    """Return the calibration's uncertainty by cause, largest first.

    Their squares add up to that of the budget: each cause's posterior variance by the estimator's
    own model, and the uncertainty of the causes' own sizes.
    """
    _, estimate = _estimate_of(result)
    motions = levers(_worst_corner(result, estimate) - np.array(estimate.about))

    def variance(covariance: Sequence[Sequence[float]]) -> float:
        return float(np.trace(motions @ np.array(covariance) @ motions.T))

    whole = variance(estimate.covariance)
    if not estimate.shares:
        return [Share("all causes", np.sqrt(max(whole, 0.0)), _evidence(result))]
    used = sum(o.used for o in result.observations)
    told = {cause: max(variance(share), 0.0) for cause, share in estimate.shares.items()}
    least = 0.01  # a cause with a smaller share of the variance is counted among the others
    rows = {cause: v for cause, v in told.items() if v >= least * whole}
    small, rest = sum(told.values()) - sum(rows.values()), whole - sum(told.values())
    shares = [Share(cause, np.sqrt(v), f"posterior of {used} poses") for cause, v in rows.items()]
    if small > 0:
        each = f"{len(told) - len(rows)} causes of less than {least:.0%} of the variance each"
        shares.append(Share("others", np.sqrt(small), each))
    if rest > 0:
        few = "the size of each cause is estimated from few poses"
        shares.append(Share("sizes of these causes", np.sqrt(rest), few))
    return sorted(shares, key=lambda share: -share.standard)


def _standard_error(variance: float, count: int) -> float:
    """Return the standard error of a variance estimated from ``count`` Gaussian values."""
    return variance * float(np.sqrt(2 / max(count, 1)))


def _estimate_of(result: Result) -> tuple[str, TransformResult]:
    found = next(iter(result.transforms.items()), None)
    if found is None:
        why = f": {result.refused}" if result.refused else ""
        raise StageError(f"the run gave no calibration, so there is nothing to certify{why}")
    return found


def _worst_corner(result: Result, estimate: TransformResult) -> Floats:
    if result.workspace is None:
        raise StageError("nothing says where the work is: give the recipe a 'workspace'")
    # The variance is a convex function of the place, so over a box it is largest at a corner
    corners, variances = _at_corners(result.workspace, estimate)
    return np.asarray(corners[int(variances.argmax())])


def _at_corners(box: WorkspaceResult, estimate: TransformResult) -> tuple[Floats, Floats]:
    """Return the corners of the workspace (8, 3), and the variance of the calibration at each."""
    corners = corners_of(np.array(box.centre), np.array(box.size))
    motions = levers(corners - np.array(estimate.about))
    return corners, np.einsum("nia,ab,nib->n", motions, np.array(estimate.covariance), motions)


def _evidence(result: Result) -> str:
    used = sum(o.used for o in result.observations)
    return f"{result.method or 'solver'}, {used} poses; covariance in result.json"


def _of_one_pose(result: Result) -> list[Contribution]:
    """Return the contribution of one scan at one pose, from errors on held-out poses."""
    held, box = result.holdout, result.workspace
    if held is None or box is None:
        return []
    poses = held.figures.get("poses", 0.0) - held.figures.get("outliers", 0.0)
    _, estimate = _estimate_of(result)
    own = _at_corners(box, estimate)[1].mean()
    # A smaller difference than the standard error of the held-out variance is not detected: then
    # that error is stated, as a bound
    hidden = _standard_error(held.rms**2, int(3 * poses))
    beyond = held.rms**2 - float(own)
    standard = np.sqrt(max(beyond, hidden) / 3)
    evidence = f"held-out error {held.rms * 1e3:.3f} mm rms, less the calibration's own part"
    rows = _each_axis("Arm and scan at one pose", "A", standard, evidence, 3 * poses)
    return [replace(row, bound=beyond < hidden) for row in rows]


def _distortion(scanner: ScannerModel) -> tuple[str, Literal["B"], float, str]:
    error = scanner.calibration_error
    evidence = f"{scanner.maker} {scanner.model}: {error * 1e3:g} mm rms over the volume"
    # The file states the rms of a distance: each axis has a third of its variance
    return "Scanner's smooth distortion", "B", error / np.sqrt(3), evidence


def _expansion(point: Floats, spread: float) -> tuple[str, Literal["B"], float, str]:
    # Of aluminium, of which most arms are made, per kelvin: larger than that of steel
    expansion = 23e-6
    half = expansion * float(np.linalg.norm(point)) * spread / 2
    evidence = f"{spread:g} K between extremes, {expansion * 1e6:g} µm/(m K), rectangular"
    # Half the width of a rectangular distribution over the root of 3 (GUM 4.3.7), then one axis
    return "Arm's thermal expansion", "B", half / np.sqrt(3) / np.sqrt(3), evidence


def _each_axis(
    name: str,
    kind: Literal["A", "B"],
    standard: float | Floats,
    evidence: str,
    freedom: float = np.inf,
) -> list[Contribution]:
    """Return a contribution that is independent along x, y and z, of one size or three."""
    return [
        Contribution(f"{name}, {axis}", kind, float(u), "m", unit, freedom or 1.0, evidence)
        for axis, u, unit in zip("xyz", np.broadcast_to(standard, 3), np.eye(3), strict=True)
    ]

"""What poses agree on given the errors they have in common, compared on poses held out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flangeye import CalibrationRefused
from flangeye.types import ArmCorrection
from flangeye_plugins.solving.consensus import Consensus
from flangeye_plugins.solving.equations import Fit, start_at
from flangeye_plugins.solving.evidence import Evidence, Nuisance

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

Agree = Callable[[Evidence, Nuisance], Consensus]
"""Finds the poses that agree, given the errors they have in common."""

FOLDS = 5
HELPFUL = 0.9
"""An error of the arm is kept when it brings the held-out error to this share or less."""


@dataclass(frozen=True, eq=False)
class Model:
    """The poses, the errors they have in common, and what they agree on.

    Attributes:
        evidence: The N poses, as the arm reports them or already corrected.
        nuisance: Errors common to all.
        found: What the poses agree on.
        correction: What of it is the arm's error.
        notes: For the person.
    """

    evidence: Evidence
    nuisance: Nuisance
    found: Consensus
    correction: ArmCorrection | None = None
    notes: tuple[str, ...] = ()

    def noted(self, note: str) -> Model:
        """Return the model with one more note."""
        return replace(self, notes=(*self.notes, note))

    @property
    def corrects_joints(self) -> bool:
        """Whether joint offsets are corrected."""
        return self.correction is not None and self.correction.joint_offsets is not None

    def residuals(self, fit: Fit | None = None) -> Floats:
        """Return the (N, 3) mapped centres minus where the flange is expected [m]."""
        fit = fit or self.found.fit
        expected = self.evidence.tcps + self.nuisance.moves @ fit.nuisance
        mapped = self.evidence.centres @ fit.rotation.T + fit.translation
        return np.asarray(mapped - expected)


def agreed(model: Model, agree: Agree) -> Model | None:
    """Return the model with what its poses agree on; None when no answer can be trusted."""
    try:
        return replace(model, found=agree(model.evidence, model.nuisance))
    except (CalibrationRefused, np.linalg.LinAlgError):
        return None


def better(model: Model, candidate: Model, agree: Agree, what: str) -> Model:
    """Return the candidate if it helps on poses held out, else the model; either says so."""
    kept = model.found.inliers
    before, after = (held_out_rms(m, agree, kept) for m in (model, candidate))
    compared = f"held-out error {after * 1e3:.3f} mm with it, {before * 1e3:.3f} mm without"
    if after > HELPFUL * before:
        return model.noted(f"left out, for it does not help: {what} ({compared})")
    return candidate.noted(f"{what} ({compared})")


def held_out_rms(model: Model, agree: Agree, kept: Mask) -> float:
    """Return the error on poses that took no part [m], over those that were kept without."""
    n = len(model.evidence)
    order = np.random.default_rng(0).permutation(n)
    errors = np.zeros((n, 3))
    for fold in range(FOLDS):
        out = np.isin(np.arange(n), order[fold::FOLDS])
        part = replace(
            model, evidence=model.evidence.where(~out), nuisance=model.nuisance.where(~out)
        )
        solved = agreed(part, agree)
        if solved is None:
            return float("inf")
        errors[out] = model.residuals(solved.found.fit)[out]
    return rms(errors[kept])


def information_with(model: Model, nuisance: Nuisance) -> Floats:
    """Return the Fisher information the agreeing poses have of pose and nuisances."""
    found = model.found
    kept, common = found.evidence.where(found.inliers), nuisance.where(found.inliers)
    fit = found.fit
    return start_at(fit.rotation, fit.translation, kept, common, fit.noise).information


def rms(errors: Floats) -> float:
    """Return the root mean square length of (N, 3) errors."""
    return float(np.sqrt((errors**2).sum(axis=1).mean()))

"""An answer at the sizes that are expected beforehand: quick, for planners and doctors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flangeye.estimation.effects.effect import Effect
from flangeye.estimation.estimate import judged, model_at
from flangeye.estimation.graph import Places, Problem
from flangeye.estimation.mixed import Fit, LinearModel, fit, left_out, told_of_places
from flangeye.estimation.observability import unobservable
from flangeye.estimation.session import Asked, effects_of
from flangeye.estimation.start import agreeing, begin
from flangeye.estimation.threads import on_one_thread
from flangeye.types import Floats, Mask


@dataclass(frozen=True, eq=False)
class Rough:
    """An answer without its sizes estimated.

    Attributes:
        problem: What was given.
        places: (4, 4) of each unknown.
        effects: What may be wrong.
        model: Near the places.
        fit: There.
        inliers: (N,) which sightings agree.
    """

    problem: Problem
    places: Places
    effects: Sequence[Effect]
    model: LinearModel
    fit: Fit
    inliers: Mask

    @property
    def errors(self) -> Floats:
        """(N, 6) leave-one-out residuals of each sighting [rad, m]."""
        return left_out(self.model, self.fit)[0]

    @property
    def covariance(self) -> Floats:
        """(P, P) of the places."""
        return self.fit.covariance[: self.model.p, : self.model.p]


@on_one_thread
def rough(problem: Problem, freedoms: Mapping[str, Floats] | None = None) -> Rough:
    """Return an answer.

    Raises:
        CalibrationRefused: Nothing gives a start, or the sightings leave something unknown.
    """
    places, squares = begin(problem)
    agree, effects = agreeing(problem, squares), effects_of(problem, None, Asked())
    for _ in range(2):
        model = model_at(problem, places, effects, agree.astype(float))
        found = fit(model, model.sizes.at(np.zeros(model.sizes.mix.shape[1])))
        places = problem.moved(places, found.mean[: model.p])
        agree = judged(model, found)[1] & agree
    known = told_of_places(model, found.sizes)
    # Largest standard deviations [rad, m] of what is known
    unobservable(
        problem.where(agree), places, known, (float(np.radians(2)), 20e-3), False, freedoms
    )
    return Rough(problem, places, effects, model, found, agree)

"""The session as it is, fitted once for all checks."""

from __future__ import annotations

from functools import lru_cache

from flangeye.doctor.diagnosis import Arms, RecordedSession
from flangeye_plugins.check.equations import equations_of
from flangeye_plugins.check.fitting import VariantFits, fit


@lru_cache(maxsize=2)
def fit_of(session: RecordedSession) -> VariantFits:
    """Return the best calibration of a session as it is; a session is known by its identity."""
    return fit(equations_of(session))


def named(arms: Arms, session: RecordedSession) -> str:
    """Return whose poses, as messages call them."""
    if session.seconds is None:
        return "the robot's"
    return {"both": "both arms'", "first": "the first arm's", "second": "the second arm's"}[arms]

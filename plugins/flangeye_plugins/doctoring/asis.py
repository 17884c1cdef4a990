"""The session as it is, fitted once for all checks."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flangeye.diagnosis import Session
from flangeye_plugins.doctoring.equations import Equations, equations_of, mounts_of
from flangeye_plugins.doctoring.fitting import Fit, fit

Floats = NDArray[np.float64]


@lru_cache(maxsize=2)
def fit_of(session: Session) -> Fit:
    """Return the best calibration of a session as it is; a session is known by its identity."""
    return fit(equations_of(session))


def variants(session: Session, poses: Floats) -> Equations:
    """Return the session with other robot poses (K, N, 4, 4)."""
    return equations_of(session).with_mounts(mounts_of(session, poses))

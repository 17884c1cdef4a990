"""``verify.drift``: compare a run's observations with an earlier calibration of the same cell."""

from typing import ClassVar

import numpy as np

from flangeye import Params, stage
from flangeye.files.paths import RecipeFile
from flangeye.types import HandEye, Verification
from flangeye.units import Length, param
from flangeye.workflow.doctor.monitor.stored import stored_calibration


class DriftParams(Params):
    """Parameters of ``verify.drift``."""

    reference: RecipeFile
    """The run.mcap of the earlier calibration."""
    limit: Length = param("0.4 mm", gt=0)
    """Largest shift at the work that passes."""
    # Probability that a cell that did not move is refused
    false_alarms: ClassVar[float] = 2e-4


@stage("verify.drift")
def verify_drift(calibration: HandEye, params: DriftParams) -> Verification:
    """Check whether the scanner still has the pose of an earlier calibration.

    The observations of this run are compared with the earlier pose and its covariance. The check
    fails if the cell has moved, which stops a robot program that uses the old matrix; this run's
    matrix is the new one to use. ``flangeye monitor`` does the same for a series of checks and
    keeps their history.

    The figures are ``shift``, of the work at its worst corner [m]; ``turn``, of the scanner [rad];
    and ``statistic``, the likelihood ratio over its threshold.

    Raises:
        StageError: The reference has no calibration of a camera beside a robot.
    """
    stored = stored_calibration(params.reference)
    seen = [pair.observation for pair in calibration.pairs if pair.used]
    found = stored.drift(seen, params.limit, params.false_alarms)
    shift = f"{found.shift * 1e3:.2f} mm at the work's worst corner"
    figures = {
        "shift": found.shift,
        "turn": float(np.linalg.norm(found.motion[:3])),
        "statistic": found.statistic,
    }
    units = {"shift": "m", "turn": "rad", "statistic": ""}
    if found.state == "OK":
        still = f"scanner and arm are where {stored.path} found them"
        return Verification(True, still, figures, units=units)
    return Verification(
        False, f"the cell has moved since {stored.path}, by {shift}", figures, units=units,
        advice="put the scanner back; or take verify.drift out of the recipe and use the new pose",
    )  # fmt: skip

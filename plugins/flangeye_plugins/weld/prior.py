"""A file that passes estimates of tip, play and clock from one weld to the next.

The sweep at the start of a weld uses them as its prior instead of the finger's file, and gives
smaller uncertainties. The file is YAML; delete it after a change of finger or camera. An earlier
weld's information counts half (its variance is doubled): many weak estimates cannot add up to false
certainty, and a slowly creeping tip is tracked.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import yaml

from flangeye.errors import StageError
from flangeye.files.regular import write_whole
from flangeye.models.model import Model, read_model
from flangeye.units import Duration, Length, param
from flangeye_plugins.weld.following.model_prior import ModelPrior, SweepFit


class WeldPrior(Model):
    """Estimates of one weld, used as the prior of the next, with standard deviations."""

    finger: str
    ahead: Length
    """Distance of the tip ahead of its place in the finger's file."""
    ahead_sigma: Length = param(gt=0)
    play: Length
    """Half the width of play and hysteresis."""
    play_sigma: Length = param(gt=0)
    stamp: Duration
    """Delay of the images' timestamps."""
    stamp_sigma: Duration = param(gt=0)


def with_prior(prior: ModelPrior, path: Path | None, finger: str) -> ModelPrior:
    """Return a prior updated by the file of earlier welds; unchanged if there is no file yet.

    Raises:
        StageError: The file belongs to another finger.
        RecipeError: The file is not a valid prior.
    """
    if path is None or not path.exists():
        return prior
    stored = read_model(path, WeldPrior)
    if stored.finger != finger:
        raise StageError(
            f"weld.tactile: {path} is of finger {stored.finger}, this one is {finger}; delete the "
            "file, or name another one (prior)"
        )
    found = stored.model_dump(exclude={"finger"})
    # Half the information means twice the variance
    aged = {name: math.sqrt(2) * x for name, x in found.items() if name.endswith("_sigma")}
    return replace(prior, **{**found, **aged})


def keep_posterior(path: Path, finger: str, learned: SweepFit) -> None:
    """Write a weld's estimates to the file for the next weld.

    Raises:
        StageError: The file cannot be written.
    """
    found = {
        "ahead": learned.ahead, "ahead_sigma": learned.ahead_sigma,
        "play": learned.width, "play_sigma": learned.width_sigma,
    }  # fmt: skip
    content = {"finger": finger, **{name: f"{x * 1e3:.6g} mm" for name, x in found.items()}}
    content["stamp"] = f"{learned.stamp * 1e3:.6g} ms"
    content["stamp_sigma"] = f"{learned.stamp_sigma * 1e3:.6g} ms"
    head = "# Found by weld.tactile; its next weld starts from here. Delete it to begin anew.\n"
    write_whole(path, head + yaml.safe_dump(content, sort_keys=False))

"""A cell's covariance holds for arms whose joints are not where their controllers say."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from flangeye.files.bundled import bundled
from flangeye.handeye.calibration import TYPICAL_ARM
from flangeye.handeye.cell import _notes, calibrate_cell, size_of_zeros, solve_cell
from flangeye.handeye.graph import LIMITS
from flangeye.maths.geometry import rotation_log
from flangeye.models.cell import Cell
from flangeye.plugin.registry import load_registry
from flangeye.recipe.load import load_recipe
from flangeye.run.runner import Runner
from flangeye.types import ArchivePath

REGISTRY = load_registry()
TWO = bundled("recipes") / "configurations" / "two-scanners_marker_most-likely_simulated.yaml"
SEEDS = 5


def squares(seed: int, zeros: str = "0.2 mrad") -> Any:
    """Return of both cameras how far off they are, in units of what is stated: with zeros, without."""
    recipe = load_recipe(TWO, REGISTRY, [f"seed={seed}", f"steps.0.arm={{zeros: {zeros}}}"])
    seen = Runner(recipe, REGISTRY, ArchivePath(None)).take(None)
    cell, places = recipe.context[Cell], recipe.steps[0].params.places
    bare = solve_cell(seen, cell, LIMITS)
    told = calibrate_cell(seen, cell, LIMITS, "solve.cell").transforms
    for camera in ("left", "right"):
        found, true = bare.places[camera], places[camera].matrix
        about = told[f"base_T_{camera}"].about
        turn = rotation_log(found[:3, :3] @ true[:3, :3].T)
        off = np.concatenate([turn, found[:3, 3] - true[:3, 3]])
        moved = np.concatenate([turn, off[3:] + np.cross(turn, about - found[:3, 3])])
        covariances = told[f"base_T_{camera}"].covariance, bare.covariances[camera]
        yield [e @ np.linalg.solve(c, e) for e, c in zip((moved, off), covariances, strict=True)]


def test_what_joint_zeros_may_be_off_by_is_in_the_covariance() -> None:
    """UR5s with zeros as large as their file says; a sound covariance has a mean square of six."""
    considered, bare = np.array([s for seed in range(SEEDS) for s in squares(seed)]).T
    assert bare.mean() > 12
    assert 3 < considered.mean() < 10
    assert (considered < 12.6).mean() >= 0.8  # the 95 % region


def test_the_covariance_holds_for_an_arm_far_worse_than_its_file_says() -> None:
    """Zeros of 2 mrad, as real arms have them: ten times what the UR5's file says."""
    considered, bare = np.array([s for seed in range(SEEDS) for s in squares(seed, "2 mrad")]).T
    assert bare.mean() > 100
    assert 3 < considered.mean() < 10
    assert (considered < 12.6).mean() >= 0.8


def test_the_size_of_zeros_is_the_one_that_made_the_errors() -> None:
    rng = np.random.default_rng(0)
    rows, zeros = rng.normal(size=(40, 6, 6)), rng.normal(size=(40, 6, 20))
    noise, drawn = rng.normal(size=(40, 6)), rng.normal(size=20)
    assert size_of_zeros(rows, zeros, noise, 240.0) == (1.0, 1.0)
    size, share = size_of_zeros(rows, zeros, (noise + 8 * zeros @ drawn) / 2, 240.0)
    assert 2.5 < size < 6  # four
    assert 0.15 < share < 0.4  # a quarter


def test_the_noise_of_what_moves_is_told_in_millimetres_and_degrees() -> None:
    found: Any = SimpleNamespace(movers=4.0)  # twice what is typical
    _, note = _notes([], found, 1.0)
    shift, turn = 2e3 * TYPICAL_ARM.translation, 2.0 * np.degrees(TYPICAL_ARM.rotation)
    assert f"{shift:.3f} mm and {turn:.3f} deg per axis" in note

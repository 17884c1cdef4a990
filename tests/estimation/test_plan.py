"""The next sighting of a cell is the one that shrinks the whole graph's uncertainty most."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.estimation.plan import _moved, best_next, estimate_so_far, predict
from flangeye.files.paths import bundled
from flangeye.models.cell import Cell
from flangeye.plugin.registry import load_registry
from flangeye.types import ArchivePath, CircleFeature
from flangeye.types.geometry import rigid, rotation_exp
from flangeye.workflow.recipe.load import load_recipe
from flangeye.workflow.run.folder import RunFolder
from flangeye.workflow.run.runner import Runner
from flangeye.workflow.run.session import Start, record_run
from tools.study_cells import errors_at_work

REGISTRY = load_registry()
TWO = bundled("recipes") / "configurations" / "two-scanners_marker_most-likely_simulated.yaml"


def recipe(*overrides: str) -> Any:
    return load_recipe(TWO, REGISTRY, overrides)


@pytest.fixture(scope="module")
def session() -> Any:
    """The cell, eight sightings by the left scanner and six by the right, and many more."""
    checked = recipe("steps.0.sightings=80")
    seen = Runner(checked, REGISTRY, ArchivePath(None)).take(None)
    left, right = ([o for o in seen if o.camera == name] for name in ("left", "right"))
    return checked.context[Cell], [*left[:20], *right[:6]], [*left[20:], *right[6:]]


def test_the_choice_is_the_one_after_which_least_is_left_unknown(session: Any) -> None:
    """Against what solving again with each candidate states; the scanner that saw less is first."""
    cell, seen, candidates = session
    found = estimate_so_far(seen, cell)
    assert found is not None

    def left(candidate: Any) -> float:
        both = [*seen, candidate]
        with_it = estimate_so_far(both, cell)
        assert with_it is not None
        return sum(e**2 for e in errors_at_work(with_it, cell, seen).values())

    some = candidates[::5]
    expected = [predict([o], found.places, cell)[0] for o in some]
    chosen = best_next(expected, found, cell, seen)
    assert some[chosen].camera == "right"
    states = np.array([left(o) for o in some])
    assert states[chosen] <= np.quantile(states, 0.25)


def test_a_run_ends_when_enough_was_seen(tmp_path: Any) -> None:
    """What is stated then is what was required; a plain run takes every sighting."""
    checked = recipe("steps.0.plan=next_best", "steps.0.sightings=40", "steps.1.required=1.2 mm")
    folder = RunFolder.create("run", tmp_path / "run")
    result = record_run(checked, REGISTRY, folder, Start(), report=False)
    assert result.status == "verified"
    assert 6 <= len(result.observations) < 40
    assert result.expected_error.p95 < 1.2e-3
    assert {o.camera for o in result.observations} == {"left", "right"}


def test_a_circle_is_foreseen_with_its_normal_known_as_well_across_it() -> None:
    pose = rigid(rotation_exp([0.4, -0.3, 0.2]), [0.1, -0.2, 0.7])
    own, across = 1e-8 * np.eye(3), np.diag([3e-6, 3e-6, 0.0])
    like = CircleFeature(np.zeros(3), np.array([0, 0, 1.0]), {"rim": 0.03}, own, across, 1.0)
    moved: Any = _moved(like, pose)
    assert moved.centre == pytest.approx(pose[:3, 3])
    assert moved.normal == pytest.approx(pose[:3, 2])
    turned = pose[:3, :3] @ across @ pose[:3, :3].T
    assert moved.normal_covariance == pytest.approx(turned, abs=1e-18)
    assert np.array_equal(moved.covariance, own) and moved.radii == {"rim": 0.03}
    bare: Any = _moved(replace(like, normal=None, normal_covariance=None), pose)
    assert bare.centre == pytest.approx(pose[:3, 3]) and bare.normal is None

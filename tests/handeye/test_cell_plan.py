"""The next sighting of a cell is the one that shrinks the whole graph's uncertainty most."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from flangeye.files.bundled import bundled
from flangeye.handeye import cell_plan
from flangeye.handeye.cell import solve_cell
from flangeye.handeye.cell_plan import (
    _moved,
    errors_at_work,
    foreseen,
    is_foretold,
    most_telling,
    work_of_frames,
)
from flangeye.handeye.graph import LIMITS
from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.maths.statistics import largest_error_quantile
from flangeye.models.cell import Cell
from flangeye.plugin.registry import load_registry
from flangeye.recipe.load import load_recipe
from flangeye.run.folder import RunFolder
from flangeye.run.runner import Runner
from flangeye.run.session import Start, record_run
from flangeye.types import ArchivePath, CircleFeature, Transform

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
    found = solve_cell(seen, cell, LIMITS)

    def left(candidate: Any) -> float:
        errors = errors_at_work(
            solve_cell([*seen, candidate], cell, LIMITS, found.places), cell, seen
        )
        return sum(e**2 for e in errors.values())

    some = candidates[::5]
    expected = [foreseen([o], found, cell)[0] for o in some]
    chosen = most_telling(expected, found, cell, seen)
    assert some[chosen].camera == "right"
    states = np.array([left(o) for o in some])
    assert states[chosen] <= np.quantile(states, 0.25)


def test_a_sighting_that_is_wrong_is_not_foretold(session: Any) -> None:
    cell, seen, candidates = session
    found = solve_cell(seen, cell, LIMITS)
    assert np.mean([is_foretold(o, found, cell) for o in candidates]) > 0.95
    (o, *_) = candidates
    pose = o.feature.camera_T_target
    off = rigid(rotation_exp([0.02, 0, 0]), [0.01, 0, 0]) @ pose.matrix
    moved = replace(o.feature, camera_T_target=Transform(pose.parent, pose.child, off))
    assert not is_foretold(replace(o, feature=moved), found, cell)


def test_a_run_ends_when_enough_was_seen(tmp_path: Any) -> None:
    """What is stated then is what was required; a plain run takes every sighting."""
    checked = recipe("steps.0.plan=next_best", "steps.0.sightings=40", "steps.1.required=0.35 mm")
    folder = RunFolder.create("run", tmp_path / "run")
    result = record_run(checked, REGISTRY, folder, Start(), report=False)
    assert result.status == "verified"
    assert 6 < len(result.observations) < 40
    assert result.truth.rms_over_workspace < 0.35e-3
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


@pytest.mark.parametrize("seed", range(8))
def test_the_most_telling_leaves_the_least_error_at_the_work(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the information says that each adds to what is known."""
    rng = np.random.default_rng(seed)
    nothing: Any = None
    half, levers, rows = (
        rng.normal(size=(9, 5)),
        rng.normal(size=(3, 5)),
        rng.normal(size=(9, 6, 5)),
    )
    known, some = np.linalg.inv(half.T @ half), SimpleNamespace(joint=np.linalg.inv(half.T @ half))
    monkeypatch.setattr(cell_plan, "_rows", lambda *_: (rows, nothing))
    monkeypatch.setattr(cell_plan, "_levers", lambda *_: levers)
    left = [np.linalg.inv(np.linalg.inv(known) + r.T @ r) for r in rows]
    expected = int(np.argmin([np.trace(levers @ each @ levers.T) for each in left]))
    asked: Any = [nothing, some, nothing, nothing]
    assert most_telling(*asked) == expected


POSE = rigid(rotation_exp([0.3, -0.2, 0.5]), np.array([0.4, 0.2, 0.9]))
OTHER = rigid(rotation_exp([-0.1, 0.4, 0.2]), np.array([-0.3, 0.1, 0.2]))


def two_frames() -> tuple[Any, list[Any]]:
    """Return where a camera and a plate are known to be, and what the camera saw."""
    rng = np.random.default_rng(3)
    blocks = {n: 1e-8 * (r.T @ r) for n, r in zip(("left", "plate"), rng.normal(size=(2, 9, 6)),
                                                  strict=True)}  # fmt: skip
    found = SimpleNamespace(places={"left": POSE, "plate": OTHER}, covariances=blocks)
    seen = [
        SimpleNamespace(camera=camera, feature=SimpleNamespace(centre=np.array(centre)))
        for camera, centre in (
            ("left", [0.1, 0, 1.0]),
            ("left", [0, 0.2, 0.8]),
            ("right", [9, 9, 9]),
        )
    ]
    return found, seen


def test_a_camera_works_where_it_saw_something_and_what_it_saw_within_a_tenth_of_a_metre() -> None:
    found, seen = two_frames()
    nothing: Any = None
    work = work_of_frames(found, nothing, seen)
    points = np.array([[0.1, 0, 1.0], [0, 0.2, 0.8]])
    assert work["left"] == pytest.approx(points @ POSE[:3, :3].T + POSE[:3, 3])
    corners = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])
    wanted = corners @ OTHER[:3, :3].T + OTHER[:3, 3]
    assert sorted(map(tuple, work["plate"].round(9))) == sorted(map(tuple, wanted.round(9)))
    errors = errors_at_work(found, nothing, seen)
    for name, place in found.places.items():
        told = largest_error_quantile(found.covariances[name], place[:3, 3], work[name])
        assert errors[name] == pytest.approx(told)


def test_the_work_moves_with_each_frame_and_each_counts_alike() -> None:
    """As its points do by small turns about its origin, in its parent, and shifts."""
    found, seen = two_frames()
    nothing: Any = None
    work, step = work_of_frames(found, nothing, seen), 1e-6
    levers = cell_plan._levers(found, nothing, seen)
    at = 0
    for i, (name, points) in enumerate(work.items()):
        origin, count = found.places[name][:3, 3], len(points)
        part = levers[at : at + 3 * count].reshape(count, 3, 12) * np.sqrt(count)
        at += 3 * count
        for k in range(6):
            turn, shift = rotation_exp(step * np.eye(6)[k, :3]), step * np.eye(6)[k, 3:]
            moved = (points - origin) @ turn.T + origin + shift
            assert part[:, :, 6 * i + k] == pytest.approx((moved - points) / step, abs=1e-5)
        assert not part[:, :, 6 * (1 - i) : 6 * (2 - i)].any()
    assert at == len(levers)


@pytest.mark.parametrize(("share", "told"), [(0.99, True), (1.01, False)])
def test_one_good_sighting_in_a_thousand_is_not_foretold(
    share: float, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its own noise and what is known of the places add up."""
    rng, nothing = np.random.default_rng(0), None
    rows, half, way = rng.normal(size=(6, 4)), rng.normal(size=(4, 7)), rng.normal(size=6)
    spread = np.eye(6) + rows @ half @ half.T @ rows.T
    size = np.sqrt(share * stats.chi2(6).ppf(0.999) / (way @ np.linalg.solve(spread, way)))
    monkeypatch.setattr(cell_plan, "_rows", lambda *_: (rows[None], size * way[None]))
    found: Any = SimpleNamespace(joint=half @ half.T)
    some: Any = nothing
    assert is_foretold(some, found, some) == told

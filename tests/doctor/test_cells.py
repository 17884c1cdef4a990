"""The doctor on cells: each mistake put into a sound session with a bad arm, and named."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from flangeye.cli import commands
from flangeye.doctor.cells import _moved, _scaled, _seen, examine_cell
from flangeye.files.paths import bundled
from flangeye.maths.geometry import invert, rigid, rotation_exp
from flangeye.models.cell import Cell, Link
from flangeye.plugin.registry import load_registry
from flangeye.recipe.load import load_recipe
from flangeye.run.runner import Runner
from flangeye.types import ArchivePath, CircleFeature, Observation, Transform

REGISTRY = load_registry()
Session = tuple[Sequence[Observation], Cell]
Mistake = Callable[[Sequence[Observation], Cell], Session]


@cache
def session(name: str, seed: int = 0, arm: str = "quality: real") -> Session:
    path = bundled("recipes") / "configurations" / f"{name}_marker_most-likely_simulated.yaml"
    recipe = load_recipe(path, REGISTRY, [f"seed={seed}", f"steps.0.arm={{{arm}}}"])
    return Runner(recipe, REGISTRY, ArchivePath(None)).take(None), recipe.context[Cell]


def inverted(seen: Sequence[Observation], cell: Cell) -> Session:
    return [_seen(o, invert) if o.camera == cell.cameras[0] else o for o in seen], cell


def in_millimetres(seen: Sequence[Observation], cell: Cell) -> Session:
    of = cell.cameras[0]
    return [_seen(o, lambda x: _scaled(x, 1e3)) if o.camera == of else o for o in seen], cell


def arm_inverted(seen: Sequence[Observation], cell: Cell) -> Session:
    name = next(iter(cell.movers))
    return [_moved(o, {name: invert(o.poses[name].matrix)}) for o in seen], cell


def arm_in_millimetres(seen: Sequence[Observation], cell: Cell) -> Session:
    name = next(iter(cell.movers))
    return [_moved(o, {name: _scaled(o.poses[name].matrix, 1e3)}) for o in seen], cell


def mounted_elsewhere(seen: Sequence[Observation], cell: Cell) -> Session:
    name = cell.cameras[-1]
    frame = replace(cell.frames[name], parent=next(iter(cell.movers)))
    return seen, replace(cell, frames={**cell.frames, name: frame})


def mispaired(seen: Sequence[Observation], cell: Cell) -> Session:
    other = replace(seen[3], poses=seen[8].poses, arm_joints=seen[8].arm_joints)
    return [other if i == 3 else o for i, o in enumerate(seen)], cell


def swapped(seen: Sequence[Observation], cell: Cell) -> Session:
    one, two = cell.movers
    return [
        _moved(o, {one: o.poses[two].matrix, two: o.poses[one].matrix}) for o in seen
    ], cell  # fmt: skip


MISTAKES: list[tuple[Mistake, str, str]] = [
    (inverted, "inverted marker", "sightings: [{camera: left, target: marker, pose: target_T_camera}]"),
    (in_millimetres, "unit", "sightings: [{camera: left, target: marker, length: mm}]"),
    (arm_inverted, "inverted pose", "arms: {arm: {pose: flange_T_base}}"),
    (arm_in_millimetres, "unit", "arms: {arm: {length: mm}}"),
    (mounted_elsewhere, "mounting", "cell: {cameras: {right: {on: base}}}"),
    (mispaired, "mis-paired pose", "- acquire.samples: {leave_out: [0003-right-marker]}"),
]  # fmt: skip


@pytest.mark.parametrize(("mistake", "name", "fix"), MISTAKES)
def test_each_mistake_is_named_with_the_line_that_cures_it(
    mistake: Mistake, name: str, fix: str
) -> None:
    (finding,) = examine_cell(*mistake(*session("two-scanners"))).findings
    assert (finding.name, finding.fix) == (name, fix)


def centres_of_a_table() -> Session:
    """Return centres of the flange that two scanners beside an arm saw, as tables have them."""
    path = bundled("recipes") / "configurations" / "two-scanners_flange_most-likely_simulated.yaml"
    cell = load_recipe(path, REGISTRY).context[Cell]
    rng = np.random.default_rng(0)
    seen = []
    for camera in cell.cameras:
        stands = rigid(rotation_exp(rng.normal(0, 0.5, 3)), np.array([0.5, 0.0, -0.6]))
        for i in range(12):
            turn, place = rotation_exp(rng.normal(0, 0.4, 3)), rng.uniform(-0.2, 0.2, 3)
            pose = rigid(turn, np.array([0.5, 0.0, 0.3]) + place)
            centre = (invert(stands) @ pose)[:3, 3] + rng.normal(0, 1e-4, 3)
            feature = CircleFeature(centre, None, {}, 1e-8 * np.eye(3), None, 1.0)
            at = {"arm": Transform("arm_base", "arm", pose)}
            seen.append(Observation(f"{i}-{camera}", feature, at, camera=camera, target="flange"))
    return seen, cell


def test_centres_of_a_table_in_another_unit_are_named() -> None:
    seen, cell = centres_of_a_table()
    assert examine_cell(seen, cell).findings == ()
    (finding,) = examine_cell(*in_millimetres(seen, cell)).findings
    name = cell.cameras[0]
    assert finding.what == f"what {name} saw of flange is in mm"
    assert finding.fix == f"sightings: [{{camera: {name}, target: flange, length: mm}}]"


def on_the_wrong_link(link: str) -> Session:
    """Return a session of a camera on the forearm that the recipe has elsewhere on the arm."""
    seen, cell = session("forearm-and-wall")
    cell = cell.with_links([Link("arm", 2)])
    frame = replace(cell.frames["forearm"], parent=link)
    return seen, replace(cell, frames={**cell.frames, "forearm": frame})


@pytest.mark.parametrize("link", [pytest.param("arm", marks=pytest.mark.slow), "arm_link2"])
def test_a_camera_on_another_link_is_named(link: str) -> None:
    (finding,) = examine_cell(*on_the_wrong_link(link)).findings
    assert finding.what == f"forearm stands on arm_link3, not on {link}"
    assert finding.fix == "cell: {cameras: {forearm: {on: arm, link: 3}}}"


def test_nothing_is_named_in_a_sound_session_of_a_bad_arm() -> None:
    assert not examine_cell(*session("two-scanners", seed=1)).findings


def test_nothing_is_named_where_no_cure_helps() -> None:
    seen, cell = session("two-scanners")
    rng = np.random.default_rng(0)
    anywhere = [
        _seen(o, lambda _: rigid(rotation_exp(rng.normal(size=3)), rng.normal(size=3)))
        for o in seen[::2]
    ]
    assert not examine_cell(anywhere, cell).findings


def test_the_command_examines_the_log_of_a_cell(tmp_path: Path) -> None:
    out = tmp_path / "run"
    name = "configurations/two-scanners_marker_most-likely_simulated"
    assert CliRunner().invoke(commands(), ["run", name, "--out", str(out)]).exit_code == 0
    told = CliRunner().invoke(commands(), ["doctor", str(out)])
    assert told.exit_code == 0, told.output
    assert "40 of 40 samples" in told.output
    assert "nothing found" in told.output


def test_what_the_recipe_states_wrongly_is_put_right(tmp_path: Path) -> None:
    name, recorded = "configurations/arm-on-rail_marker_most-likely_simulated", tmp_path / "tables"
    assert (
        CliRunner().invoke(commands(), ["run", name, "--out", str(tmp_path / "run")]).exit_code == 0
    )
    told = CliRunner().invoke(
        commands(), ["export", str(tmp_path / "run"), "--to", "tables", "--out", str(recorded)]
    )
    assert told.exit_code == 0
    recipe = recorded / "recipe.yaml"
    table = "          file: second_marker.csv\n"
    text = recipe.read_text()
    assert table in text
    recipe.write_text(text.replace(table, f"{table}          pose: target_T_camera\n"))
    told = CliRunner().invoke(commands(), ["doctor", str(recipe)])
    assert told.exit_code == 1
    fix = "fix: sightings: [{camera: second, target: marker, pose: camera_T_target}]"
    assert fix in told.output


@pytest.mark.slow
@pytest.mark.parametrize(
    "cell", ["hand-and-wall", "arm-on-rail", "two-arms-three-scanners", "forearm-and-wall"]
)
@pytest.mark.parametrize("seed", range(3))
def test_mistakes_are_named_in_every_cell(cell: str, seed: int) -> None:
    sound = session(cell, seed)
    assert not examine_cell(*sound).findings
    wanted = {mistake: name for mistake, name, _ in MISTAKES}
    if cell == "two-arms-three-scanners":
        wanted[swapped] = "swapped arms"
    for mistake, name in wanted.items():
        assert [f.name for f in examine_cell(*mistake(*sound)).findings] == [name], mistake

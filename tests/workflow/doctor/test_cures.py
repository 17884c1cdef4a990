"""The line that a finding gives, put into the recipe, cures: the calibration is as if nothing was."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from flangeye.errors import FlangeyeError
from flangeye.maths.pose_corrections import inverted, reread, scaled, shifted, transposed
from flangeye.plugin.registry import load_registry
from flangeye.types import ArchivePath
from flangeye.types.geometry import rotation_exp, rotation_log
from flangeye.workflow.doctor.diagnosis import RecordedSession, examine
from flangeye.workflow.doctor.opening import open_session
from flangeye.workflow.recipe.load import load_recipe
from flangeye.workflow.run.runner import Runner
from flangeye_plugins.check import CHECKS
from tests.workflow.doctor.sessions import clean
from tools import injected

REGISTRY = load_registry()
N = 24

RECIPE: dict[str, Any] = {
    "title": "Samples",
    "robot": {"model": "ur5e"},
    "configuration": {"name": "eye-on-base", "place": "unknown"},
    "steps": [
        {"acquire.samples": {"reader": "moveit", "position_noise": "0.3 mm"}},
        "solve.robust",
    ],
}


def on_poses(change):
    return lambda session: session.with_poses(change(session.poses))


def on_markers(change):
    def plant(session):
        poses = np.tile(np.eye(4), (len(session), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = session.rotations, session.centres
        changed = change(poses)
        return replace(session, rotations=changed[:, :3, :3], centres=changed[:, :3, 3])

    return plant


def on_rows(rows, **changes):
    """Change what was seen, or reported, in some rows."""

    def plant(session):
        given = {name: np.array(getattr(session, name)) for name in changes}
        for name, change in changes.items():
            given[name][rows] = change(given[name][rows])
        return replace(session, **given)

    return plant


def late(session):
    poses, known = shifted(session.poses, 1)
    return session.with_poses(poses).where(known)


def late_from_the_middle(session):
    poses, known = shifted(session.poses, 1, N // 2)
    return session.with_poses(poses).where(known)


HALF_TURN = rotation_exp(np.array([np.pi, 0.0, 0.0]))
FAULTS = {
    "metres as millimetres": ("unit", on_poses(lambda p: scaled(p, 1e-3))),
    "millimetres as metres": ("unit", on_poses(lambda p: scaled(p, 1e3))),
    "inches as metres": ("unit", on_poses(lambda p: scaled(p, 1 / 25.4e-3))),
    "the marker in inches": ("unit", lambda s: replace(s, centres=s.centres / 25.4e-3)),
    "wxyz as xyzw": ("pose convention", on_poses(lambda p: reread(p, "wxyz", "xyzw"))),
    "ZYX as xyz": ("pose convention", on_poses(lambda p: reread(p, "ZYX", "xyz"))),
    "vectors as ZYX": ("pose convention", on_poses(lambda p: reread(p, "vector", "ZYX"))),
    "markers' wxyz as xyzw": ("pose convention", on_markers(lambda p: reread(p, "wxyz", "xyzw"))),
    "markers transposed": ("pose direction", on_markers(transposed)),
    "the base in the flange": ("pose direction", on_poses(inverted)),
    "transposed": ("pose direction", on_poses(transposed)),
    "shifted by one": ("shifted poses", late),
    "shifted from the middle": ("shifted poses", late_from_the_middle),
    "backwards": ("poses backwards", on_poses(lambda p: p[::-1])),
    "flips": ("target flips", on_rows([3, 9, 15], rotations=lambda r: r @ HALF_TURN)),
    "an outlier": ("outlier", on_rows([7], centres=lambda c: c + 0.05)),
    "identities of the robot": ("identity matrices", on_rows([2, 5], poses=lambda p: 0 * p + np.eye(4))),
    "identities of the marker": (
        "identity matrices",
        on_rows([2, 5], centres=lambda c: 0 * c, rotations=lambda r: 0 * r + np.eye(3)),
    ),
    "a moved target": (
        "moved target", on_rows(np.arange(14, N), centres=lambda c: c + [0.02, 0.0, 0.01]),
    ),
}  # fmt: skip
HARMLESS = {
    "identities of the marker", "identities of the robot", "an outlier", "flips", "a moved target",
}  # fmt: skip
"""Those that the solver sets aside by itself."""


def write(path, session: RecordedSession):
    """Write samples as MoveIt does, not a number of them rounded."""
    path.mkdir()
    seen = np.tile(np.eye(4), (len(session), 1, 1))
    seen[:, :3, :3], seen[:, :3, 3] = session.rotations, session.centres
    samples = [
        {"effector_wrt_world": p.ravel().tolist(), "object_wrt_sensor": s.ravel().tolist()}
        for p, s in zip(session.poses, seen, strict=True)
    ]
    (path / "samples.yaml").write_text(yaml.safe_dump(samples))
    return path


def recipe_with(path, step):
    path.write_text(json.dumps({**RECIPE, "steps": [step, RECIPE["steps"][1]]}))
    return load_recipe(path, REGISTRY)


def calibrated(recipe, archive):
    """Return base_T_camera, None where it is refused."""
    try:
        result = Runner(recipe, REGISTRY, ArchivePath(archive)).run()
    except FlangeyeError:
        return None
    found = result.transforms.get("base_T_camera")
    return None if found is None else np.array(found.matrix)


def apart(first, second):
    """Return the distance of two camera poses [m, rad]; infinite where there is none."""
    if first is None or second is None:
        return np.inf, np.inf
    turned = np.linalg.norm(rotation_log(first[:3, :3].T @ second[:3, :3]))
    return np.linalg.norm(first[:3, 3] - second[:3, 3]), turned


QUICK = (
    "metres as millimetres",
    "markers transposed",
    "vectors as ZYX",
    "the base in the flange",
    "an outlier",
)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A session without a fault, and base_T_camera that comes of it."""
    path = tmp_path_factory.mktemp("sound")
    session = clean(np.random.default_rng(5), N, "marker", turn=0.4)
    recipe = recipe_with(path / "recipe.yaml", RECIPE["steps"][0])
    return session, calibrated(recipe, write(path / "good", session))


@pytest.mark.parametrize(
    "fault", [pytest.param(f, marks=() if f in QUICK else pytest.mark.slow) for f in FAULTS]
)
def test_the_line_cures(tmp_path: Path, sound: Any, fault: Any) -> None:
    name, plant = FAULTS[fault]
    recipe = recipe_with(tmp_path / "recipe.yaml", RECIPE["steps"][0])
    session, truth = sound
    archive = write(tmp_path / "bad", plant(session))

    found = examine(open_session(archive, REGISTRY, recipe), CHECKS).findings
    assert [finding.name for finding in found] == [name]
    step = next(line for line in found[-1].lines if "configuration" not in line)
    assert [step] in [yaml.safe_load(choice) for choice in found[-1].choices]
    corrected_session = recipe_with(tmp_path / "mended.yaml", step)

    shift, turn = apart(calibrated(corrected_session, archive), truth)
    assert shift < 2e-3
    assert turn < np.radians(0.15)
    assert examine(open_session(archive, REGISTRY, corrected_session), CHECKS).findings == ()
    before = apart(calibrated(recipe, archive), truth)
    assert fault in HARMLESS or before[0] > 5 * shift


def test_centres_of_an_unknown_place_are_solved_by_what_a_refusal_names(tmp_path: Path) -> None:
    """The tip of a tool was recorded: ``place: unknown`` finds it, with a scanner's file too."""
    rng = np.random.default_rng(2)
    session = clean(rng, N, "centres", turn=0.4)
    offset = np.array([0.02, 0.03, 0.08])
    tips = np.array(session.poses)
    tips[:, :3, 3] += tips[:, :3, :3] @ offset
    rows = np.hstack([tips.reshape(N, 16), session.centres])
    (tmp_path / "poses.csv").write_text("\n".join(",".join(map(repr, r)) for r in rows.tolist()))
    target = {"columns": [17, 18, 19], "rotation": "point", "length": "m"}
    table = {
        "rotation": "matrix", "length": "m", "pose": "base_T_flange",
        "columns": list(range(1, 17)), "target": target,
    }  # fmt: skip
    step = {"acquire.centres": {"reader": {"table": table}, "centre_noise": "0.1 mm"}}
    recipe = {
        "title": "Tip",
        "robot": "ur5e",
        "scanner": "phoxi-m",
        "steps": [step, "solve.robust"],
    }
    told = []
    for more in ({}, {"configuration": {"name": "eye-on-base", "place": "unknown"}}):
        path = tmp_path / "recipe.yaml"
        path.write_text(yaml.safe_dump({**recipe, **more}))
        told.append(Runner(load_recipe(path, REGISTRY), REGISTRY, ArchivePath(tmp_path)).run())
    assert "configuration: {place: unknown} finds it" in str(told[0].advice)
    assert told[1].refused is None
    found = np.array(told[1].transforms["flange_T_target"].matrix)[:3, 3]
    assert found == pytest.approx(-offset, abs=1e-3)


@pytest.mark.parametrize(
    ("fault", "kind"),
    [("both inverted", "hand"),
     ("tables exchanged", "marker"),
     ("robot's x and y exchanged", "hand"),
     pytest.param("marker's x and y exchanged", "marker", marks=pytest.mark.slow),
     pytest.param("marker inverted", "hand", marks=pytest.mark.slow),
     pytest.param("camera's axes as OpenGL has them", "hand", marks=pytest.mark.slow),
     pytest.param("wrong mounting", "hand", marks=pytest.mark.slow),
     pytest.param("marker's angles off by 6 deg", "hand", marks=pytest.mark.slow),
     pytest.param("marker's size + 0.3 %", "marker", marks=pytest.mark.slow),
     pytest.param("robot's degrees as radians", "marker", marks=pytest.mark.slow),
     pytest.param("marker's y negated", "marker", marks=pytest.mark.slow),
     pytest.param("marker's rpy as vector", "hand", marks=pytest.mark.slow)],
)  # fmt: skip
def test_a_fault_in_tables_is_named_and_its_line_cures(fault: str, kind: str) -> None:
    cells = [cell.strip() for cell in injected.row(fault, kind, 1).split("|")[1:-1]]
    status, finding, cured = cells[2], cells[5], cells[6]
    assert status != "verified"
    assert finding in (
        "pose convention", "pose direction", "mounting", "mirrored axis", "marker rotations", "target size", "camera axes",
        "exchanged columns",
    )  # fmt: skip
    assert cured.startswith("verified") and float(cured.split()[1]) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["robot inverted", "marker inverted", "robot exchanged"])
def test_two_mistakes_at_once_are_named_and_their_lines_cure(fault: str) -> None:
    cells = [c.strip() for c in injected.row(f"{fault}, wrong mounting", "marker", 1).split("|")]
    assert cells[3] != "verified"
    assert cells[6] == "mounting; pose direction"
    assert cells[7].startswith("verified") and float(cells[7].split()[1]) < 1.0


@pytest.mark.slow
def test_a_set_without_a_fault_gives_no_finding() -> None:
    cells = [cell.strip() for cell in injected.row("none", "hand", 2).split("|")[1:-1]]
    assert (cells[2], cells[5]) == ("verified", "nothing")

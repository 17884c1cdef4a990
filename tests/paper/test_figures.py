"""From the tables of batches to CSV files and pictures, on batches made up here."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import FlangeyeError
from flangeye_paper import fig9, fig10, fig11, heldout, table1, table2
from flangeye_paper.__main__ import refreshed
from flangeye_paper.tables import AXIS_COLOURS, METHOD_LOOKS, read_csv, read_sessions, write_csv

REALISED = "verify.realisations"
WORSE = {"all-data": 1.02, "algorithm-1-oracle": 3.2, "algorithm-1-held-out": 2.9, "robust": 1.03}


def figures_at(noise, factor):
    """What verify.realisations would say of a method so much worse than the bound."""
    found = {f"{axis}_std": noise * factor for axis in AXIS_COLOURS}
    found |= {f"{axis}_mean": 0.0 for axis in AXIS_COLOURS} | {
        f"bound_{axis}": noise for axis in AXIS_COLOURS
    }
    found |= {"workspace_rms": 0.28 * noise * factor, "bound_workspace_rms": 0.28 * noise}
    found |= {"inliers_alone_rms": 0.28 * noise, "centre_x_std": noise, "centre_y_std": noise}
    return found | {"realisations": 100.0, "refused": 0.0}


@pytest.fixture
def fig9_batches(batch: Callable[..., Any]) -> Any:
    for method, factor in WORSE.items():
        sessions = [
            ({"steps.0.noise": f"{n} mm"}, REALISED, figures_at(n * 1e-3, factor)) for n in (1, 2)
        ]
        batch(f"fig9_{method}", *sessions)
        batch(f"fig9-outliers_{method}", *sessions)
        counts = [({"steps.0.poses": n}, REALISED, figures_at(2e-2 / n, factor)) for n in
                  (5, 10, 20, 40, 75)]  # fmt: skip
        batch(f"fig10_{method}", *counts)
    pools = [({"steps.1.pool": n}, REALISED, figures_at(1e-3, 1 / n)) for n in (4, 6)]
    return batch("fig9-pools", *pools)


def test_fig9_tells_growth_and_ratios(fig9_batches: Any, tmp_path: Path) -> None:
    fig9.fig9(fig9_batches, tmp_path)
    summary = {row["method"]: row for row in read_csv(tmp_path / "fig9_summary.csv")}
    robust = summary["solve.robust"]
    assert float(robust["x mm/mm"]) == pytest.approx(1.03)
    assert float(robust["times the bound"]) == pytest.approx(1.03)
    assert float(robust["times the inliers alone"]) == pytest.approx(1.03)
    pools = read_csv(tmp_path / "fig9_pools.csv")
    assert [float(row["x: all data / Algorithm 1"]) for row in pools] == pytest.approx([4, 6])
    assert len(read_csv(tmp_path / "fig9.csv")) == 2 * 2 * len(METHOD_LOOKS)
    assert (tmp_path / "fig9.png").read_bytes().startswith(b"\x89PNG")


def test_pictures_are_the_same_for_the_same_numbers(fig9_batches: Any, tmp_path: Path) -> None:
    pictures = []
    for _ in range(2):
        fig10.fig10(fig9_batches, tmp_path)
        pictures.append((tmp_path / "fig10.png").read_bytes())
    assert pictures[0] == pictures[1]


def test_fig10_shows_every_method_at_the_work(fig9_batches: Any, tmp_path: Path) -> None:
    fig10.fig10(fig9_batches, tmp_path)
    rows = read_csv(tmp_path / "fig10_summary.csv")
    assert [row["poses"] for row in rows] == ["5", "10", "20", "40", "75"]
    assert all(float(row["workspace rms mm: solve.robust"]) > 0 for row in rows)


def icp_figures(y):
    found = dict.fromkeys(AXIS_COLOURS, 1e-3) | {"y": y}
    found |= {f"flange_{axis}": 1e-4 for axis in "xyz"}
    return found | {"rms": 2e-4, "share": 1.0, "iterations": 5.0}


def test_table1_puts_the_printed_numbers_beside_ours(batch: Any, tmp_path: Any) -> None:
    stored = dict.fromkeys(AXIS_COLOURS, 2e-3) | {f"{axis}_std": 1e-4 for axis in AXIS_COLOURS}
    for name in ("ur5", "franka"):
        batch(f"table1_{name}", ({}, table1.STORED, stored))
    both = [{"steps.2.normals": kind} for kind in table1.NORMALS]
    steps = {"1.verify.stored_results_as_in_paper": {"figures": stored}}
    batch("table1_aubo", *((row, table1.ICP, icp_figures(2.69e-4)) for row in both))
    for number in range(2):
        path = tmp_path / "table1_aubo" / f"s{number}" / "result.json"
        add_steps(path, steps)
    path = [row | {"steps.2.iterations": n} for row in both for n in (5, 500)]
    batch("table1_aubo-iterations", *((row, table1.ICP, icp_figures(1e-3)) for row in path))
    kinect = [row | {"steps.2.distance": 2} for row in both]
    root = batch("table1_kinect", *((row, table1.ICP, icp_figures(4e-3)) for row in kinect))
    table1.table1(root, tmp_path)
    rows = read_csv(tmp_path / "table1.csv")
    aubo = [row["y mm"] for row in rows if row["setup"] == "Aubo i5 PhoXi S"]
    assert aubo[:1] == ["-0.270"] and "+0.269" in aubo
    assert {row["source"] for row in rows if row["setup"] == "UR10e PhoXi M"} == {"the paper"}


def add_steps(path, steps):
    document = json.loads(path.read_text())
    document["verifications"] |= steps
    path.write_text(json.dumps(document))


def stored_results(folder, robot):
    """The authors' file of stored results, three runs of four steps, made up."""
    place = folder / "data" / robot
    place.mkdir(parents=True)
    rng = np.random.default_rng(0)
    np.savez(
        place / "results_photoneo.npz",
        np.ones((3, 4)), rng.normal(size=(3, 4, 3)), rng.normal(size=(3, 4, 3)) * 0.1,
        np.repeat(np.eye(4)[None], 3, axis=0),
    )  # fmt: skip


def test_fig11_compares_runs_with_those_stored(batch: Callable[..., Any], tmp_path: Path) -> None:
    for robot in fig11.ROBOTS:
        stored_results(tmp_path / "published", robot)
    figures = {f"{axis}_{n:02d}": 1e-4 for axis in AXIS_COLOURS for n in (4, 5, 6)}
    late = {name: value for name, value in figures.items() if not name.endswith("04")}
    step = "verify.algorithm_1_by_iteration"
    sessions = [({"seed": i}, step, found | {"others_rms": 7e-4})
                for i, found in enumerate((figures, late))]  # fmt: skip
    root = batch("fig11_aubo", *sessions)
    fig11.fig11(root, tmp_path / "published", tmp_path)
    summary = read_csv(tmp_path / "fig11_summary.csv")
    assert [row["recording"] for row in summary] == [
        "Aubo i5, run again", "Aubo i5, stored", "UR5, stored", "Franka, stored",
    ]  # fmt: skip
    assert float(summary[0]["translation mean mm"]) == pytest.approx(3**0.5 * 0.1, abs=1e-3)


def test_heldout_compares_methods_on_the_same_poses(
    batch: Callable[..., Any], tmp_path: Path
) -> None:
    for robot in ("aubo", "ur5", "franka"):
        stored_results(tmp_path / "published", robot)
    poses = [
        {"id": str(i), "used": i < 3, "centre_in_camera": [0, 0, 1], "tcp_in_base": [0, 0, 1]}
        for i in range(4)
    ]
    errors = {"0": 3e-4, "1": 4e-4, "2": 5e-4, "3": 8e-2}
    for method in heldout.HELD_OUT_METHODS:
        sessions: list[Any] = [
            ({"archive": f"/a/{name}"}, heldout.STAGE, {}) for name in heldout.RECORDINGS
        ]
        root = batch(f"heldout_{method}", *sessions, errors=errors, extra={"observations": poses})
    heldout.heldout(root, tmp_path / "published", tmp_path)
    rows = read_csv(tmp_path / "heldout.csv")
    held = [row for row in rows if "stored" not in row["method"]]
    assert {row["rms mm"] for row in held} == {f"{np.sqrt(50 / 3) / 10:.3f}"}
    assert all(float(row["all poses: rms mm"]) > 39 for row in held)
    assert len(rows) == 4 * 4 + 3


def test_table2_measures_at_the_camera_and_at_the_work(
    batch: Callable[..., Any], tmp_path: Path
) -> None:
    found, truth = np.eye(4), np.eye(4)
    truth[0, 3] = 1e-3
    extra = {
        "transforms": {"base_T_camera": {"matrix": found.tolist()}},
        "truth": {"base_T_camera": truth.tolist(), "rms_over_workspace": 2e-3},
    }
    for target in table2.TARGETS:
        rows = [{"steps.0.poses.grid.counts": counts} for counts in ("[2, 2, 1]", "[4, 2, 2]")]
        batch(f"table2_{target}", *((row, "x", {}) for row in rows), extra=extra)
        root = batch(f"table2-narrow_{target}", ({}, "x", {}), extra=extra)
    table2.table2(root, tmp_path)
    first = read_csv(tmp_path / "table2.csv")[0]
    assert (first["x mm"], first["workspace rms mm"]) == ("1.00", "2.000")


def test_a_batch_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FlangeyeError) as error:
        read_sessions(tmp_path)
    assert str(error.value) == (
        f"{tmp_path}/sessions.csv: cannot be read (No such file or directory); "
        "recipes/paper/reproduce.sh shows the command that makes it"
    )


def test_a_page_shows_the_columns_it_asks_for(tmp_path: Path) -> None:
    write_csv(tmp_path / "t.csv", [{"a": 1.0, "b": "x", "c": None}])
    page = "before\n<!-- begin t.csv: c | a -->\nold\n<!-- end -->\nafter"
    assert refreshed(page, tmp_path) == (
        "before\n<!-- begin t.csv: c | a -->\n| c | a |\n| --- | --- |\n|  | 1.000 |\n"
        "<!-- end -->\nafter"
    )

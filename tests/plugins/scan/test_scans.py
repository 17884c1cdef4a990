"""Where a scan of a workpiece comes from."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from flangeye import RecipeError, StageError
from flangeye.devices import Scan, Scanner, ScannerDriver
from flangeye.files.clouds import write_cloud
from flangeye.plugin.registry import load_registry
from flangeye.types import CAMERA, PointCloud, Seed
from flangeye.workflow.recipe.load import load_recipe, parse_recipe
from flangeye_emulators.scan import SimulatedScanParams, scan_simulated
from flangeye_plugins.scan import FileScanParams, scan_file, scan_live
from tests.plugins.seam.scenes import BASE_T_CAMERA, scanned

CLOUD = PointCloud(CAMERA, np.arange(12, dtype=np.float32).reshape(4, 3))


def test_the_simulated_scan_shows_the_true_seam() -> None:
    scan, truth = scanned("v-straight")
    points = BASE_T_CAMERA.apply(scan.cloud.points())
    middle = truth.mean(axis=0)
    near = np.linalg.norm(points[:, :2] - middle[:2], axis=1) < 5e-3
    assert np.quantile(points[near, 2], 0.02) == pytest.approx(middle[2], abs=1e-3)
    assert scan.notes == (
        "workpiece: Plate with a straight V-groove, simulated, with 6 other objects around it",
    )


def test_without_a_simulated_cell_nothing_is_simulated() -> None:
    with pytest.raises(StageError) as error:
        scan_simulated(None, Seed(0), SimulatedScanParams())
    assert str(error.value) == (
        "scan.simulated: needs the scanner of a simulated cell, but the acquire step "
        "simulates none; use acquire.simulated, or scan.file"
    )


def test_an_unknown_workpiece_is_named() -> None:
    with pytest.raises(ValidationError, match="no workpiece 'v-strait'; known: v-straight, "):
        SimulatedScanParams(workpiece="v-strait")


def test_a_file_of_ones_own_is_read_before_anything_runs(tmp_path: Path) -> None:
    recipe, own = tmp_path / "weld.yaml", tmp_path / "own.yaml"
    head = "title: T\nrobot: ur10e\nscanner: {model: phoxi-m}\nsteps:\n- acquire.simulated\n"
    recipe.write_text(
        f"{head}- segment.flange\n- fit.rim\n- solve.svd\n- verify.holdout\n"
        "- scan.simulated: {workpiece: own.yaml}\n- seam.line: {path: taught.csv, unit: mm}\n"
    )
    registry = load_registry()
    with pytest.raises(RecipeError) as missing:
        load_recipe(recipe, registry)
    lines = str(missing.value).splitlines()
    assert f"{recipe}:10: steps.5.scan.simulated.workpiece: no file {own}; a relative" in lines[0]
    assert f"{recipe}:11: steps.6.seam.line.path: no file {tmp_path / 'taught.csv'}" in lines[1]
    (tmp_path / "taught.csv").write_text("0,0,0\n10,0,0\n")
    own.write_text("title: A plate\n")
    with pytest.raises(RecipeError, match=f"{own}:1: cad: is missing"):
        load_recipe(recipe, registry)
    own.unlink()  # what a log carries is read where its files are gone
    assert len(parse_recipe(recipe.read_text(), "weld", registry).steps) == 7


def test_a_file_and_a_folder_of_clouds_are_read(tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.pcd", CLOUD, "mm")
    one = scan_file(FileScanParams(path=tmp_path / "a.pcd", unit="mm"))
    assert np.allclose(one.cloud.xyz, CLOUD.xyz)
    write_cloud(tmp_path / "b.pcd", CLOUD, "mm")
    both = scan_file(FileScanParams(path=tmp_path, unit="mm"))
    assert both.cloud.xyz.shape == (8, 3)
    assert both.notes == (f"workpiece scan: {tmp_path}, 2 files, 8 points",)


def test_a_scan_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="none.pcd: does not exist"):
        scan_file(FileScanParams(path=tmp_path / "none.pcd", unit="m"))
    with pytest.raises(StageError, match="holds no cloud; known: .asc, .csv, .npy"):
        scan_file(FileScanParams(path=tmp_path, unit="m"))


class Still(Scanner):
    """A scanner with one scan."""

    def __init__(self) -> None:
        self.name, self.facts, self.closed = "still scanner", {}, False

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        self.closed = True

    def expose(self):
        return lambda: Scan(CLOUD, 0, 1)


def test_a_live_scan_is_one_exposure_and_lets_go_of_the_scanner() -> None:
    device = Still()
    scan = scan_live(ScannerDriver("scanner.still", lambda: device))
    assert np.array_equal(scan.cloud.xyz, CLOUD.xyz)
    assert scan.source == "still scanner"
    assert device.closed

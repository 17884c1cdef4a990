"""The built-in plugins keep to what is asked of a vendor's, kind by kind."""

import itertools
import tempfile
from pathlib import Path

import numpy as np

from flangeye.files.clouds import write_cloud
from flangeye.plugin.registry import load_registry
from flangeye.testing import (
    AcquireConformance,
    CheckConformance,
    CostConformance,
    ErrorConformance,
    FitConformance,
    PlanConformance,
    ReaderConformance,
    RefineConformance,
    ReplayConformance,
    RobotConformance,
    ScannerConformance,
    SegmentConformance,
    SolveConformance,
    VerifyConformance,
    ViewConformance,
)
from flangeye.testing.solving import HERE
from flangeye.testing.solving import TRUE_CAMERA as KIT_CAMERA
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    Capture,
    PointCloud,
    Transform,
    VerificationView,
    Views,
    by_frame,
)
from flangeye.units import SI
from flangeye_emulators.acquire.simulated import SimulatedParams, acquire_simulated
from flangeye_emulators.robot import robot_simulated
from flangeye_emulators.world.scanner import StructuredLight
from flangeye_plugins.acquire.archive import ArchiveParams, acquire_archive
from flangeye_plugins.cost import cost_axes, cost_translation, cost_work_radius
from flangeye_plugins.error import error_holdout
from flangeye_plugins.fit.ransac import fit_ransac_circle
from flangeye_plugins.fit.rim import fit_rim
from flangeye_plugins.fit.sphere import fit_sphere
from flangeye_plugins.plan import GridParams, grid
from flangeye_plugins.reader.folder import FolderParams, folder
from flangeye_plugins.refine import refine_compensate
from flangeye_plugins.scanner.watched_folder import (
    WatchedFolderParams,
    scanner_watched_folder,
)
from flangeye_plugins.segment.flange import SegmentParams, segment_flange
from flangeye_plugins.segment.sphere import segment_sphere
from flangeye_plugins.solve.iterative import solve_iterative
from flangeye_plugins.solve.robust import solve_robust
from flangeye_plugins.solve.svd import solve_svd
from flangeye_plugins.verify.holdout import verify_holdout
from flangeye_plugins.verify.icp import verify_icp
from flangeye_plugins.view import GuessParams, view_guess
from tests.emulators.world.bench import facing, flange_scene, zoomed

SAMPLE = Path(__file__).parents[2] / "data" / "samples" / "ur5_phoxi-m"


class TestSegmentFlange(SegmentConformance):
    stage = segment_flange


class TestSegmentSphere(SegmentConformance):
    stage = segment_sphere
    feature = "sphere"
    tolerance = 0.03


class TestFitRim(FitConformance):
    stage = fit_rim


class TestFitRansacCircle(FitConformance):
    stage = fit_ransac_circle
    tolerance = 0.5e-3


class TestFitSphere(FitConformance):
    stage = fit_sphere
    feature = "sphere"


class TestSolveSvd(SolveConformance):
    stage = solve_svd


class TestSolveRobust(SolveConformance):
    stage = solve_robust


class TestSolveIterative(SolveConformance):
    stage = solve_iterative
    params = {"error": {"holdout": {}}, "required": "0.1 mm", "reserve": 4}
    tolerance = 0.3e-3


def simulated_views(flange, motion):
    """A view with the depth of its holes: ICP needs what stands out of the face."""
    rng = np.random.default_rng(0)
    camera_T_flange = facing(0.3)
    xyz = StructuredLight(zoomed(), 1.0, 0.0, rng).scan(flange_scene(camera_T_flange, "ur5e"), rng)
    pose = Transform(BASE, FLANGE, motion @ KIT_CAMERA @ camera_T_flange)
    capture = Capture("view", PointCloud(CAMERA, xyz), by_frame(pose))
    found = segment_flange(capture, flange, SegmentParams())
    return Views([VerificationView("view", found, pose)])


class TestRefineCompensate(RefineConformance):
    stage = refine_compensate
    tolerance = 0.5e-3

    def views(self, motion=HERE):
        return simulated_views(self.flange, motion)


class TestVerifyHoldout(VerifyConformance):
    stage = verify_holdout


class TestVerifyIcp(VerifyConformance):
    stage = verify_icp

    def views(self, motion=HERE):
        return simulated_views(self.flange, motion)


class TestCostTranslation(CostConformance):
    part = cost_translation


class TestCostAxes(CostConformance):
    part = cost_axes


class TestCostWorkRadius(CostConformance):
    part = cost_work_radius


class TestErrorHoldout(ErrorConformance):
    part = error_holdout


class TestPlanGrid(PlanConformance):
    part = grid


class TestReaderFolder(ReaderConformance):
    part = folder
    archive = SAMPLE


class TestAcquireSimulated(AcquireConformance):
    stage = acquire_simulated
    params = SimulatedParams(resolution=0.05, poses=grid.bind(GridParams(counts=(2, 2, 1))))


class TestAcquireArchive(AcquireConformance):
    stage = acquire_archive
    params = ArchiveParams(reader=folder.bind(FolderParams()))
    archive = SAMPLE


class TestRobotSimulated(RobotConformance):
    part = robot_simulated


class TestViewGuess(ViewConformance):
    part = view_guess
    params = GuessParams(position=(SI(0.6), SI(0.0), SI(1.0)))


class TestScannerWatchedFolder(ScannerConformance):
    """Each exposure is preceded by an export, as the scanner's software would make it."""

    part = scanner_watched_folder
    unreachable = WatchedFolderParams(path=Path("no/such/folder"), unit="m")

    def open(self):
        return exporting(self.scanner)


def exporting(model):
    where = Path(tempfile.mkdtemp())
    params = WatchedFolderParams(path=where, unit="mm", settle=SI(0.0))
    scanner = scanner_watched_folder(model, params)
    expose, count = scanner.expose, itertools.count()

    def export_and_expose():
        name = where / f"{next(count)}"
        xyz = np.full((4, 5, 3), 0.7, np.float32)
        write_cloud(name.with_suffix(".pcd"), PointCloud(CAMERA, xyz), "mm")
        return expose()

    scanner.expose = export_and_expose
    return scanner


def checks():
    """One class for each check of flangeye doctor."""
    registry = load_registry()
    for name, plugin in registry.parts.items():
        if plugin.kind == "check":
            title = "Test" + name.title().replace(".", "").replace("_", "")
            yield title, type(title, (CheckConformance,), {"part": plugin})


globals().update(checks())


class TestReplayTactile(ReplayConformance):
    part = load_registry().parts["replay.tactile"]

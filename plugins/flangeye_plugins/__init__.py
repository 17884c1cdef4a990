"""The built-in plugins, offered to the engine through the same door as a vendor's."""

from collections.abc import Iterable

from flangeye import hookimpl
from flangeye.stage import Part, Stage
from flangeye_plugins.acquisition.archive import acquire_archive
from flangeye_plugins.acquisition.centres import acquire_centres
from flangeye_plugins.acquisition.images import acquire_images
from flangeye_plugins.acquisition.live import acquire_live
from flangeye_plugins.acquisition.samples import acquire_samples
from flangeye_plugins.acquisition.simulated import acquire_simulated
from flangeye_plugins.acquisition.simulated_images import acquire_simulated_images
from flangeye_plugins.acquisition.simulated_session import (
    acquire_simulated_marker,
    acquire_simulated_session,
)
from flangeye_plugins.costs.costs import cost_axes, cost_translation, cost_work_radius
from flangeye_plugins.doctoring import CHECKS
from flangeye_plugins.drivers.robots.aubo.driver import robot_aubo
from flangeye_plugins.drivers.robots.franky.driver import robot_franky
from flangeye_plugins.drivers.robots.loopback import robot_loopback
from flangeye_plugins.drivers.robots.manual.driver import robot_manual
from flangeye_plugins.drivers.robots.simulated import robot_simulated
from flangeye_plugins.drivers.robots.ur.driver import robot_ur_rtde
from flangeye_plugins.drivers.scanners.azure_kinect import scanner_azure_kinect
from flangeye_plugins.drivers.scanners.genicam import scanner_genicam
from flangeye_plugins.drivers.scanners.loopback import scanner_loopback
from flangeye_plugins.drivers.scanners.mech_eye import scanner_mech_eye
from flangeye_plugins.drivers.scanners.realsense import scanner_realsense
from flangeye_plugins.drivers.scanners.watched_folder import scanner_watched_folder
from flangeye_plugins.drivers.scanners.zivid import scanner_zivid
from flangeye_plugins.fitting.boards import fit_aruco, fit_charuco, fit_checkerboard
from flangeye_plugins.fitting.ransac import fit_ransac_circle
from flangeye_plugins.fitting.rim import fit_rim
from flangeye_plugins.fitting.sphere import fit_sphere
from flangeye_plugins.planning.guess import view_guess, view_shown
from flangeye_plugins.planning.next_best import next_best
from flangeye_plugins.planning.plans import grid
from flangeye_plugins.readers.ancorasir import ancorasir
from flangeye_plugins.readers.auto import auto
from flangeye_plugins.readers.corrected import corrected
from flangeye_plugins.readers.easy_handeye import easy_handeye
from flangeye_plugins.readers.folder import folder
from flangeye_plugins.readers.moveit import moveit
from flangeye_plugins.readers.table import table
from flangeye_plugins.readers.zivid import zivid
from flangeye_plugins.refining.compensate import refine_compensate
from flangeye_plugins.seams.cad import seam_cad
from flangeye_plugins.seams.groove import seam_groove
from flangeye_plugins.seams.scanning import scan_file, scan_live, scan_simulated
from flangeye_plugins.segmentation.flange import segment_flange
from flangeye_plugins.segmentation.sphere import segment_sphere
from flangeye_plugins.solving.iterative import solve_iterative
from flangeye_plugins.solving.maximum_likelihood import solve_maximum_likelihood
from flangeye_plugins.solving.named import CLOSED_FORMS
from flangeye_plugins.solving.robust import solve_robust
from flangeye_plugins.solving.svd import solve_svd
from flangeye_plugins.studies.by_iteration import verify_by_iteration
from flangeye_plugins.studies.icp_as_in_paper import (
    error_icp_as_in_paper,
    verify_icp_as_in_paper,
)
from flangeye_plugins.studies.oracle import error_oracle
from flangeye_plugins.studies.points import acquire_points
from flangeye_plugins.studies.published import acquire_published_centres
from flangeye_plugins.studies.realisations import verify_realisations
from flangeye_plugins.studies.stored_results import verify_stored_results
from flangeye_plugins.studies.weld import scan_as_laid, seam_misplanned
from flangeye_plugins.verification.errors import error_holdout, error_icp
from flangeye_plugins.verification.holdout import verify_holdout
from flangeye_plugins.verification.icp import verify_icp
from flangeye_plugins.welding.replay import replay_tactile
from flangeye_plugins.welding.simulated.sensor import sensor_simulated_finger
from flangeye_plugins.welding.tactile import weld_tactile
from flangeye_plugins.welding.touch.guide import guide_tactile
from flangeye_plugins.welding.touch.opencv import sensor_opencv
from flangeye_plugins.welding.touch.recorded import sensor_image_folder, sensor_mcap


@hookimpl
def flangeye_stages() -> Iterable[Stage]:
    """Offer the built-in stages."""
    return (
        acquire_simulated,
        acquire_simulated_marker,
        acquire_simulated_session,
        acquire_simulated_images,
        acquire_archive,
        acquire_live,
        acquire_centres,
        acquire_images,
        acquire_samples,
        segment_flange,
        fit_rim,
        fit_ransac_circle,
        fit_charuco,
        fit_checkerboard,
        fit_aruco,
        segment_sphere,
        fit_sphere,
        solve_robust,
        solve_svd,
        solve_iterative,
        solve_maximum_likelihood,
        *CLOSED_FORMS,
        refine_compensate,
        verify_holdout,
        verify_icp,
        scan_simulated,
        scan_file,
        scan_live,
        seam_cad,
        seam_groove,
        acquire_points,
        acquire_published_centres,
        verify_realisations,
        verify_icp_as_in_paper,
        verify_by_iteration,
        verify_stored_results,
        weld_tactile,
        scan_as_laid,
        seam_misplanned,
    )


@hookimpl
def flangeye_parts() -> Iterable[Part]:
    """Offer the built-in parts."""
    return (
        ancorasir,
        auto,
        corrected,
        easy_handeye,
        folder,
        moveit,
        table,
        zivid,
        grid,
        next_best,
        view_guess,
        view_shown,
        cost_translation,
        cost_axes,
        cost_work_radius,
        error_icp,
        error_holdout,
        error_oracle,
        error_icp_as_in_paper,
        *CHECKS,
        scanner_loopback,
        robot_aubo,
        robot_franky,
        robot_manual,
        robot_loopback,
        robot_simulated,
        robot_ur_rtde,
        scanner_genicam,
        scanner_azure_kinect,
        scanner_realsense,
        scanner_zivid,
        scanner_mech_eye,
        scanner_watched_folder,
        replay_tactile,
        guide_tactile,
        sensor_simulated_finger,
        sensor_opencv,
        sensor_image_folder,
        sensor_mcap,
    )

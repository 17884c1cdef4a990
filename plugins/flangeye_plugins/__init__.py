"""The built-in plugins, one folder for each kind, registered like a vendor's.

They are offered as names with import paths, so a module is imported only when a recipe uses it.
"""

from collections.abc import Callable, Mapping

from flangeye import hookimpl
from flangeye.models.graph import Graph


@hookimpl
def flangeye_stages() -> Mapping[str, str]:
    """Offer the built-in stages."""
    closed_forms = (
        "tsai_lenz park_martin horaud_dornaika andreff daniilidis shah li kronecker two_steps "
        "linear"
    )
    formats = (
        "ros2_command ros2_launch urdf moveit easy_handeye2 opencv ur kuka abb fanuc yaskawa "
        "staubli doosan zivid mech_mind halcon robodk matrix"
    )
    return {
        **_places(
            "acquire.archive: acquire_archive",
            "acquire.live: acquire_live",
            "acquire.centres: acquire_centres",
            "acquire.images: acquire_images",
            "acquire.centres: acquire_samples",
            "segment.flange: segment_flange",
            "fit.rim: fit_rim",
            "fit.ransac: fit_ransac_circle",
            "fit.boards: fit_charuco fit_checkerboard fit_circles fit_aruco",
            "segment.sphere: segment_sphere",
            "fit.sphere: fit_sphere",
            "fit.sphere_profile: fit_sphere_profile",
            "segment.body: segment_body",
            "fit.body: fit_body",
            "solve.robust: solve_robust",
            "solve.svd: solve_svd",
            "solve.iterative: solve_iterative",
        ),
        **_all_of("solve.named:CLOSED_FORMS", "solve", closed_forms),
        **_places(
            "refine: refine_arm refine_compensate",
            "verify.drift: verify_drift",
            "verify.holdout: verify_holdout",
            "verify.icp: verify_icp",
            "verify.sphere: verify_sphere",
            "verify.stitch: verify_stitch",
            "verify.touch: verify_touch",
        ),
        **_all_of("export:EXPORTS", "export", formats),
        **_places(
            "export.controllers: export_robot",
            "scan: scan_file scan_live scan_along",
            "seam.cad: seam_cad",
            "seam.line: seam_line",
            "seam.joint: seam_joint",
            "weld.tactile: weld_tactile",
        ),
    }


@hookimpl
def flangeye_parts() -> Mapping[str, str]:
    """Offer the built-in parts."""
    return _places(
        "reader.ancorasir: ancorasir",
        "reader.auto: auto",
        "reader.cell: cell",
        "reader.corrected: corrected",
        "reader.samples: easy_handeye",
        "reader.folder: folder",
        "reader.samples: moveit",
        "reader.ros2_bag: ros2_bag",
        "reader.table: table",
        "reader.samples: visp zivid",
        "plan: grid next_best",
        "view: view_guess view_shown",
        "cost: cost_translation cost_axes cost_work_radius",
        "error: error_icp error_holdout",
        "check.order: identity repeated",
        "check.units: units",
        "check.pose_conventions: direction axes mirrored exchanged convention",
        "check.order: order clock",
        "check.outliers: flips scatter outlier",
        "check.order: moved tool",
        "check.units: size",
        "check.outliers: motion",
        "check.units: rounding",
        "robot.aubo.driver: robot_aubo",
        "robot.franky: robot_franky",
        "robot.manual: robot_manual",
        "robot.ros2.driver: robot_ros2 robot_ros2_freedrive",
        "robot.ur.driver: robot_ur_rtde",
        "scanner.genicam: scanner_genicam",
        "scanner.azure_kinect: scanner_azure_kinect",
        "scanner.realsense: scanner_realsense",
        "scanner.zivid: scanner_zivid",
        "scanner.mech_eye: scanner_mech_eye",
        "scanner.ros2: scanner_ros2",
        "scanner.watched_folder: scanner_watched_folder",
        "replay: replay_tactile",
        "guide: guide_tactile guide_tool",
        "arc: arc_manual arc_ur_digital",
        "profiler: profiler_tcp",
        "sensor: sensor_opencv sensor_image_folder sensor_mcap",
    )


def _places(*modules: str) -> dict[str, str]:
    """Return the import paths of plugins, from lines of a module and its functions.

    A plugin's kind is the first word of its module; its name may be that of its function alone.
    """
    found = {}
    for module, _, functions in (line.partition(": ") for line in modules):
        kind = module.partition(".")[0]
        for function in functions.split():
            name = f"{kind}.{function.removeprefix(f'{kind}_')}"
            found[name] = f"flangeye_plugins.{module}:{function}"
    return found


def _all_of(place: str, kind: str, names: str) -> dict[str, str]:
    """Return the import paths of plugins of a kind that a module has in one tuple."""
    return {f"{kind}.{name}": f"flangeye_plugins.{place}" for name in names.split()}


@hookimpl
def flangeye_graphs() -> Mapping[str, Callable[[], Graph]]:
    """Return the ROS 2 graph, by its name."""
    return {"ros2": _ros2}


def _ros2() -> Graph:
    from flangeye_plugins.ros2.graph import Ros2Graph

    return Ros2Graph()

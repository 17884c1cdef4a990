"""The built-in plugins, one folder a kind; offered through the same door as a vendor's.

By name and place: a module is imported when a recipe uses what is in it.
"""

from collections.abc import Callable, Mapping

from flangeye import hookimpl
from flangeye.models.graph import Graph

FORMATS = (
    "ros2_command",
    "ros2_launch",
    "urdf",
    "moveit",
    "easy_handeye2",
    "opencv",
    "ur",
    "kuka",
    "abb",
    "fanuc",
    "yaskawa",
    "staubli",
    "doosan",
    "zivid",
    "mech_mind",
    "halcon",
    "robodk",
    "matrix",
)
"""The formats of exports."""

STAGES = {
    "acquire.archive": "flangeye_plugins.acquire.archive:acquire_archive",
    "acquire.live": "flangeye_plugins.acquire.live:acquire_live",
    "acquire.centres": "flangeye_plugins.acquire.centres:acquire_centres",
    "acquire.images": "flangeye_plugins.acquire.images:acquire_images",
    "acquire.samples": "flangeye_plugins.acquire.centres:acquire_samples",
    "segment.flange": "flangeye_plugins.segment.flange:segment_flange",
    "fit.rim": "flangeye_plugins.fit.rim:fit_rim",
    "fit.ransac_circle": "flangeye_plugins.fit.ransac:fit_ransac_circle",
    "fit.charuco": "flangeye_plugins.fit.boards:fit_charuco",
    "fit.checkerboard": "flangeye_plugins.fit.boards:fit_checkerboard",
    "fit.circles": "flangeye_plugins.fit.boards:fit_circles",
    "fit.aruco": "flangeye_plugins.fit.boards:fit_aruco",
    "segment.sphere": "flangeye_plugins.segment.sphere:segment_sphere",
    "fit.sphere": "flangeye_plugins.fit.sphere:fit_sphere",
    "fit.sphere_profile": "flangeye_plugins.fit.sphere_profile:fit_sphere_profile",
    "segment.body": "flangeye_plugins.segment.body:segment_body",
    "fit.body": "flangeye_plugins.fit.body:fit_body",
    "solve.robust": "flangeye_plugins.solve.robust:solve_robust",
    "solve.svd": "flangeye_plugins.solve.named:solve_svd",
    "solve.iterative": "flangeye_plugins.solve.iterative:solve_iterative",
    "solve.tsai_lenz": "flangeye_plugins.solve.named:CLOSED_FORMS",
    "solve.park_martin": "flangeye_plugins.solve.named:CLOSED_FORMS",
    "solve.horaud_dornaika": "flangeye_plugins.solve.named:CLOSED_FORMS",
    "solve.andreff": "flangeye_plugins.solve.named:CLOSED_FORMS",
    "solve.daniilidis": "flangeye_plugins.solve.named:CLOSED_FORMS",
    "solve.shah": "flangeye_plugins.solve.named:CLOSED_FORMS",
    "solve.li": "flangeye_plugins.solve.named:CLOSED_FORMS",
    "solve.kronecker": "flangeye_plugins.solve.named:CLOSED_FORMS",
    "solve.two_steps": "flangeye_plugins.solve.named:CLOSED_FORMS",
    "solve.linear": "flangeye_plugins.solve.named:CLOSED_FORMS",
    "refine.arm": "flangeye_plugins.refine:refine_arm",
    "refine.compensate": "flangeye_plugins.refine:refine_compensate",
    "verify.drift": "flangeye_plugins.verify.drift:verify_drift",
    "verify.holdout": "flangeye_plugins.verify.holdout:verify_holdout",
    "verify.icp": "flangeye_plugins.verify.icp:verify_icp",
    "verify.sphere": "flangeye_plugins.verify.sphere:verify_sphere",
    "verify.stitch": "flangeye_plugins.verify.stitch:verify_stitch",
    "verify.touch": "flangeye_plugins.verify.touch:verify_touch",
    **{f"export.{name}": "flangeye_plugins.export:EXPORTS" for name in FORMATS},
    "export.robot": "flangeye_plugins.export.controllers:export_robot",
    "scan.file": "flangeye_plugins.scan:scan_file",
    "scan.live": "flangeye_plugins.scan:scan_live",
    "scan.along": "flangeye_plugins.scan:scan_along",
    "seam.cad": "flangeye_plugins.seam.cad:seam_cad",
    "seam.line": "flangeye_plugins.seam.line:seam_line",
    "seam.joint": "flangeye_plugins.seam.joint:seam_joint",
    "weld.tactile": "flangeye_plugins.weld.tactile:weld_tactile",
}

PARTS = {
    "reader.ancorasir": "flangeye_plugins.reader.ancorasir:ancorasir",
    "reader.auto": "flangeye_plugins.reader.auto:auto",
    "reader.cell": "flangeye_plugins.reader.cell:cell",
    "reader.corrected": "flangeye_plugins.reader.corrected:corrected",
    "reader.easy_handeye": "flangeye_plugins.reader.samples:easy_handeye",
    "reader.folder": "flangeye_plugins.reader.folder:folder",
    "reader.moveit": "flangeye_plugins.reader.samples:moveit",
    "reader.ros2_bag": "flangeye_plugins.reader.ros2_bag:ros2_bag",
    "reader.table": "flangeye_plugins.reader.table:table",
    "reader.visp": "flangeye_plugins.reader.samples:visp",
    "reader.zivid": "flangeye_plugins.reader.samples:zivid",
    "plan.grid": "flangeye_plugins.plan:grid",
    "plan.next_best": "flangeye_plugins.plan:next_best",
    "view.guess": "flangeye_plugins.view:view_guess",
    "view.shown": "flangeye_plugins.view:view_shown",
    "cost.translation": "flangeye_plugins.cost:cost_translation",
    "cost.axes": "flangeye_plugins.cost:cost_axes",
    "cost.work_radius": "flangeye_plugins.cost:cost_work_radius",
    "error.icp": "flangeye_plugins.error:error_icp",
    "error.holdout": "flangeye_plugins.error:error_holdout",
    "check.identity": "flangeye_plugins.check.order:identity",
    "check.repeated": "flangeye_plugins.check.order:repeated",
    "check.units": "flangeye_plugins.check.units:units",
    "check.direction": "flangeye_plugins.check.pose_conventions:direction",
    "check.axes": "flangeye_plugins.check.pose_conventions:axes",
    "check.mirrored": "flangeye_plugins.check.pose_conventions:mirrored",
    "check.exchanged": "flangeye_plugins.check.pose_conventions:exchanged",
    "check.convention": "flangeye_plugins.check.pose_conventions:convention",
    "check.order": "flangeye_plugins.check.order:order",
    "check.clock": "flangeye_plugins.check.order:clock",
    "check.flips": "flangeye_plugins.check.outliers:flips",
    "check.scatter": "flangeye_plugins.check.outliers:scatter",
    "check.outlier": "flangeye_plugins.check.outliers:outlier",
    "check.moved": "flangeye_plugins.check.order:moved",
    "check.tool": "flangeye_plugins.check.order:tool",
    "check.size": "flangeye_plugins.check.units:size",
    "check.motion": "flangeye_plugins.check.outliers:motion",
    "check.rounding": "flangeye_plugins.check.units:rounding",
    "robot.aubo": "flangeye_plugins.robot.aubo.driver:robot_aubo",
    "robot.franky": "flangeye_plugins.robot.franky:robot_franky",
    "robot.manual": "flangeye_plugins.robot.manual:robot_manual",
    "robot.ros2": "flangeye_plugins.robot.ros2.driver:robot_ros2",
    "robot.ros2_freedrive": "flangeye_plugins.robot.ros2.driver:robot_ros2_freedrive",
    "robot.ur_rtde": "flangeye_plugins.robot.ur.driver:robot_ur_rtde",
    "scanner.genicam": "flangeye_plugins.scanner.genicam:scanner_genicam",
    "scanner.azure_kinect": "flangeye_plugins.scanner.azure_kinect:scanner_azure_kinect",
    "scanner.realsense": "flangeye_plugins.scanner.realsense:scanner_realsense",
    "scanner.zivid": "flangeye_plugins.scanner.zivid:scanner_zivid",
    "scanner.mech_eye": "flangeye_plugins.scanner.mech_eye:scanner_mech_eye",
    "scanner.ros2": "flangeye_plugins.scanner.ros2:scanner_ros2",
    "scanner.watched_folder": "flangeye_plugins.scanner.watched_folder:scanner_watched_folder",
    "replay.tactile": "flangeye_plugins.replay:replay_tactile",
    "guide.tactile": "flangeye_plugins.guide:guide_tactile",
    "guide.tool": "flangeye_plugins.guide:guide_tool",
    "arc.manual": "flangeye_plugins.arc:arc_manual",
    "arc.ur_digital": "flangeye_plugins.arc:arc_ur_digital",
    "profiler.tcp": "flangeye_plugins.profiler:profiler_tcp",
    "sensor.opencv": "flangeye_plugins.sensor:sensor_opencv",
    "sensor.image_folder": "flangeye_plugins.sensor:sensor_image_folder",
    "sensor.mcap": "flangeye_plugins.sensor:sensor_mcap",
}


@hookimpl
def flangeye_stages() -> Mapping[str, str]:
    """Offer the built-in stages."""
    return STAGES


@hookimpl
def flangeye_parts() -> Mapping[str, str]:
    """Offer the built-in parts."""
    return PARTS


@hookimpl
def flangeye_graphs() -> Mapping[str, Callable[[], Graph]]:
    """Offer ROS 2."""
    return {"ros2": _ros2}


def _ros2() -> Graph:
    from flangeye_plugins.ros2.graph import Ros2Graph

    return Ros2Graph()

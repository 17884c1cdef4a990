# mypy: ignore-errors
"""A camera's driver as its maker publishes it, looking at a simulated cell around where the arm is.

``realsense``: points of 20 bytes with a padded rgb, not organised, best effort, running by itself.
``zivid``: organised xyzrgba with NaN, reliable, captured by a service. ``phoxi``: organised, zeros
where nothing was measured, captured by a service. ``depth``: 16-bit millimetres with CameraInfo.
``image``: a ChArUco board on the flange as JPEG with CameraInfo; with ``in_hand`` the camera is on
the flange, and the board where it stands otherwise. ``empty``: triggered by a topic.
Their CameraInfo comes after the image; with ``triggered`` there is none before the first scan. With
``production`` the cell's own program captures, as soon as the arm stands at a new place.
"""

import json
import os
import sys
import threading
import time
from contextlib import suppress

import numpy as np
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState, PointCloud2, PointField
from std_msgs.msg import Empty
from std_srvs.srv import Trigger

from flangeye.maths.kinematics import Arm
from flangeye.models.boards import Board
from flangeye.models.loading import load_model
from flangeye.types import CAMERA, PointCloud
from flangeye.types.geometry import invert, rigid, rotation_exp
from flangeye_emulators.scanner import CellScene, TrueStance
from flangeye_emulators.world.board_image import BoardCamera, render_board
from flangeye_emulators.world.scanner import CameraPose, scanner_of
from flangeye_plugins.acquire.camera import image_of_cloud
from tests.plugins.ros2.peers.node import SENSOR, rclpy, say, serve

BOARD = Board("charuco", 6, 5, 0.018, 0.013, "4X4_50")
FLANGE_T_BOARD = rigid(np.eye(3), np.array([-0.05, -0.04, 0.01]))
FLANGE_T_CAMERA = rigid(rotation_exp(np.array([0.02, -0.03, 0.4])), np.array([0.06, 0.02, 0.05]))
LENS = BoardCamera(
    np.array([[1400.0, 0, 639.5], [0, 1400.0, 511.5], [0, 0, 1]]),
    (1280, 1024),
    np.zeros(5),
    0.7,
    2.0,
    0.2,
)
PERIOD = 0.1


class Camera:
    def __init__(self, node, options):
        self.node, self.options = node, options
        robot = load_model("robots", options["robot"])
        self.scanner = load_model("scanners", options["scanner"])
        rng = np.random.default_rng(options["seed"])
        self.base_T_camera = CameraPose().matrix
        self.base_T_camera[:3, 3] += options["moved"]
        eye = scanner_of(self.scanner, options["resolution"], 1.0, rng)
        self.scene = CellScene(robot, eye, self.base_T_camera, np.array([0.3, 0.3, 0.2]))
        self.arm, self.joints, self.count, self.seen = Arm(robot), None, 0, (None, None)
        self.offset, self.silent, self.now, self.scale, self.spoilt = 0.0, False, None, 1.0, {}
        self.stamped = True
        self.look(np.radians(options["joints"]))  # what is loaded for the first scan takes seconds
        node.create_subscription(JointState, "/truth", self.hears, 10)
        if options["sim_time"]:
            node.create_subscription(Clock, "/clock", self.ticks, 10)
        space, kind = options["namespace"], options["layout"]
        self.point_topic = f"{space}/points"
        if kind in ("depth", "image"):
            self.info = node.create_publisher(CameraInfo, f"{space}/camera_info", 10)
        form = {"depth": Image, "image": CompressedImage}.get(kind, PointCloud2)
        name = {"depth": f"{space}/image_rect_raw", "image": f"{space}/image_raw/compressed"}
        self.out = node.create_publisher(
            form, name.get(kind, self.point_topic), SENSOR if kind == "realsense" else 10
        )
        if options["production"]:
            threading.Thread(target=self.produces, daemon=True).start()
        elif kind in ("zivid", "phoxi") or options["triggered"]:
            node.create_service(Trigger, f"{space}/capture", self.captures)
        elif kind == "empty":
            node.create_subscription(Empty, f"{space}/trigger", lambda _: self.publish(), 10)
        else:
            threading.Thread(target=self.runs, daemon=True).start()

    def hears(self, message):
        self.joints = np.array(message.position)

    def ticks(self, message):
        self.now = message.clock.sec + 1e-9 * message.clock.nanosec

    def obey(self, words):
        self.offset = words.get("offset", self.offset)
        self.silent = words.get("silent", self.silent)
        self.scale = words.get("scale", self.scale)
        self.stamped = words.get("stamped", self.stamped)
        self.spoilt = words.get("info", self.spoilt)
        if "pose" in words:
            pose = FLANGE_T_CAMERA if self.options["in_hand"] else self.base_T_camera
            say(pose=pose.tolist(), count=self.count)

    def captures(self, _, answer):
        if self.options["refuses"]:
            answer.success, answer.message = False, self.options["refuses"]
            return answer
        threading.Thread(target=self.publish, daemon=True).start()
        answer.success = True
        return answer

    def runs(self):
        while True:
            began = time.monotonic()
            self.publish()
            time.sleep(max(0.0, PERIOD - (time.monotonic() - began)))

    def produces(self):
        before = None
        while True:
            joints = self.joints
            time.sleep(0.1)
            stands = joints is not None and np.abs(self.joints - joints).max() < 1e-6
            if stands and (before is None or np.abs(joints - before).max() > 0.02):
                before = joints
                self.publish()

    def publish(self):
        while self.joints is None or (self.options["sim_time"] and self.now is None):
            time.sleep(0.01)
        stamp = self.now if self.options["sim_time"] else time.time()
        joints = self.joints
        if self.seen[0] is None or np.abs(self.seen[0] - joints).max() > 1e-7:
            self.seen = joints, self.look(joints)
        if np.abs(self.joints - joints).max() > 1e-4:
            self.seen = (
                joints,
                self.seen[1] * np.nan if self.options["layout"] != "image" else self.seen[1],
            )
        message = getattr(self, f"as_{self.options['layout']}")(self.seen[1])
        if self.silent:
            return
        self.count += 1
        stamp = (stamp + self.offset) * self.stamped
        for each in message:
            each.header.stamp.sec, each.header.stamp.nanosec = int(stamp), int(stamp % 1 * 1e9)
            each.header.frame_id = f"{self.options['prefix']}optical_frame"
            (self.info if isinstance(each, CameraInfo) else self.out).publish(each)

    def look(self, joints):
        pose = self.arm.flange(joints)
        if self.options["layout"] == "image":
            if self.options["in_hand"]:
                eye, holder = pose @ FLANGE_T_CAMERA, self.base_T_camera
            else:
                eye, holder = self.base_T_camera, pose
            target = invert(eye) @ holder @ FLANGE_T_BOARD
            # The board faces the camera: its z points towards it.
            return render_board(BOARD, target, LENS, np.random.default_rng(self.count)).pixels
        return self.scene.scan([TrueStance(joints, pose)], (self.options["seed"], self.count))

    # --- layouts

    def cloud(self, xyz, step, colour, fields=("x", "y", "z")):
        points = np.zeros(xyz.shape[:-1], np.dtype({
            "names": ["x", "y", "z", "colour"], "formats": ["<f4"] * 3 + ["<u4"],
            "offsets": [0, 4, 8, colour[1]], "itemsize": step,
        }))  # fmt: skip
        for i, name in enumerate(fields):
            points[name] = xyz[..., i] * self.scale
        message = PointCloud2(height=1, is_bigendian=False, point_step=step)
        if xyz.ndim == 3:
            message.height = xyz.shape[0]
        message.width = xyz.shape[-2]
        message.row_step = message.width * step
        message.fields = [
            PointField(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate(fields)
        ]
        message.fields.append(PointField(name=colour[0], offset=colour[1], datatype=7, count=1))
        message.data = points.tobytes()
        return [message]

    def as_realsense(self, xyz):
        return self.cloud(xyz[np.isfinite(xyz).all(axis=-1)], 20, ("rgb", 16))

    def as_zivid(self, xyz):
        return self.cloud(xyz, 16, ("rgba", 12))

    def as_phoxi(self, xyz):
        return self.cloud(np.nan_to_num(xyz), 32, ("rgb", 16))

    as_empty = as_zivid

    def as_depth(self, xyz):
        if not hasattr(self, "lens"):
            self.lens = image_of_cloud(
                np.zeros(xyz.shape[:2], np.uint8), PointCloud(CAMERA, xyz)
            ).camera_matrix
        depth = np.nan_to_num(1e3 * xyz[..., 2]).round().astype("<u2")
        image = Image(
            height=depth.shape[0], width=depth.shape[1], encoding="16UC1", step=2 * depth.shape[1]
        )
        image.data = depth.tobytes()
        return [image, self.as_info(self.lens, depth.shape)]

    def as_image(self, pixels):
        import cv2

        image = CompressedImage(format="jpeg", data=cv2.imencode(".jpg", pixels)[1].tobytes())
        return [image, self.as_info(LENS.camera_matrix, pixels.shape)]

    def as_info(self, matrix, shape):
        info = CameraInfo(height=shape[0], width=shape[1], distortion_model=self.options["lens"])
        info.k, info.d = matrix.ravel().tolist(), [0.0] * 5
        info.p = np.pad(matrix, ((0, 0), (0, 1))).ravel().tolist()
        for name, value in self.spoilt.items():
            setattr(info, name, value)
        return info


def main():
    options = json.loads(sys.argv[1])
    with suppress(OSError):  # a real camera has a computer of its own
        os.nice(-20)
    rclpy.init()
    node = rclpy.create_node("camera", namespace=options["namespace"] or "/")
    serve(node, Camera(node, options).obey)


if __name__ == "__main__":
    main()

"""ROS 2 bags for tests, written by rosbags: an arm that stops, and what a camera saw there."""

import cv2
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from flangeye.maths.streams import interpolated
from flangeye.types.geometry import rigid

STORE = get_typestore(Stores.ROS2_HUMBLE)
T = STORE.types
START = 1_700_000_000.0
UR = ("elbow_joint", "shoulder_lift_joint", "shoulder_pan_joint", "wrist_1_joint", "wrist_2_joint",
      "wrist_3_joint")  # fmt: skip
"""As UR's driver publishes them: by alphabet."""


def stamp(t):
    return T["builtin_interfaces/msg/Time"](int(t // 1), int(t % 1 * 1e9))


def header(t, frame=""):
    return T["std_msgs/msg/Header"](stamp(t), frame)


def vector(v):
    return T["geometry_msgs/msg/Vector3"](*map(float, v))


def quaternion(rotation):
    return T["geometry_msgs/msg/Quaternion"](*Rotation.from_matrix(rotation).as_quat())


def tf(t, *transforms):
    """``(parent, child, pose)`` each."""
    made = [
        T["geometry_msgs/msg/TransformStamped"](
            header(t, parent), child,
            T["geometry_msgs/msg/Transform"](vector(pose[:3, 3]), quaternion(pose[:3, :3])),
        )
        for parent, child, pose in transforms
    ]  # fmt: skip
    return T["tf2_msgs/msg/TFMessage"](made)


def pose_stamped(t, pose):
    place = T["geometry_msgs/msg/Point"](*map(float, pose[:3, 3]))
    return T["geometry_msgs/msg/PoseStamped"](
        header(t), T["geometry_msgs/msg/Pose"](place, quaternion(pose[:3, :3]))
    )


def joint_state(t, angles):
    none = np.zeros(0)
    order = [2, 1, 0, 3, 4, 5]
    return T["sensor_msgs/msg/JointState"](
        header(t), list(UR), np.array(angles, float)[order], none, none
    )


def point_cloud(t, xyz):
    """Points with an intensity between them, and rows longer than their points."""
    grid = np.asarray(xyz, dtype=np.float32)
    grid = grid if grid.ndim == 3 else grid[None]
    data = np.zeros((*grid.shape[:2], 5), dtype=np.float32)
    data[..., 0], data[..., 2], data[..., 3] = grid[..., 0], grid[..., 1], grid[..., 2]
    fields = [
        T["sensor_msgs/msg/PointField"](name, offset, 7, 1)
        for name, offset in (("x", 0), ("intensity", 4), ("y", 8), ("z", 12))
    ]
    padded = np.pad(data.view(np.uint8).reshape(len(data), -1), ((0, 0), (0, 7)))
    return T["sensor_msgs/msg/PointCloud2"](
        header(t, "camera"), *grid.shape[:2], fields, False, 20, padded.shape[1],
        padded.ravel(), False,
    )  # fmt: skip


def image(t, pixels):
    return T["sensor_msgs/msg/Image"](
        header(t, "camera"), *pixels.shape, "mono8", 0, pixels.shape[1], pixels.ravel()
    )


def compressed(t, pixels):
    png = cv2.imencode(".png", pixels)[1].ravel()
    return T["sensor_msgs/msg/CompressedImage"](header(t, "camera"), "png", png)


def camera_info(t, matrix, shape, frame=""):
    region = T["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return T["sensor_msgs/msg/CameraInfo"](
        header(t, frame), *shape, "plumb_bob", np.zeros(5), matrix.ravel(), np.eye(3).ravel(),
        np.zeros(12), 0, 0, region,
    )  # fmt: skip


def write_bag(path, storage, told):
    """Write ``(topic, time, message)`` into a bag."""
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        links = {}
        for topic, t, message in sorted(told, key=lambda each: each[1]):
            kind = message.__msgtype__
            if topic not in links:
                links[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(links[topic], round(t * 1e9), STORE.serialize_cdr(message, kind))
    return path


def stops(poses, hold=1.0, way=0.8, rate=50.0):
    """Return times and poses of an arm that stops at each pose, and the middle of each stop."""
    corners = [START + i * (hold + way) for i in range(len(poses))]
    knots = np.ravel([[c, c + hold] for c in corners])
    held = np.repeat(poses, 2, axis=0)
    times = np.arange(knots[0], knots[-1], 1 / rate)
    return times, interpolated(knots, held, times), np.array(corners) + hold / 2


FIXED = rigid(Rotation.from_euler("z", 180, degrees=True).as_matrix(), np.zeros(3))
"""``base_link_T_base`` as UR's driver has it."""

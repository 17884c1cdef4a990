"""Clouds and images as drivers pack them, without ROS."""

import numpy as np
import pytest

from flangeye import StageError
from flangeye.models.graph import Topic
from flangeye_plugins.ros2.client import GraphMessage
from flangeye_plugins.ros2.graph import ReceivedTopic, unit_of
from flangeye_plugins.ros2.messages import (
    Type,
    cloud_of,
    encoded,
    message,
    positions_of,
    values_of,
)

HEADER = message(
    "std_msgs/msg/Header",
    stamp=message("builtin_interfaces/msg/Time", sec=1, nanosec=0), frame_id="eye",
)  # fmt: skip
XYZ = np.arange(18, dtype=np.float32).reshape(2, 3, 3)


def cloud(order="<", pad=0, step=None, shape=(2, 3), spare=0):
    rows = XYZ.reshape(*shape, 3).astype(f"{order}f4").view(np.uint8).reshape(shape[0], -1)
    data = np.pad(rows, ((0, 0), (0, pad)))
    fields = [
        message("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=7, count=1)
        for i, name in enumerate("xyz")
    ]
    return message(
        "sensor_msgs/msg/PointCloud2", header=HEADER, height=shape[0], width=shape[1],
        fields=fields, is_bigendian=order == ">", point_step=12,
        row_step=data.shape[1] if step is None else step, is_dense=True,
        data=np.append(data.ravel(), np.zeros(spare, np.uint8)),
    )  # fmt: skip


@pytest.mark.parametrize(
    "given",
    [{}, {"order": ">"}, {"pad": 5}, {"step": 0}, {"step": 12}, {"step": 72}],
)
def test_a_cloud_is_read_however_its_rows_are_packed(given):
    assert np.array_equal(cloud_of(cloud(**given)), XYZ)


@pytest.mark.parametrize("shape", [(1, 6), (6, 1)])
def test_a_cloud_of_one_row_or_column_is_not_organised(shape):
    assert np.array_equal(cloud_of(cloud(shape=shape)), XYZ.reshape(6, 3))


def test_a_cloud_whose_size_and_bytes_differ_is_refused():
    with pytest.raises(StageError, match=r"it has 79 bytes, and 2 rows of 36 bytes \(step 36\)"):
        cloud_of(cloud(spare=7))


@pytest.mark.parametrize(
    ("scale", "said"),
    [(0.1, None), (100.0, "points are 707.1 away (median), which are millimetres; ROS 2 has metres"),
     (1e5, "/eye/points: median distance 7.07e+05 fits neither m nor mm")],
)  # fmt: skip
def test_init_warns_of_a_cloud_that_is_not_in_metres(scale, said):
    given = cloud()
    points = np.vstack([scale * XYZ.reshape(-1, 3)[:3], np.zeros((3, 3))]).astype("<f4")
    given.data = points.view(np.uint8).ravel()
    newest = GraphMessage(1, 0, 0, encoded(given))
    warnings = unit_of(
        ReceivedTopic(Topic("/eye/points", Type.CLOUD, ("eye",), 0), 10.0, newest, {})
    )
    assert len(warnings) == (said is not None)
    assert all(line.startswith("warning: /eye/points: ") and said in line for line in warnings)


@pytest.mark.parametrize(("order", "step"), [("<", 10), (">", 6), ("<", 0)])
def test_depths_are_read_in_any_order_of_bytes_and_with_padded_rows(order, step):
    depths = np.arange(6).reshape(2, 3).astype(f"{order}u2")
    rows = np.pad(depths.view(np.uint8).reshape(2, 6), ((0, 0), (0, max(step - 6, 0))))
    image = message(
        "sensor_msgs/msg/Image", header=HEADER, height=2, width=3, encoding="16UC1",
        is_bigendian=int(order == ">"), step=step, data=rows.ravel(),
    )  # fmt: skip
    assert np.array_equal(values_of(image), depths)


def test_a_joint_state_of_speeds_alone_has_no_positions():
    def state(*angles):
        kind, nothing = "sensor_msgs/msg/JointState", np.zeros(0)
        given = {"position": np.array(angles, float), "velocity": np.zeros(2), "effort": nothing}
        return message(kind, header=HEADER, name=["a", "b"], **given)

    assert positions_of(state()) == {}
    assert positions_of(state(1.0, 2.0)) == {"a": 1.0, "b": 2.0}
    with pytest.raises(StageError, match="names 2 joints and has 1 positions"):
        positions_of(state(1.0))

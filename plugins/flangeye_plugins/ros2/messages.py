"""ROS 2 messages without ROS: conversion from and to CDR, and to arrays."""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import StrEnum
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye import StageError
from flangeye.files.images import decode_image
from flangeye.files.words import reason_of
from flangeye.types import Floats, Singles


class Type(StrEnum):
    """Types of the messages and services used."""

    JOINT_STATE = "sensor_msgs/msg/JointState"
    TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
    CLOUD = "sensor_msgs/msg/PointCloud2"
    IMAGE = "sensor_msgs/msg/Image"
    COMPRESSED = "sensor_msgs/msg/CompressedImage"
    INFO = "sensor_msgs/msg/CameraInfo"
    TF = "tf2_msgs/msg/TFMessage"
    POSE = "geometry_msgs/msg/PoseStamped"
    CLOCK = "rosgraph_msgs/msg/Clock"
    TEXT = "std_msgs/msg/String"
    EMPTY = "std_msgs/msg/Empty"
    TRIGGER = "std_srvs/srv/Trigger"


SHORTEST = 12
"""A message with a time has four bytes of encapsulation, seconds and nanoseconds."""
PIXEL_TYPES = {"mono8": ("u1", 1), "8UC1": ("u1", 1), "mono16": ("u2", 1), "16UC1": ("u2", 1),
          "32FC1": ("f4", 1), "rgb8": ("u1", 3), "bgr8": ("u1", 3), "8UC3": ("u1", 3),
          "rgba8": ("u1", 4), "bgra8": ("u1", 4)}  # fmt: skip
"""Encodings of ``sensor_msgs/Image`` that are read: type and channels."""
DEPTH_UNITS = {"16UC1": 1000.0, "mono16": 1000.0, "32FC1": 1.0}
"""Encodings of depth images: units in a metre (REP 118)."""


def stamp_of(data: bytes) -> int:
    """Return ``header.stamp`` [ns] of a message that begins with a header or time; 0 if unset."""
    if len(data) < SHORTEST:
        return 0
    seconds, nanoseconds = struct.unpack_from(f"{_order(data)}iI", data, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def frame_of(data: bytes) -> str:
    """Return ``header.frame_id`` of a message that begins with a header."""
    if len(data) < SHORTEST + 4:
        return ""
    (length,) = struct.unpack_from(f"{_order(data)}I", data, SHORTEST)
    text = data[SHORTEST + 4 : SHORTEST + 4 + length]
    return text.rstrip(b"\0").decode("utf-8", "replace").lstrip("/")


def _order(data: bytes) -> str:
    return "<" if data[1] & 1 else ">"


@cache
def types() -> Any:
    """Return the store of message types; the four supported distributions agree on those used.

    Raises:
        StageError: The extra ``ros`` is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        missing = "ROS 2 messages need the extra 'ros': pip install 'flangeye[ros]'"
        raise StageError(missing) from None
    return get_typestore(Stores.ROS2_HUMBLE)


def decoded(data: bytes, kind: str, use: Callable[[Any], Any] = lambda message: message) -> Any:
    """Return the result of a function on a deserialised message.

    Raises:
        StageError: The message is damaged, or not of this type.
    """
    try:
        return use(types().deserialize_cdr(data, kind))
    except StageError:
        raise
    except Exception as error:  # damaged bytes can break the library, and its use, in any way
        raise StageError(f"a message is not a valid {kind}: {reason_of(error)}") from None


def encoded(message: Any) -> bytes:
    """Return a message serialised."""
    return bytes(types().serialize_cdr(message, message.__msgtype__))


def message(kind: str, **fields: Any) -> Any:
    """Return a new message of a type."""
    return types().types[kind](**fields)


def positions_of(message: Any) -> dict[str, float]:
    """Return the positions of a ``sensor_msgs/JointState`` by joint; empty without positions.

    Raises:
        StageError: The message has fewer positions than names.
    """
    names, positions = list(message.name), message.position.tolist()
    if positions and len(positions) != len(names):
        raise StageError(
            f"a joint state names {len(names)} joints and has {len(positions)} positions"
        )
    return dict(zip(names, positions, strict=False))


def cloud_of(message: Any) -> Singles:
    """Return the points of a ``sensor_msgs/PointCloud2``, (H, W, 3) if organised, else (N, 3) [m].

    Raises:
        StageError: The cloud has no x, y and z.
    """
    fields = {f.name: f for f in message.fields}
    if not {"x", "y", "z"} <= set(fields):
        raise StageError(f"a PointCloud2 without x, y, z: it has {', '.join(fields) or 'nothing'}")
    order = ">" if message.is_bigendian else "<"
    # Datatypes of sensor_msgs/PointField
    numbers = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
    kind = np.dtype(
        {
            "names": list("xyz"),
            "formats": [order + numbers[fields[axis].datatype] for axis in "xyz"],
            "offsets": [fields[axis].offset for axis in "xyz"],
            "itemsize": message.point_step,
        }
    )
    used = _rows_of(message, message.width * message.point_step, message.row_step)
    points = used.reshape(-1).view(kind)
    xyz = np.stack([points[axis].astype(np.float32) for axis in "xyz"], axis=-1)
    organised = min(message.height, message.width) > 1
    return xyz.reshape(message.height, message.width, 3) if organised else xyz


def _rows_of(message: Any, row: int, step: int) -> NDArray[np.uint8]:
    """Return the bytes (H, row) of a cloud or an image without the padding of its rows.

    Some drivers state a wrong step; rows that exactly fill the message are not padded.

    Raises:
        StageError: The number of bytes does not match the size.
    """
    data = np.frombuffer(bytes(message.data), np.uint8)
    step = row if len(data) == message.height * row else step
    if len(data) != message.height * step or step < row:
        raise StageError(
            f"it has {len(data)} bytes, and {message.height} rows of {row} bytes (step {step})"
        )
    return np.ascontiguousarray(data.reshape(message.height, step)[:, :row])


def intrinsics_of(message: Any, rectified: bool = False) -> tuple[Floats, Floats]:
    """Return camera matrix (3, 3) and distortion (k,) of a ``sensor_msgs/CameraInfo``.

    Args:
        message: The CameraInfo.
        rectified: Whether the images are rectified; the camera is then that of P, without
            distortion.
    """
    k, d, p = (
        np.array(getattr(message, name if hasattr(message, name) else name.upper()), dtype=float)
        for name in "kdp"
    )
    if rectified and p.any():
        return p.reshape(3, 4)[:, :3], np.zeros(0)
    return k.reshape(3, 3), d


def values_of(message: Any) -> NDArray[Any]:
    """Return the pixels of a ``sensor_msgs/Image``: (H, W) or (H, W, channels), unconverted.

    Raises:
        StageError: The image's encoding is not known.
    """
    if message.encoding not in PIXEL_TYPES:
        known = ", ".join(PIXEL_TYPES)
        raise StageError(f"an image of encoding '{message.encoding}'; known: {known}")
    name, channels = PIXEL_TYPES[message.encoding]
    kind = np.dtype((">" if message.is_bigendian else "<") + name)
    row = message.width * channels * kind.itemsize
    pixels = _rows_of(message, row, message.step).view(kind)
    return pixels.reshape(message.height, message.width, channels).squeeze(
        axis=2 if channels == 1 else ()
    )


def pixels_of(message: Any) -> Any:
    """Return the pixels of a ``sensor_msgs/Image`` as 8-bit grey or BGR.

    Those of a ``CompressedImage`` are grey.

    Raises:
        StageError: The image's encoding is not known.
        ImageError: The compressed image is damaged.
    """
    if hasattr(message, "format"):
        import cv2

        return decode_image(bytes(message.data), cv2.IMREAD_GRAYSCALE)
    pixels = values_of(message)
    if pixels.ndim == 3:
        pixels = pixels[:, :, :3]
    if pixels.dtype.kind == "f":
        raise StageError(f"an image of encoding '{message.encoding}' holds depths, not an image")
    if pixels.dtype.itemsize == 2:
        pixels = (pixels / max(int(pixels.max()), 1) * 255).astype(np.uint8)
    return pixels[..., ::-1] if message.encoding.startswith("rgb") else pixels

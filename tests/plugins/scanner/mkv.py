"""Writes Azure Kinect recordings with the SDK's own recorder, without a camera."""

from __future__ import annotations

import ctypes
import json
from pathlib import Path

import numpy as np

DEPTH16, BGRA32 = 4, 3
ROWS, COLUMNS = 576, 640
"""Of the depth image in the mode NFOV_UNBINNED."""


class Config(ctypes.Structure):
    _fields_ = [
        *((n, ctypes.c_int32) for n in ("color_format", "color_resolution", "depth_mode", "fps")),
        ("synchronized", ctypes.c_bool),
        ("delay", ctypes.c_int32),
        ("wired", ctypes.c_int32),
        ("subordinate", ctypes.c_uint32),
        ("no_led", ctypes.c_bool),
    ]


def camera(location, purpose, width, height, intrinsics, translation):
    return {
        "Intrinsics": {
            "ModelParameterCount": 14,
            "ModelParameters": intrinsics + [0] * 10,
            "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
        },
        "Location": f"CALIBRATION_CameraLocation{location}",
        "Purpose": f"CALIBRATION_CameraPurpose{purpose}",
        "MetricRadius": 1.74,
        "Rt": {"Rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "Translation": translation},
        "SensorHeight": height,
        "SensorWidth": width,
        "Shutter": "CALIBRATION_ShutterTypeUndefined",
        "ThermalAdjustmentParams": {"Params": [0] * 12},
    }


def inertial(kind):
    return {
        "BiasTemperatureModel": [0] * 12,
        "BiasUncertainty": [0] * 3,
        "Id": "CALIBRATION_InertialSensorId_LSM6DSM",
        "MixingMatrixTemperatureModel": (
            [1, 0, 0, 0] + [0] * 12 + [1, 0, 0, 0] + [0] * 12 + [1, 0, 0, 0]
        )[:36],
        "ModelTypeMask": 16,
        "Noise": [0] * 6,
        "Rt": {"Rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "Translation": [0, 0, 0]},
        "SecondOrderScaling": [0] * 9,
        "SensorType": f"CALIBRATION_InertialSensorType_{kind}",
        "TemperatureBounds": [5, 60],
        "TemperatureC": 0,
    }


CALIBRATION = {
    "CalibrationInformation": {
        "Cameras": [
            camera("D0", "Depth", 1024, 1024, [0.5, 0.5, 0.49, 0.49], [0, 0, 0]),
            camera("PV0", "PhotoVideo", 4096, 3072, [0.5, 0.5, 0.45, 0.6], [-0.032, 0, 0]),
        ],
        "InertialSensors": [inertial("Gyro"), inertial("Accelerometer")],
        "Metadata": {
            "SerialId": "000000000000",
            "FactoryCalDate": "1/1/2020",
            "Version": {"Major": 1, "Minor": 2},
            "DeviceName": "AzureKinect",
            "Notes": "PV0_max_radius_invalid",
        },
    }
}  # fmt: skip


class Recorder:
    """The SDK's libraries, as the wheel of pyk4a-bundle brings them."""

    def __init__(self, libraries: Path):
        self.k4a = ctypes.CDLL(str(next(libraries.glob("libk4a-*"))))
        self.record = ctypes.CDLL(str(next(libraries.glob("libk4arecord-*"))))
        self.k4a.k4a_image_get_buffer.restype = ctypes.c_void_p

    def write(self, path, depths, colours=None):
        """Record depth images (576, 640) [mm], and colour images (720, 1280, 4) BGRA."""
        handle = ctypes.c_void_p()
        config = Config(
            BGRA32, 0 if colours is None else 1, 2, 2, colours is not None, 0, 0, 0, False
        )
        self._do("create", str(path).encode(), ctypes.c_void_p(None), config, ctypes.byref(handle))
        calibration = json.dumps(CALIBRATION).encode() + b"\0"
        size = ctypes.c_size_t(len(calibration))
        self._do("add_attachment", handle, b"calibration.json", calibration, size)
        self._do("add_tag", handle, b"K4A_CALIBRATION_FILE", b"calibration.json")
        self._do("write_header", handle)
        for index, depth in enumerate(depths):
            self._write_capture(handle, index, depth, None if colours is None else colours[index])
        self._do("flush", handle)
        self.record.k4a_record_close(handle)

    def _do(self, what, *arguments):
        assert getattr(self.record, f"k4a_record_{what}")(*arguments) == 0, what

    def _write_capture(self, handle, index, depth, colour):
        capture = ctypes.c_void_p()
        assert self.k4a.k4a_capture_create(ctypes.byref(capture)) == 0
        self._attach(capture, index, "depth", DEPTH16, depth.astype(np.uint16))
        if colour is not None:
            self._attach(capture, index, "color", BGRA32, colour)
        self._do("write_capture", handle, capture)
        self.k4a.k4a_capture_release(capture)

    def _attach(self, capture, index, name, kind, pixels):
        image = ctypes.c_void_p()
        rows, columns = pixels.shape[:2]
        stride = pixels.strides[0]
        assert self.k4a.k4a_image_create(kind, columns, rows, stride, ctypes.byref(image)) == 0
        ctypes.memmove(self.k4a.k4a_image_get_buffer(image), pixels.tobytes(), pixels.nbytes)
        self.k4a.k4a_image_set_device_timestamp_usec(image, ctypes.c_uint64(33_333 * index))
        getattr(self.k4a, f"k4a_capture_set_{name}_image")(capture, image)
        self.k4a.k4a_image_release(image)

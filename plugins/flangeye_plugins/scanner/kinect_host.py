"""Process that runs an Azure Kinect, or its recording; see ``azure_kinect.py``.

It runs under any Python that has pyk4a, without flangeye: libk4a may abort its process, and the
wheel of pyk4a needs NumPy 1. For each line ``next`` on standard input it answers on standard output
with one line of JSON, followed by the arrays named in it.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any, BinaryIO


class NoDepthError(Exception):
    """A capture has no depth image."""


def main() -> None:
    """Open the device that the first argument describes; answer requests until the input ends."""
    # libk4a logs to standard output.
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    asked = json.loads(sys.argv[1])
    try:
        source, facts = _recording(asked) if asked["recording"] else _device(asked)
    except Exception as error:
        _say(out, {"error": f"{type(error).__name__}: {error}"})
        return
    _say(out, {"facts": facts})
    for _ in sys.stdin:
        try:
            _answer(out, source)
        except NoDepthError:
            _say(out, {"error": "a capture without a depth image", "dropped": True})
        except EOFError:
            _say(out, {"error": "the recording has ended"})
        except Exception as error:
            _say(out, {"error": f"{type(error).__name__}: {error}"})


def _recording(asked: dict[str, Any]) -> tuple[Any, dict[str, str]]:
    from pyk4a import PyK4APlayback

    playback = PyK4APlayback(asked["recording"])
    playback.open()
    settings = playback.configuration
    facts = {"depth mode": settings["depth_mode"].name, "seconds": f"{playback.length * 1e-6:g}"}
    if settings["color_track_enabled"]:
        facts["colour"] = settings["color_format"].name

    def following() -> Any:
        capture = playback.get_next_capture()
        while capture.depth is None:  # the colour camera starts earlier
            capture = playback.get_next_capture()
        return capture

    return following, facts


def _device(asked: dict[str, Any]) -> tuple[Any, dict[str, str]]:
    import pyk4a

    count = pyk4a.connected_device_count()
    if asked["device"] >= count:
        raise LookupError(f"{count} Azure Kinects are connected")
    camera = pyk4a.PyK4A(
        pyk4a.Config(depth_mode=pyk4a.DepthMode[asked["depth_mode"]]), asked["device"]
    )
    camera.start()

    def fresh() -> Any:
        began = time.perf_counter_ns()
        while True:
            capture = camera.get_capture(timeout=asked["timeout_ms"])
            if capture.depth is None:
                raise NoDepthError
            # A frame of the running camera is a new one when it came so long after it was asked
            # for: one frame's period at 30 Hz, and the longest exposure
            if capture.depth_system_timestamp_nsec - began > 50_000_000:
                return capture

    return fresh, {"serial": camera.serial, "depth mode": asked["depth_mode"]}


def _answer(out: BinaryIO, source: Any) -> None:
    capture = source()
    depth, colour = capture.depth, _colour(capture)
    calibration = _calibration(capture._calibration, colour is not None)
    answer = {"depth": depth.shape, "calibration": calibration}
    if colour is not None:
        answer["colour"] = colour.shape
    _say(out, answer, depth.tobytes(), b"" if colour is None else colour.tobytes())


def _calibration(calibration: Any, coloured: bool) -> dict[str, Any]:
    """Return the device's factory calibration of both cameras and the pose between them."""
    from pyk4a import CalibrationType

    depth, colour = CalibrationType.DEPTH, CalibrationType.COLOR
    values: dict[str, Any] = {
        "matrix": calibration.get_camera_matrix(depth).tolist(),
        "distortion": calibration.get_distortion_coefficients(depth).tolist(),
    }
    if coloured:
        rotation, translation = calibration.get_extrinsic_parameters(depth, colour)
        values["colour"] = {
            "matrix": calibration.get_camera_matrix(colour).tolist(),
            "distortion": calibration.get_distortion_coefficients(colour).tolist(),
            "rotation": rotation.tolist(),
            "translation": translation.ravel().tolist(),
        }
    return values


def _colour(capture: Any) -> Any:
    """Return the colour image (H, W, 4) as BGRA; None without one."""
    from pyk4a import ImageFormat

    colour = capture.color
    if colour is not None and capture._color_format == ImageFormat.COLOR_MJPG:
        return _unpacked(colour)
    return colour if capture._color_format == ImageFormat.COLOR_BGRA32 else None


def _unpacked(jpeg: Any) -> Any:
    try:
        import cv2
    except ImportError:
        return None
    image = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2BGRA)


def _say(out: BinaryIO, answer: dict[str, Any], *arrays: bytes) -> None:
    out.write(json.dumps(answer).encode() + b"\n")
    for array in arrays:
        out.write(array)
    out.flush()


if __name__ == "__main__":
    main()

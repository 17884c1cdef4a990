"""``scanner.ros2``: any camera that publishes clouds, depth images or images under ROS 2."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from pydantic import model_validator

from flangeye.devices import DeviceError, FrameDropped, Scan, Scanner
from flangeye.errors import StageError
from flangeye.models.graph import Topic
from flangeye.models.scanners import ScannerModel
from flangeye.plugin.stage import Params, part
from flangeye.types import Floats, Image
from flangeye_plugins.ros2.client import Bridge, GraphMessage
from flangeye_plugins.ros2.messages import (
    DEPTH_UNITS,
    Type,
    cloud_of,
    decoded,
    frame_of,
    intrinsics_of,
    pixels_of,
    values_of,
)
from flangeye_plugins.scanner.opened import DepthView, OpenScanner

NAME = "scanner.ros2"


class Ros2ScannerParams(Params):
    """Parameters of ``scanner.ros2``: topic of a cloud, a depth image, or an image only."""

    cloud: str | None = None
    """Topic of the clouds (PointCloud2)."""
    depth: str | None = None
    """Topic of depth images (Image), not of clouds."""
    image: str | None = None
    """Topic of images (Image, CompressedImage), for markers; of the same camera as the depths, or
    alone."""
    camera_info: str | None = None
    """CameraInfo of depth or image; camera_info beside them if not given."""
    trigger: str | None = None
    """Service (std_srvs/Trigger) or topic (std_msgs/Empty) that takes a scan; without one the
    camera runs by itself."""
    sim_time: bool = False
    """Stamps are simulated time, of the topic /clock."""

    @model_validator(mode="after")
    def _looks_at_something(self) -> Ros2ScannerParams:
        if self.cloud and self.depth:
            raise ValueError("give either cloud or depth, not both")
        if not (self.cloud or self.depth or self.image):
            raise ValueError(
                "name a topic: cloud: /camera/points ('flangeye init --ros2' lists what runs)"
            )
        return self

    @property
    def timeout(self) -> float:
        """Longest wait for a scan [s]; a triggered scan may take several exposures."""
        return 10.0 if self.trigger else 2.5

    @property
    def info(self) -> str:
        """Topic of the CameraInfo."""
        # A compressed image is below the topic of the image, as image_transport names them
        images = str(self.depth or self.image).removesuffix("/compressed")
        return self.camera_info or f"{images.rpartition('/')[0]}/camera_info"


@part("scanner.ros2")
def scanner_ros2(model: ScannerModel | None, params: Ros2ScannerParams) -> Scanner:
    """Any camera with a ROS 2 driver; a scan is the first message stamped after the request.

    Clouds may be organised or not, in any layout. A scan far out of the model's range is refused.

    Raises:
        DeviceError: There is no ROS 2, or the topic has no publisher or another type.
    """
    bridge = Bridge(NAME, params.sim_time)
    try:
        return Ros2Scanner(bridge, model, params)
    except BaseException:
        bridge.close()
        raise


class NothingCame(DeviceError):
    """No message of a topic arrived in time, although its publisher runs."""


class Camera(NamedTuple):
    """A pinhole camera: matrix (3, 3) [px], OpenCV's distortion (k,), and image size (H, W)."""

    matrix: Floats
    distortion: Floats
    shape: tuple[int, int]


class Ros2Scanner(OpenScanner):
    """A camera under ROS 2, by its topics."""

    def __init__(
        self, bridge: Bridge, model: ScannerModel | None, params: Ros2ScannerParams
    ) -> None:
        """Subscribe to the camera's topics.

        Raises:
            DeviceError: A topic is not published, or a needed message does not arrive.
        """
        self._bridge, self._params = bridge, params
        self._kinds: dict[str, str] = {}
        for topic, kinds in (
            (params.cloud, [Type.CLOUD]), (params.depth, [Type.IMAGE]),
            (params.image, [Type.IMAGE, Type.COMPRESSED]),
        ):  # fmt: skip
            if topic:
                runs = bridge.awaited(partial(_running, bridge, topic))
                self._kinds[topic] = runs.type if runs and runs.type in kinds else kinds[0]
                # On request only, as a camera's whole stream is large
                bridge.follow(topic, self._kinds[topic], always=False)
        self._looks = bool(params.depth or params.image)
        if self._looks:
            bridge.follow(params.info, Type.INFO)
            if not params.trigger:  # else it may come with the first scan
                self._camera(time.monotonic() + params.timeout)
        self._calls = bool(params.trigger) and self._find_trigger(str(params.trigger))
        super().__init__(f"{params.cloud or params.depth or params.image}", self._facts(), model)

    def expose(self) -> Callable[[], Scan]:
        """Take the first message stamped from now on; the arm must wait until it has arrived."""
        return self._exposed(time.monotonic_ns(), DeviceError)

    def received_scan(self, since_ns: int) -> Callable[[], Scan]:
        """Take a scan triggered by others, stamped after a given time; see ``ReceivesScans``."""
        if self._params.trigger:
            return self.expose()
        return self._exposed(since_ns, FrameDropped)

    def _exposed(self, started: int, silent: type[DeviceError]) -> Callable[[], Scan]:
        """Return a function that waits for the scan.

        It raises ``silent`` if no message arrives although the publisher runs.
        """
        until = time.monotonic() + self._params.timeout
        # Before the trigger, or the answer of a fast camera would be missed
        wanted = {topic: self._bridge.want(topic, started) for topic in self._kinds}
        self._trigger()
        try:
            taken = {t: self._after(t, count, started, until) for t, count in wanted.items()}
        except NothingCame as nothing:
            raise silent(str(nothing)) from None
        ended = max(message.received_ns for message in taken.values())
        camera = self._camera(until) if self._looks else None

        def decode() -> Scan:
            try:
                points, image = self._points(taken, camera), self._image(taken, camera)
                return self._scan(points, 1.0, (started, ended), image)
            except StageError as error:
                raise (
                    error
                    if isinstance(error, DeviceError)
                    else FrameDropped(f"{self.name}: {error}")
                ) from None

        return decode

    def require_alive(self) -> None:
        """Raise DeviceError if the bridge has ended; see ``DetectsLoss``."""
        for topic in self._kinds:
            self._bridge.newest(topic)

    def close(self) -> None:
        """Disconnect from ROS 2."""
        self._bridge.close()

    # --- what is there

    def _camera(self, until: float) -> Camera:
        """Return the camera of the newest CameraInfo; the first one may arrive after the image.

        Raises:
            DeviceError: None arrives in time, or it is not of a calibrated pinhole camera.
        """
        topic = self._params.info
        message = self._bridge.wait(topic, 0, max(until - time.monotonic(), 0.0))
        if message is None:
            raise DeviceError(
                f"{NAME}: nothing came on {topic} within {self._params.timeout:g} s; name its "
                "topic: camera_info: TOPIC"
            )
        # By ROS convention a rectified image says so in its topic, and has a matrix of its own in
        # CameraInfo
        rectified = "rect" in str(self._params.depth or self._params.image).rpartition("/")[2]
        info = decoded(message.data, Type.INFO)
        pinholes = ("", "plumb_bob", "rational_polynomial")  # whose coefficients are OpenCV's
        if info.distortion_model not in pinholes:
            raise DeviceError(
                f"{NAME}: {topic} has the distortion model {info.distortion_model}; known: "
                f"{', '.join(pinholes[1:])}: rectify the images (image_proc) and name those"
            )
        matrix, lens = decoded(message.data, Type.INFO, partial(intrinsics_of, rectified=rectified))
        # Numbers of coefficients that OpenCV takes
        if not (matrix[0, 0] > 0 and matrix[1, 1] > 0 and len(lens) in (0, 4, 5, 8, 12, 14)):
            raise DeviceError(
                f"{NAME}: {topic} has focal lengths of {matrix[0, 0]:g} and {matrix[1, 1]:g} px "
                f"and {len(lens)} distortion coefficients: calibrate the camera "
                "(camera_calibration)"
            )
        return Camera(matrix, lens, (info.height, info.width))

    def _find_trigger(self, trigger: str) -> bool:
        """Return whether the trigger is a service; for a topic, create a publisher.

        Raises:
            DeviceError: The trigger is neither a service nor a topic.
        """
        found = self._bridge.awaited(
            lambda: self._bridge.services().get(trigger) or _running(self._bridge, trigger)
        )
        if found == Type.TRIGGER:
            self._bridge.find(trigger)
            return True
        if not isinstance(found, Topic) or found.type != Type.EMPTY:
            services = self._bridge.services().items()
            known = sorted(name for name, kind in services if kind == Type.TRIGGER)
            raise DeviceError(
                f"{NAME}: {trigger} is neither a service nor a topic of {Type.EMPTY} that runs; "
                f"services of type {Type.TRIGGER}: {', '.join(known) or 'none'}"
            )
        self._bridge.offer(trigger, Type.EMPTY)
        self._bridge.awaited(lambda: self._bridge.listeners(trigger))
        return False

    def _facts(self) -> dict[str, str]:
        trigger = self._params.trigger
        how = f"triggered by {trigger}" if trigger else "runs by itself"
        unit = "m" if not self._params.depth else "as the image's encoding has it"
        return {"unit": unit, "middleware": self._bridge.middleware, "scans": how}

    # --- one scan

    def _trigger(self) -> None:
        if self._params.trigger and self._calls:
            self._bridge.trigger(self._params.trigger, self._params.timeout)
        elif self._params.trigger:
            # An std_msgs/msg/Empty, serialised: ROS gives a message without fields one
            # byte
            self._bridge.publish(self._params.trigger, b"\x00\x01\x00\x00\x00")

    def _after(self, topic: str, count: int, started: int, until: float) -> GraphMessage:
        """Return the first message stamped after a moment, skipping earlier ones."""
        late: list[float] = []
        while message := self._bridge.wait(topic, count, max(until - time.monotonic(), 0.0)):
            stamp = self._bridge.local_ns(topic, message)
            early = 1e-9 * (stamp - message.received_ns)
            # A stamp so long after the message came is of another clock [s]
            if early > 0.1:
                raise DeviceError(
                    f"{NAME}: {topic} is stamped {early:.2f} s after "
                    "it came: set the clocks of both computers (NTP), or sim_time"
                )
            # Simulated time stands still between two messages of /clock, at 100 Hz or more; a
            # stamp may be of the one before [ns]. The arm has stood for longer
            if stamp >= started - 20_000_000 * self._params.sim_time:
                return message
            late.append(1e-9 * (started - stamp))
            count = self._bridge.want(topic)
        waited = f"within {self._params.timeout:g} s"
        if not late:
            raise self._silence(f"{NAME}: nothing came on {topic} {waited}; ", topic)
        raise NothingCame(
            f"{NAME}: {len(late)} messages came on {topic} {waited}, all stamped before they were "
            f"asked for, the last by {late[-1]:.2f} s: set the camera's clock (NTP), or let its "
            "driver stamp with the system's time"
        )

    def _silence(self, what: str, topic: str) -> DeviceError:
        runs = self._bridge.topics().get(topic)
        if runs is None or not runs.publishers:
            return DeviceError(f"{what}its publisher has ended: start the camera's driver again")
        by = ", ".join(runs.publishers)
        return NothingCame(
            f"{what}{by} still runs: does the camera have to be triggered, or was its cable pulled?"
        )

    def _points(self, taken: dict[str, GraphMessage], camera: Camera | None) -> Floats:
        """Return the scan's points (H, W, 3) or (N, 3) [m]; empty for an image only."""
        if cloud := self._params.cloud:
            seen: Floats = decoded(taken[cloud].data, Type.CLOUD, cloud_of)
            return seen
        if not (depth := self._params.depth) or not camera:
            return np.zeros((0, 3))
        depths = decoded(taken[depth].data, Type.IMAGE, partial(_metres, depth))
        self._require_size(depth, depths, camera)
        view = DepthView(camera.matrix.tolist(), camera.distortion.tolist())
        return view.points(depths)  # type: ignore[return-value]

    def _image(self, taken: dict[str, GraphMessage], camera: Camera | None) -> Image | None:
        topic = self._params.image
        if topic is None or camera is None:
            return None
        frames = sorted({frame_of(message.data) for message in taken.values()})
        if len(frames) > 1:
            raise DeviceError(
                f"{NAME}: the topics are of several cameras, {' and '.join(frames)}: name the "
                "depths that the driver aligns to the image, or the image alone"
            )
        pixels = decoded(taken[topic].data, self._kinds[topic], pixels_of)
        self._require_size(topic, pixels, camera)
        return Image(
            np.ascontiguousarray(pixels[..., ::-1] if pixels.ndim == 3 else pixels), *camera[:2]
        )

    def _require_size(self, topic: str, pixels: Floats, camera: Camera) -> None:
        if pixels.shape[:2] != camera.shape:
            (height, width), (tall, wide) = pixels.shape[:2], camera.shape
            raise DeviceError(
                f"{NAME}: {topic} has {width} x {height} pixels and {self._params.info} is of "
                f"{wide} x {tall}: camera_info names the topic that belongs to these images"
            )


def _metres(topic: str, message: Any) -> Floats:
    """Return the depths (H, W) of a depth image [m]; 0 where missing."""
    if message.encoding not in DEPTH_UNITS:
        known = ", ".join(DEPTH_UNITS)
        raise DeviceError(
            f"{NAME}: {topic} has the encoding {message.encoding}, depths have one of {known}"
        )
    return np.nan_to_num(values_of(message) / DEPTH_UNITS[message.encoding], posinf=0.0, neginf=0.0)


def _running(bridge: Bridge, topic: str) -> Topic | None:
    return bridge.topics().get(topic)

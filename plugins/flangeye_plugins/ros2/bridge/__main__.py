"""The process that runs rclpy and passes serialised messages in and out.

It runs under the Python of the sourced ROS 2 distribution, with only the standard library and
rclpy, without flangeye. Requests come on standard input; answers and messages go to standard
output. Each is a line of JSON, followed by ``size`` bytes. The process does not interpret messages
and repeats no command by itself, so an arm moves only while commands keep coming.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

try:
    from rclpy.event_handler import SubscriptionEventCallbacks
except ImportError:  # Humble
    from rclpy.qos_event import SubscriptionEventCallbacks

BridgeRequest = dict[str, Any]


class RequestRefused(Exception):
    """A request cannot be executed; the message says why."""


class FramedOutput:
    """Writes frames to standard output; other output of libraries goes to standard error."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._stream = os.fdopen(os.dup(1), "wb")
        os.dup2(2, 1)

    def say(self, header: BridgeRequest, body: bytes = b"") -> None:
        """Write a frame; exit the process if the reader has gone."""
        line = json.dumps({**header, "size": len(body)}).encode() + b"\n"
        try:
            with self._lock:
                self._stream.write(line + body)
                self._stream.flush()
        except OSError:
            os._exit(0)


class BridgeNode:
    """The bridge's ROS 2 node, with its subscriptions, publishers and clients."""

    def __init__(self, node: Any, output: FramedOutput) -> None:
        self._node, self._output = node, output
        self._publishers: dict[str, Any] = {}
        self._clients: dict[str, Any] = {}
        self._subscriptions: dict[str, list[Any]] = {}
        self._wanted: dict[str, bool] = {}
        self._heard: dict[str, int] = {}
        self._newest: dict[str, tuple[int, bytes]] = {}

    def graph(self) -> Any:
        """Return by topic: its type, the publishing nodes, and the number of subscribers."""
        return {
            topic: {
                "type": types[0],
                "publishers": sorted(
                    info.node_name for info in self._node.get_publishers_info_by_topic(topic)
                ),
                "subscribers": self._node.count_subscribers(topic),
            }
            for topic, types in self._node.get_topic_names_and_types()
        }

    def services(self) -> Any:
        """Return the services' types by name."""
        return {name: types[0] for name, types in self._node.get_service_names_and_types()}

    def follow(self, topic: str, type: str, always: bool) -> Any:
        """Subscribe with the publishers' QoS; return the number of publishers, 0 if there are none.

        Args:
            topic: Name of the topic.
            type: Type of its messages.
            always: Whether every message is forwarded, or only the next one after each ``want``.
        """
        kind = type_of(type)
        infos = self._node.get_publishers_info_by_topic(topic)
        others = sorted({info.topic_type for info in infos} - {type})
        if others:
            raise RequestRefused(f"{topic} carries {others[0]}, {type} is needed")
        if infos and topic not in self._wanted:
            self._wanted[topic] = always
            self._subscribe(kind, topic, self._passes_on(topic, always))
        return len(infos)

    def _subscribe(self, kind: Any, topic: str, take: Callable[[bytes], None]) -> None:
        """Subscribe to a topic; subscribe again when a publisher with another QoS appears."""
        before = self._subscriptions.get(topic, [])
        events = SubscriptionEventCallbacks(
            incompatible_qos=lambda _: self._subscribe(kind, topic, take)
        )
        self._subscriptions[topic] = [
            self._node.create_subscription(
                kind, topic, take, profile, event_callbacks=events, raw=True
            )
            for profile in matching(self._node.get_publishers_info_by_topic(topic))
        ]
        for each in before:
            self._node.destroy_subscription(each)

    def want(self, topic: str, since_ns: int) -> Any:
        """Forward a topic's newest message since a given time, or else its next one."""
        self._wanted[topic] = True  # first: one that comes meanwhile is not to be missed
        if topic in self._newest and self._newest[topic][0] >= since_ns:
            self._pass_on(topic)

    def offer(self, topic: str, type: str, latched: bool) -> Any:
        """Create a publisher."""
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        profile = QoSProfile(depth=1, durability=durability)
        self._publishers[topic] = self._node.create_publisher(type_of(type), topic, profile)

    def listeners(self, topic: str) -> Any:
        """Return the number of subscriptions to one of the bridge's publishers."""
        return self._publishers[topic].get_subscription_count()

    def publish(self, topic: str, body: bytes) -> None:
        """Publish a serialised message."""
        self._publishers[topic].publish(body)

    def find(self, service: str) -> Any:
        """Find a service of type std_srvs/srv/Trigger.

        The service client is kept, because a call's answer is lost until the server has discovered
        the client, and no event reports that.
        """
        kind = getattr(importlib.import_module("std_srvs.srv"), "Trigger")  # noqa: B009
        self._clients[service] = self._node.create_client(kind, service)
        # Longest wait for a service to be found [s]
        if not self._clients[service].wait_for_service(timeout_sec=1.0):
            raise RequestRefused(f"nobody offers the service {service}")

    def trigger(self, service: str, call: int) -> Any:
        """Call a service; its answer is sent as a frame with the call's number."""
        client = self._clients[service]
        if not client.service_is_ready():
            raise RequestRefused(f"nobody offers the service {service} any more")

        def answered(future: Any) -> None:
            done = future.result()
            self._output.say(
                {"call": call, "triggered": bool(done.success), "message": done.message}
            )

        client.call_async(client.srv_type.Request()).add_done_callback(answered)

    def heard(self, topic: str) -> Any:
        """Return the number of messages received on a topic."""
        return self._heard.get(topic, 0)

    def _passes_on(self, topic: str, always: bool) -> Callable[[bytes], None]:
        def passes_on(body: bytes) -> None:
            self._heard[topic] = self._heard.get(topic, 0) + 1
            self._newest[topic] = time.monotonic_ns(), body
            if self._wanted[topic]:
                self._wanted[topic] = always
                self._pass_on(topic)

        return passes_on

    def _pass_on(self, topic: str) -> None:
        received_ns, body = self._newest[topic]
        ahead_ns = time.time_ns() - time.monotonic_ns()
        self._output.say({"topic": topic, "received_ns": received_ns, "ahead_ns": ahead_ns}, body)


def matching(infos: list[Any]) -> list[QoSProfile]:
    """Return subscription QoS profiles that are compatible with the publishers.

    Two subscriptions are needed if some publishers are latched (transient local) and others are
    not; new messages may then arrive twice.
    """
    found = []
    for durability in {info.qos_profile.durability for info in infos}:
        some = [i.qos_profile for i in infos if i.qos_profile.durability == durability]
        reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in some)
        found.append(
            QoSProfile(
                depth=10,
                reliability=ReliabilityPolicy.RELIABLE
                if reliable
                else ReliabilityPolicy.BEST_EFFORT,
                durability=durability,
            )
        )
    return found


def type_of(name: str) -> Any:
    """Return the class of a message type such as ``sensor_msgs/msg/Image``."""
    package, _, kind = name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError):
        raise RequestRefused(f"this ROS 2 has no {name}: install the package {package}") from None


def serve(bridge: BridgeNode, output: FramedOutput) -> None:
    """Execute requests until the input ends."""
    stream = sys.stdin.buffer
    while line := stream.readline():
        request = json.loads(line)
        body = stream.read(request.pop("size", 0))
        if request["ask"] == "publish":
            bridge.publish(request["topic"], body)
        else:
            number = request.pop("number")
            output.say({"number": number, **answer(bridge, request)})
    rclpy.try_shutdown()


def answer(bridge: BridgeNode, request: BridgeRequest) -> BridgeRequest:
    """Execute a request and return its answer."""
    try:
        given = getattr(bridge, request.pop("ask"))(**request)
    except RequestRefused as refused:
        return {"error": str(refused)}
    except Exception as error:
        return {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
    return {"given": given}


def take_realtime_priority() -> None:
    """Request real-time priority for this process, if permitted.

    An arm is supervised through this process, and a late process loses clouds sent without
    acknowledgement. On two cores with a load of 14, 6 of 10 clouds arrived, and 1 without this.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))


def main() -> None:
    """Create the node, report success, and serve requests."""
    output = FramedOutput()
    take_realtime_priority()
    rclpy.init()
    node = rclpy.create_node(
        f"flangeye_{os.getpid()}", enable_rosout=False, start_parameter_services=False
    )
    output.say({"number": 0, "given": rclpy.get_rmw_implementation_identifier()})
    threading.Thread(target=serve, args=(BridgeNode(node, output), output), daemon=True).start()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    with contextlib.suppress(ExternalShutdownException):
        executor.spin()
    os._exit(0)


if __name__ == "__main__":
    main()

"""Client of the bridge process that runs under ROS 2's own Python."""

import contextlib
import json
import os
import queue
import re
import shutil
import threading
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

from flangeye.devices import Device, DeviceError, find_named, settings_file
from flangeye.errors import StageError
from flangeye.files.processes import Pipe, PipeEndedError, busy, python_command
from flangeye.models.graph import Topic
from flangeye_plugins.ros2.messages import Type, stamp_of, types

MATCHING = 0.5
"""Longest time until discovery connects a new subscription or publisher [s]."""


class GraphMessage(NamedTuple):
    """A received message, serialised.

    Attributes:
        number: Running number of the message on its topic, from 1.
        received_ns: Time of receipt on ``time.monotonic_ns`` [ns].
        ahead_ns: Wall clock (used by stamps) minus monotonic clock at receipt [ns].
        data: Serialised message (CDR).
    """

    number: int
    received_ns: int
    ahead_ns: int
    data: bytes


Take = Callable[[GraphMessage], None]
Found = TypeVar("Found")


class Bridge(Device):
    """A ROS 2 node in its own process.

    Attributes:
        asker: Name of the driver, for error messages.
        middleware: RMW implementation of the node.
    """

    # After its start a node knows what runs; on an idle machine it does after half a second
    # [s].
    discovery: ClassVar[float] = 2.0

    def __init__(self, asker: str, sim_time: bool = False) -> None:
        """Start the bridge process.

        Args:
            asker: Name of the driver, for error messages.
            sim_time: Whether stamps are in the simulated time of ``/clock``.

        Raises:
            DeviceError: ROS 2 is not installed, or the node does not start.
        """
        types()  # without them nothing that comes can be read
        self.asker = asker
        self._news = threading.Condition()
        self._newest: dict[str, GraphMessage] = {}
        self._takers: dict[str, Take] = {}
        self._answers: queue.Queue[dict[str, Any]] = queue.Queue()
        self._triggered: queue.Queue[dict[str, Any]] = queue.Queue()
        self._asking = threading.Lock()
        # Run by the other Python, and not imported here: this one may have no rclpy.
        words = [*ros_python(asker), str(Path(__file__).with_name("bridge"))]
        try:
            self._pipe = Pipe(words, _environment())
        except OSError as error:
            raise DeviceError(f"{asker}: {words[0]} cannot be run ({error.strerror})") from None
        threading.Thread(target=self._listen, daemon=True).start()
        self._sim_time = sim_time
        self._asked = self._calls = 0
        try:
            # Longest time until the process has a node: a cold disk, or a busy computer, reads
            # rclpy's hundred libraries [s]
            self.middleware = str(self._answer({}, 30.0))
            self._began = time.monotonic()
            if sim_time:
                self.follow("/clock", Type.CLOCK)
        except DeviceError:
            self.close()
            raise

    # --- what is there

    @property
    def place(self) -> str:
        """Text that names this ROS 2 graph in messages."""
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        return f"(ROS_DOMAIN_ID {domain}, RMW_IMPLEMENTATION {self.middleware})"

    def topics(self) -> dict[str, Topic]:
        """Return the topics of the running graph."""
        return {
            name: Topic(name, about["type"], tuple(about["publishers"]), about["subscribers"])
            for name, about in self._ask("graph").items()
        }

    def services(self) -> dict[str, str]:
        """Return the services' types by name."""
        return dict(self._ask("services"))

    def until_known(self) -> float:
        """Return the time on ``time.monotonic`` at which discovery will have finished [s]."""
        return max(self._began + self.discovery, time.monotonic() + MATCHING)

    def awaited(self, look: Callable[[], Found]) -> Found:
        """Return a found result, retrying until discovery has finished."""
        until = self.until_known()
        while not (found := look()) and time.monotonic() < until:
            time.sleep(0.05)
        return found

    def wait_until_known(self) -> None:
        """Wait until discovery has finished."""
        time.sleep(max(self._began + self.discovery - time.monotonic(), 0.0))

    # --- what comes

    def follow(self, topic: str, kind: str, always: bool = True, take: Take | None = None) -> None:
        """Subscribe to a topic, waiting for a publisher during discovery.

        Args:
            topic: Name of the topic.
            kind: Type of the topic's messages.
            always: Whether every message is forwarded, or only those requested by :meth:`want`.
            take: Called with each message in another thread, before :meth:`wait` returns it.

        Raises:
            DeviceError: The topic has no publisher, or another type.
        """
        if take:
            self._takers[topic] = take
        if not self.awaited(lambda: self._ask("follow", topic=topic, type=kind, always=always)):
            raise DeviceError(f"{self.asker}: nobody publishes {topic}; {self._others(kind)}")

    def newest(self, topic: str) -> GraphMessage | None:
        """Return the newest message of a subscribed topic; None before the first.

        Raises:
            DeviceError: The bridge has ended.
        """
        self._require_bridge({"topic": topic})
        return self._newest.get(topic)

    def wait(self, topic: str, after: int, patience: float) -> GraphMessage | None:
        """Return a message with a number above ``after``; None if none arrives in time [s]."""
        with self._news:
            self._news.wait_for(lambda: self._gone or self._count(topic) > after, timeout=patience)
        found = self.newest(topic)
        return found if found and found.number > after else None

    def want(self, topic: str, since_ns: int | None = None) -> int:
        """Request a topic's newest message since a given time, or else its next one.

        Returns:
            The number to pass to :meth:`wait` as ``after``.
        """
        count = self._count(topic)
        self._ask("want", topic=topic, since_ns=since_ns or time.monotonic_ns())
        return count

    def heard(self, topic: str) -> int:
        """Return the number of messages received on a subscribed topic."""
        return int(self._ask("heard", topic=topic))

    def local_ns(self, topic: str, message: GraphMessage) -> int:
        """Return the time of a message's stamp, converted to ``time.monotonic_ns`` [ns].

        A stamp in simulated time is compared with ``/clock``.

        Raises:
            DeviceError: The message has no stamp.
        """
        stamp = stamp_of(message.data)
        if not stamp:
            raise DeviceError(
                f"{self.asker}: {topic} is stamped 0, so nobody knows when it was measured: let "
                "its driver fill in header.stamp"
            )
        if not self._sim_time:
            return stamp - message.ahead_ns
        tick = self.newest("/clock")
        return (
            message.received_ns if tick is None else tick.received_ns + stamp - stamp_of(tick.data)
        )

    def stamp_ns(self, local_ns: int) -> int:
        """Return the message stamp [ns] for a time on ``time.monotonic_ns``."""
        tick = self.newest("/clock") if self._sim_time else None
        if tick is None:
            return local_ns + time.time_ns() - time.monotonic_ns()
        return stamp_of(tick.data) + local_ns - tick.received_ns

    # --- what leaves

    def offer(self, topic: str, kind: str, latched: bool = False) -> None:
        """Create a publisher."""
        self._ask("offer", topic=topic, type=kind, latched=latched)

    def listeners(self, topic: str) -> int:
        """Return the number of subscribers of an offered topic."""
        return int(self._ask("listeners", topic=topic))

    def publish(self, topic: str, data: bytes) -> None:
        """Publish a serialised message; never waits for an answer."""
        self._send({"ask": "publish", "topic": topic, "size": len(data)}, data)

    def find(self, service: str) -> None:
        """Find a ``std_srvs/srv/Trigger`` service; raise DeviceError if there is none."""
        self._ask("find", service=service)

    def trigger(self, service: str, patience: float) -> None:
        """Call a Trigger service and wait for its answer.

        Raises:
            DeviceError: The service has ended, does not answer in time [s], or reports a failure.
        """
        self._calls += 1
        self._ask("trigger", service=service, call=self._calls)
        until, answer = time.monotonic() + patience, dict[str, Any]()
        while answer.get("call") != self._calls:  # an answer to an earlier call came too late
            try:
                answer = self._triggered.get(timeout=max(until - time.monotonic(), 0.0))
            except queue.Empty:
                raise DeviceError(
                    f"{self.asker}: {service} did not answer within {patience:.1f} s{busy()}"
                ) from None
        if not answer["triggered"]:
            raise DeviceError(
                f"{self.asker}: {service} refused: {answer['message'] or 'no reason'}"
            )

    @property
    def closed(self) -> bool:
        """Whether the connection is closed."""
        return bool(self._gone)

    def close(self) -> None:
        """End the bridge process; safe to call twice."""
        self._gone = self._gone or "is closed"
        # How long a node may take to say that it leaves: one that is killed is sent messages for
        # 20 s, which costs those that are sent to others [s]
        self._pipe.close(0.5)

    # --- the wire

    _gone = ""

    def _count(self, topic: str) -> int:
        found = self._newest.get(topic)
        return found.number if found else 0

    def _others(self, kind: str) -> str:
        others = [t.name for t in self.topics().values() if t.type == kind and t.publishers]
        return f"of type {kind} there are: {', '.join(sorted(others)) or 'none'} {self.place}"

    def _ask(self, what: str, **arguments: Any) -> Any:
        with self._asking:
            self._asked += 1
            self._send({"ask": what, "number": self._asked, **arguments})
            # Longest time for an answer; finding a service takes the most, a second, and on a busy
            # machine listing the topics [s]
            return self._answer(arguments, 2.5)

    def _answer(self, about: dict[str, Any], patience: float) -> Any:
        """Return the answer to the last request about a topic or a service."""
        until, answer = time.monotonic() + patience, dict[str, Any]()
        while answer.get("number") != self._asked:  # one to an earlier question came too late
            try:
                answer = self._answers.get(timeout=max(until - time.monotonic(), 0.0))
            except queue.Empty:
                late = f"the bridge to ROS 2 did not answer within {patience:g} s{busy()}"
                raise DeviceError(f"{self.asker}: {_named(about)}{late}") from None
            self._require_bridge(about)
        if "error" in answer:
            raise DeviceError(f"{self.asker}: {answer['error']}")
        return answer["given"]

    def _require_bridge(self, about: dict[str, Any]) -> None:
        if self._gone:
            raise DeviceError(f"{self.asker}: {_named(about)}{self._gone}")

    def _send(self, request: dict[str, Any], body: bytes = b"") -> None:
        self._require_bridge(request)
        with contextlib.suppress(OSError):  # why it ended is heard where it is read
            self._pipe.write(json.dumps(request).encode() + b"\n" + body)

    def _listen(self) -> None:
        """Read the bridge's messages until it ends."""
        try:
            while True:
                said = json.loads(self._pipe.line(None))
                self._take(said, self._pipe.read(said["size"], None))
        except PipeEndedError as ended:
            self._gone = self._gone or f"the bridge to ROS 2 has ended ({ended})"
        self._answers.put({})
        with self._news:
            self._news.notify_all()

    def _take(self, said: dict[str, Any], body: bytes) -> None:
        if "topic" in said:
            topic = said["topic"]
            with self._news:
                message = GraphMessage(
                    self._count(topic) + 1, said["received_ns"], said["ahead_ns"], body
                )
                if topic in self._takers:
                    with contextlib.suppress(StageError):  # damaged: as if it had not come
                        self._takers[topic](message)
                self._newest[topic] = message
                self._news.notify_all()
        elif "triggered" in said:
            self._triggered.put(said)
        else:
            self._answers.put(said)


def _named(about: dict[str, Any]) -> str:
    """Return the name of the topic or service for an error message."""
    name = about.get("topic") or about.get("service")
    return f"{name}: " if name else ""


def ros_python(asker: str) -> list[str]:
    """Return the command of a Python that has rclpy.

    It is the one in the machine's settings, that of the sourced distribution, or the present one. A
    sourced distribution adds its packages to ``PYTHONPATH``, in a folder named after the Python
    version they were built for.

    Raises:
        DeviceError: There is none; the message says what to do.
    """
    if (named := find_named("programs", "ros2")) is not None:
        return [str(named)]
    for folder in os.environ.get("PYTHONPATH", "").split(os.pathsep):
        version = re.search(r"python(3\.\d+)", folder)
        if version and (Path(folder) / "rclpy").is_dir():
            found = shutil.which(f"python{version[1]}")
            if found is None:
                raise DeviceError(f"{asker}: {folder} needs python{version[1]}; not installed")
            return [found]
    if find_spec("rclpy") is not None:
        return python_command()
    raise DeviceError(
        f"{asker}: no ROS 2 in this terminal: source it (source /opt/ros/jazzy/setup.bash) and "
        f'start again, or name the Python that has rclpy, ros2 = "/its/whole/path" under '
        f"[programs] in {settings_file()}"
    )


def _environment() -> dict[str, str]:
    """Return the environment without variables that would mislead the other Python."""
    mine = ("PYTHONHOME", "PYTHONSAFEPATH", "PYTHONDONTWRITEBYTECODE")
    return {name: value for name, value in os.environ.items() if name not in mine}

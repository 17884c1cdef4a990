"""A run as a process of the command line, and what its log says while it goes."""

from __future__ import annotations

import ctypes
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flangeye import types as t
from flangeye.errors import FlangeyeError
from flangeye.log import foxglove
from flangeye.log.read import RunLog, read_run, take
from flangeye.log.watch.tail import Message, follow
from flangeye.log.watch.view import View
from flangeye.plugin.registry import Registry
from flangeye.recipe.load import Recipe
from flangeye.run.outlook import Outlook, outlook
from flangeye.run.recorded import recipe_of_log
from flangeye.types import Floats

POINTS = 20_000
"""Of a scan that are sent to the page."""
DIE_WITH_PARENT = 1
"""``PR_SET_PDEATHSIG`` of Linux: a run does not outlive its page's server."""


class RunProcess:
    """``flangeye run``, started, followed and stopped.

    Attributes:
        path: The run's folder.
        moves: Whether it may move an arm.
        view: What its log has said so far.
        log: The same as values, clouds of whole scans aside.
        outlook: What its poses so far are worth; None before the first was judged.
        cloud: (N, 3) the newest scan, thinned, in the camera [m]; and the flange in it.
        places: (3,) of the flange in the base [m], by capture; those set aside are named.
        stopped: Why it was stopped from here; empty where it was not.
    """

    def __init__(self, folder: Path, words: Sequence[str], move: bool, registry: Registry) -> None:
        """Start ``flangeye run`` in a folder with words of its command line."""
        self.path = folder / "runs" / f"{time.strftime('%Y-%m-%dT%H-%M-%S')}_ui"
        self.moves, self.stopped = move, ""
        self.view, self.log = View(self.path.name), RunLog(self.path / "run.mcap")
        self.outlook: Outlook | None = None
        self.cloud: Floats = np.zeros((0, 3))
        self.flange: Floats = np.zeros((0, 3))
        self.arrived = 0
        self.places: dict[str, list[float]] = {}
        self.set_aside: set[str] = set()
        out = str(self.path.relative_to(folder))
        self.words = ["run", *words, "--out", out, *(["--move"] if move else [])]
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "flangeye.cli", *self.words],
            cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, start_new_session=True, preexec_fn=_die_with_parent,
        )  # fmt: skip
        self.said: list[str] = []
        self._registry, self._fitted = registry, threading.Event()
        for work in (self._listen, self._follow, self._judge):
            threading.Thread(target=work, daemon=True).start()

    @property
    def code(self) -> int | None:
        """The exit code; None while it goes."""
        return self._process.poll()

    def stop(self, why: str) -> None:
        """Stop it as Ctrl-C does: the arm's guard hears it at once."""
        if self.code is None:
            self.stopped = why
            self._process.send_signal(signal.SIGINT)

    def _listen(self) -> None:
        assert self._process.stdout is not None  # noqa: S101  it was asked for above
        with self._process.stdout as said:
            for line in said:
                self.said.append(line.rstrip())

    def _follow(self) -> None:
        held: dict[str, t.PointCloud] = {}
        while not self.log.path.exists() and self.code is None:
            time.sleep(0.05)
        try:
            for message in follow(self.log.path, self._wait):
                self.view.take(message)
                take(self.log, message, held)
                self._mark(message)
                self._show(message)
            self.view.ended = True
        except (FlangeyeError, _EndedError):
            return
        finally:
            self._fitted.set()

    def _wait(self) -> None:
        if self.code is not None:
            raise _EndedError
        time.sleep(0.05)

    def _mark(self, message: Message) -> None:
        """Keep where the flange has been, and what was set aside."""
        if message.channel.topic == "/capture" and self.view.arm:
            self.places[json.loads(message.data)["id"]] = self.view.arm[0]
        elif message.channel.topic == "/rejection":
            self.set_aside.add(json.loads(message.data)["id"])
        elif message.channel.topic.partition(".")[2].startswith("fit."):
            self._fitted.set()

    def _judge(self) -> None:
        """Say what the poses so far are worth, again and again, the newest first."""
        recipe, judged = None, 0
        while self.code is None or len(self.log.observations()) > judged:
            if not self._fitted.wait(0.2):
                continue
            self._fitted.clear()
            seen = self.log.observations()
            judged = len(seen)
            try:
                recipe = recipe or self._recipe()
                source = self.log.source or t.Source(fingerprint="")
                self.outlook = outlook(recipe, self._registry, seen, source)
            except FlangeyeError:
                return  # what the run itself says of its recipe stands on the page already

    def _recipe(self) -> Recipe:
        return recipe_of_log(read_run(self.log.path), self._registry, name=self.path.name)

    def _show(self, message: Message) -> None:
        """Keep the newest scan and the flange in it, thin enough for a page."""
        topic = message.channel.topic
        if message.channel.schema != "foxglove.PointCloud":
            return
        thin = thinned(message.data)
        if topic == "/capture/cloud":
            self.cloud, self.flange = thin, np.zeros((0, 3))
        elif ".segment." in topic:
            self.flange = thin
        self.arrived += 1


def thinned(data: bytes) -> Floats:
    """Return (N, 3) points of a logged cloud, few enough for a page."""
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

    xyz = foxglove.points_of(PointCloud.FromString(data)).reshape(-1, 3)
    # Much of a whole scan is holes: enough of it to have POINTS left, and not all to look through.
    some = xyz[:: max(1, len(xyz) // (20 * POINTS))]
    cloud = t.PointCloud(t.CAMERA, some).points()
    return cloud[:: max(1, len(cloud) // POINTS)].astype(np.float64)


class _EndedError(Exception):
    """The run ended and its log will not grow."""


def _die_with_parent() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(DIE_WITH_PARENT, signal.SIGINT)

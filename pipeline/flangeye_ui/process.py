"""A run or a live check as a child process, followed by its log."""

import ctypes
import json
import signal
import subprocess
import sys
import threading
import time
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye import types as t
from flangeye.errors import FlangeyeError
from flangeye.plugin.registry import Registry
from flangeye.types import Floats
from flangeye.workflow.log import foxglove
from flangeye.workflow.log.read import RunLog, logged_image, read_run, take
from flangeye.workflow.log.records import LogMessage
from flangeye.workflow.log.watch import RunView, follow
from flangeye.workflow.recipe.load import Recipe
from flangeye.workflow.run.folder import CHECKS_FOLDER, recipe_of_log
from flangeye.workflow.run.outlook import Outlook, outlook


class RunProcess:
    """A process of ``flangeye run`` or ``flangeye monitor --live``: started, followed and stopped.

    Attributes:
        checks: Whether it checks a stored calibration, and makes none.
        path: Folder of the run; of a check, that of the calibration.
        moves: Whether it may move an arm.
        view: State of the run from its log.
        log: Values of its log, without the clouds of whole scans.
        outlook: Expected quality from the poses so far; None before the first estimate.
        cloud: (N, 3) the newest scan, thinned, in the camera [m]; and the flange in it.
        places: (3,) positions of the flange in the base [m], by capture.
        shots: Small pictures of the scans with their flange as data URLs, by capture.
        began: Start time on time.monotonic [s].
        stopped: Reason for stopping it from the page; empty if it was not.
    """

    def __init__(self, folder: Path, words: Sequence[str], move: bool, registry: Registry) -> None:
        """Start a command in a folder with words of its command line, such as ``run cell.yaml``."""
        self.checks = words[0] == "monitor"
        stamped = f"runs/{time.strftime('%Y-%m-%dT%H-%M-%S')}_ui"
        self.path = folder / (words[1] if self.checks else stamped)
        self._before = set(self.path.glob(f"{CHECKS_FOLDER}/*"))
        self.moves, self.stopped = move, ""
        # A check has a log of its own, below a folder that the command names.
        self.log = RunLog(self.path / (f"{CHECKS_FOLDER}/run.mcap" if self.checks else "run.mcap"))
        self.view = RunView(self.path.name)
        self.outlook: Outlook | None = None
        self.cloud: Floats = np.zeros((0, 3))
        self.flange: Floats = np.zeros((0, 3))
        self.arrived = 0
        self.places: dict[str, list[float]] = {}
        self.shots: dict[str, str] = {}
        self.began, self._capture = time.monotonic(), ""
        out = [] if self.checks else ["--out", stamped]
        self.words = [*words, *out, *(["--move"] if move else [])]
        # -P: a Python file in the folder must not stand in for a library. A session of its own:
        # Ctrl-C in the server's terminal ends the server, which then stops the run
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "flangeye.cli", *self.words],
            cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, start_new_session=True, preexec_fn=_heed_the_server,
        )  # fmt: skip
        self.said: list[str] = []
        self._registry, self._fitted = registry, threading.Event()
        judges = () if self.checks else (self._judge,)
        for work in (self._listen, self._follow, *judges):
            threading.Thread(target=work, daemon=True).start()

    @property
    def code(self) -> int | None:
        """Exit code of the process; None while it runs."""
        return self._process.poll()

    @property
    def set_aside(self) -> dict[str, str]:
        """Reasons for rejections by a stage or by the solver, by capture."""
        by_stages = {each.id: f"{each.stage}: {each.reason}" for each in self.log.rejections}
        return {**(self.outlook.set_aside if self.outlook else {}), **by_stages}

    @property
    def left(self) -> float | None:
        """Time left at most, from the pace so far [s]; None if unknown."""
        seen, total = self.view.captures, self.view.total
        if not seen or not total or self.code is not None:
            return None
        return (time.monotonic() - self.began) / seen * max(total - seen, 0)

    def stop(self, why: str) -> None:
        """Stop the run like Ctrl-C: the arm's guard receives the signal at once."""
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
        while not self._begun() and self.code is None:
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

    def _begun(self) -> bool:
        """Return whether there is a log; the command itself names that of a check."""
        for new in set(self.path.glob(f"{CHECKS_FOLDER}/*")) - self._before if self.checks else ():
            self.log.path = new / self.log.path.name
        return self.log.path.exists()

    def _wait(self) -> None:
        if self.code is not None:
            raise _EndedError
        time.sleep(0.05)

    def _mark(self, message: LogMessage) -> None:
        """Record the flange's places and the fitted captures."""
        if message.channel.topic == "/capture":
            self._capture = json.loads(message.data)["id"]
            if self.view.arm:
                self.places[self._capture] = self.view.arm[0]
        elif message.channel.topic.partition(".")[2].startswith("fit."):
            self._fitted.set()

    def _judge(self) -> None:
        """Judge the calibration by the poses so far, whenever there are new ones."""
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

    def _show(self, message: LogMessage) -> None:
        """Keep the newest scan and the flange in it, thin enough for a page; of images, these."""
        topic = message.channel.topic
        if topic == "/capture/image":
            self.shots[self._capture] = small(logged_image(message.data))
        if message.channel.schema != "foxglove.PointCloud":
            return
        thin = thinned(message.data)
        if topic == "/capture/cloud":
            self.cloud, self.flange = thin, np.zeros((0, 3))
        elif ".segment." in topic:
            self.flange = thin
        if len(self.cloud):
            self.shots[self._capture] = picture_of(self.cloud, self.flange)
        self.arrived += 1


def thinned(data: bytes) -> Floats:
    """Return (N, 3) points of a logged cloud, few enough for a page."""
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

    xyz = foxglove.points_of(PointCloud.FromString(data)).reshape(-1, 3)
    # Much of a whole scan is holes: enough of it to have POINTS left, and not all to look through.
    # Of a scan that are sent to the page.
    points = 20_000
    some = xyz[:: max(1, len(xyz) // (20 * points))]
    cloud = t.PointCloud(t.CAMERA, some).points()
    return cloud[:: max(1, len(cloud) // points)].astype(np.float64)


SHOT = (160, 120)
"""Width and height of a scan's small picture [pixels]."""


def picture_of(cloud: Floats, flange: Floats) -> str:
    """Return a data URL of the scan as the camera sees it: near is light, the flange is blue."""
    image = np.zeros((SHOT[1], SHOT[0], 3), dtype=np.uint8)
    if len(cloud):
        rays = cloud[:, :2] / cloud[:, 2:]
        low, high = rays.min(axis=0), rays.max(axis=0)
        scale = (np.array(SHOT) - 2) / max(float((high - low).max() / (SHOT[0] / SHOT[1])), 1e-9)
        # Far points first, so that near ones cover them
        depth = np.argsort(-cloud[:, 2])
        shade = np.interp(cloud[:, 2], np.quantile(cloud[:, 2], [0.02, 0.98]), [235, 70])
        # Colour of the flange in it: blue, green, red.
        for points, colour in ((cloud[depth], shade[depth, None]), (flange, (239, 155, 60))):
            at = ((points[:, :2] / points[:, 2:] - low) * scale.min()).astype(int)
            inside = ((at >= 0) & (at < np.array(SHOT) - 1)).all(axis=1)
            values = np.broadcast_to(colour, (len(points), 3))[inside]
            # Squares of 2 x 2 pixels close the gaps between thinned points
            for x, y in ((0, 0), (0, 1), (1, 0), (1, 1)):
                image[at[inside, 1] + y, at[inside, 0] + x] = values
    return _as_address(image)


def small(image: NDArray[np.uint8]) -> str:
    """Return a small picture of an image (H, W) or (H, W, 3), RGB, as a data URL."""
    import cv2

    scale = min(np.array(SHOT) / image.shape[1::-1])
    fewer = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return _as_address(fewer[..., ::-1] if fewer.ndim == 3 else fewer)


def _as_address(image: Any) -> str:
    import cv2

    return "data:image/png;base64," + b64encode(cv2.imencode(".png", image)[1].tobytes()).decode()


class _EndedError(Exception):
    """The run ended and its log will not grow."""


def _heed_the_server() -> None:
    # It is ignored in a server that a shell script starts in the background, and so in its children
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if sys.platform == "linux":
        # ``PR_SET_PDEATHSIG`` of Linux: a run does not outlive its page's server
        ctypes.CDLL(None).prctl(1, signal.SIGINT)

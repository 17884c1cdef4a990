"""``scanner.watched_folder``: reads the clouds that the scanner's own software exports."""

import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from flangeye.devices import DeviceError, Scan, Scanner
from flangeye.errors import StageError
from flangeye.files.clouds import CLOUD_FILES, FileUnit, read_cloud
from flangeye.files.paths import RecipePath
from flangeye.files.scans import natural
from flangeye.models.scanners import ScannerModel, check_unit, median_distance
from flangeye.plugin.stage import Params, part
from flangeye.types import PointCloud
from flangeye.units import Duration, param
from flangeye_plugins.scanner.opened import OpenScanner


class WatchedFolderParams(Params):
    """Parameters of ``scanner.watched_folder``."""

    path: RecipePath
    """Folder that the scanner's software exports into."""
    unit: FileUnit
    """Unit of the files' coordinates; files do not say."""
    pattern: str = "*"
    """File name pattern, for example 'scan_*.ply'."""
    settle: Duration = param("500 ms", ge=0)
    """Time without change after which a file is taken to be complete."""
    timeout: Duration = param("60 s", gt=0)
    """Longest wait for the next file."""


@part("scanner.watched_folder")
def scanner_watched_folder(model: ScannerModel | None, params: WatchedFolderParams) -> Scanner:
    """Read each new cloud that appears in a folder, once it is complete.

    Files that exist when the recipe starts are ignored. Trigger a scan in the scanner's own
    software when the arm is at rest; files are read in the order in which they appear. The stated
    unit is checked against the model's range.

    Raises:
        DeviceError: The folder does not exist or is not readable.
    """
    return WatchedFolder(model, params)


class Stamp(NamedTuple):
    """Size and times of a file, for detecting a change; times may be coarse on network shares."""

    inode: int
    size: int
    changed_ns: int


class Arrival(NamedTuple):
    """A new file: its last stamp, the time since that stamp, and the last time without the file."""

    stamp: Stamp
    since: float
    before_ns: int


class WatchedFolder(OpenScanner):
    """A watched folder; ``close`` from another thread ends a wait."""

    def __init__(self, model: ScannerModel | None, params: WatchedFolderParams) -> None:
        """Record the files that exist already."""
        super().__init__(f"folder {params.path}", {"unit": params.unit})
        self._model, self._params = model, params
        self._looked_ns = time.monotonic_ns()
        self._known = self._look()
        self._arrivals: dict[Path, Arrival] = {}
        self._closed = threading.Event()

    def expose(self) -> Callable[[], Scan]:
        """Ask the operator to scan, and wait up to ``timeout`` for the next file.

        The exposure's start is the time when the folder was last seen without the file. So a scan
        taken while the arm moved is not mistaken for one at rest.
        """
        limit = time.monotonic() + self._params.timeout
        incomplete = ""
        self._notice()
        sys.stderr.write(f"Scan now, and export the cloud into {self._params.path}\n")
        while time.monotonic() < limit:
            self._notice()
            for path in self._settled():
                try:
                    cloud = read_cloud(path, self._params.unit)
                except StageError as error:
                    incomplete = f": {error}"
                    break  # files are taken in order: those after it must wait for it
                return self._take(path, cloud)
            # Between two looks into the folder [s]
            if self._closed.wait(0.1):
                raise DeviceError(f"{self.name}: is closed")
        raise DeviceError(
            f"{self.name}: no whole new cloud within {self._params.timeout:g} s{incomplete}; "
            f"looked for {self._params.pattern} ({', '.join(CLOUD_FILES)})"
        )

    def close(self) -> None:
        """End the wait, if there is one."""
        self._closed.set()

    def _look(self) -> dict[Path, Stamp]:
        """Return the cloud files in the folder, complete or not."""
        found = {}
        name = "scanner.watched_folder"
        try:
            for path in self._params.path.iterdir():
                if _is_cloud(path) and path.match(self._params.pattern):
                    about = path.stat()
                    # The inode shows a file that another one of equal size and time has replaced
                    found[path] = Stamp(about.st_ino, about.st_size, about.st_mtime_ns)
        except FileNotFoundError:
            if self._params.path.is_dir():
                return self._look()  # a temporary name, renamed while we looked
            raise DeviceError(f"{name}: no folder {self._params.path}") from None
        except OSError as error:
            raise DeviceError(
                f"{name}: {self._params.path} cannot be read ({error.strerror})"
            ) from None
        return found

    def _notice(self) -> None:
        """Record new files, and the time since which each has not changed."""
        looked_ns, now = time.monotonic_ns(), time.monotonic()
        there = self._look()
        self._arrivals = {path: a for path, a in self._arrivals.items() if path in there}
        new = [path for path, stamp in there.items() if self._known.get(path) != stamp]
        for path in sorted(new, key=lambda path: natural(path.name)):
            before = self._arrivals.get(path)
            if before is None:
                # The exposure may have begun right after the last look without the file
                self._arrivals[path] = Arrival(there[path], now, self._looked_ns)
            elif before.stamp != there[path]:
                self._arrivals[path] = before._replace(stamp=there[path], since=now)
        self._looked_ns = looked_ns

    def _settled(self) -> list[Path]:
        """Return the files that may be complete, in order, up to the first that still changes."""
        settled = []
        for path, arrival in self._arrivals.items():
            if time.monotonic() - arrival.since < self._params.settle:
                break
            settled.append(path)
        return settled

    def _take(self, path: Path, cloud: PointCloud) -> Callable[[], Scan]:
        arrival = self._arrivals.pop(path)
        # A file that is exported again under this name has another stamp, and is a new scan
        self._known[path] = arrival.stamp
        ended = time.monotonic_ns()

        def check() -> Scan:
            if self._model is not None:
                check_unit(path, median_distance(cloud), self._params.unit, self._model)
            return Scan(cloud, arrival.before_ns, ended)

        return check


def _is_cloud(path: Path) -> bool:
    return path.suffix.lower() in CLOUD_FILES and not path.name.startswith((".", "~"))

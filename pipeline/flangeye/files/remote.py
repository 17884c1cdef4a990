"""Remote archives and results, by URL: scans are fetched one at a time and not kept.

The rest of the program uses paths only. An archive by URL gets a local folder with every file by
its name: small files whole, scans and images empty until they are read.
"""

import hashlib
import ipaddress
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from flangeye.errors import FlangeyeError, StageError


def is_url(place: str) -> bool:
    """Return whether a place is a URL, not a path."""
    return re.match(r"[A-Za-z][A-Za-z0-9+.-]+://", place) is not None


def is_this_machine(host: str) -> bool:
    """Return whether a host name or address is this machine's loopback."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@contextmanager
def archive_at(place: str | None) -> Iterator[Path | None]:
    """Yield an archive's path; for a URL, that of a local folder that mirrors it on demand.

    Raises:
        StageError: The archive does not exist, cannot be reached, or its kind of URL is not
            supported.
    """
    if place is None or not is_url(place):
        yield None if place is None else Path(place)
        return
    with TemporaryDirectory(prefix="flangeye-") as folder:
        within = place.partition("::")[0].partition("://")[2]
        root = Path(folder).resolve() / (PurePosixPath(within).name or "archive")
        with _standing_in(place, root) as stand_in:
            stand_in.lay_out()
            yield root


@contextmanager
def results_at(place: str | None) -> Iterator[Path | None]:
    """Yield the folder to write results to; results for a URL are sent at the end.

    Raises:
        StageError: The place already has files, or cannot be reached.
    """
    if place is None or not is_url(place):
        yield None if place is None else Path(place)
        return
    system, root = system_of(place)
    with one_line_errors(place):
        if system.exists(root) and system.find(root):
            raise StageError(f"{place}: already holds files; name a new or empty folder")
    with TemporaryDirectory(prefix="flangeye-") as folder:
        local = Path(folder).resolve() / "run"
        with _standing_in(place, local):
            try:
                yield local
            finally:
                if local.is_dir():
                    with one_line_errors(place):
                        system.put(f"{local}/", f"{root.rstrip('/')}/", recursive=True)


@contextmanager
def _standing_in(place: str, root: Path) -> Iterator["_Mirror"]:
    """Let a local folder stand for a URL while the context lasts, in errors too."""
    _STANDING_IN[root] = stand_in = _Mirror(place, root)
    try:
        yield stand_in
    except FlangeyeError as error:
        error.wrong, error.advice = with_urls(error.wrong), with_urls(error.advice)
        raise
    finally:
        del _STANDING_IN[root]


@contextmanager
def at_hand(path: Path) -> Iterator[None]:
    """Fetch a file of a remote archive while the context lasts; local files stay as they are."""
    stand_in = _of(path)
    if stand_in is None or path not in stand_in.later:
        yield
        return
    stand_in.fetch(path)
    try:
        yield
    finally:
        path.write_bytes(b"")


def is_remote(path: Path) -> bool:
    """Return whether a file must be fetched before it can be read."""
    stand_in = _of(path)
    return stand_in is not None and path in stand_in.later


def remote_digest(path: Path) -> str | None:
    """Return a hash of a remote file's content from the store; None for a local file."""
    stand_in = _of(path)
    return _state(stand_in.later[path]) if stand_in and path in stand_in.later else None


def with_urls(text: str) -> str:
    """Replace the paths of mirror folders in a text by their URLs."""
    for root, stand_in in _STANDING_IN.items():
        text = text.replace(str(root), stand_in.url.rstrip("/"))
    return text


def remote_fingerprint(url: str) -> str:
    """Return a hash of a remote archive's names and contents, from the store's listing."""
    stand_in = _Mirror(url, Path("/"))
    lines = [f"{name}\0{_state(about)}\n" for name, about in sorted(stand_in.listed().items())]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


class _Mirror:
    """A local folder that mirrors a remote one.

    Attributes:
        url: URL of the remote folder.
        later: Local file -> the store's entry, for files that are not fetched yet.
    """

    def __init__(self, url: str, root: Path) -> None:
        self.url, self._root = url, root
        self._system, self._there = system_of(url)
        self.later: dict[Path, Mapping[str, Any]] = {}
        self._names: dict[Path, str] = {}

    def listed(self) -> dict[str, Mapping[str, Any]]:
        """Return the store's entries below a URL by name; the name is "" for a single file."""
        with one_line_errors(self.url):
            found = self._system.find(self._there, detail=True)
        if not found:
            raise StageError(f"{self.url}: holds nothing")
        return {self._name_of(path): about for path, about in found.items()}

    def lay_out(self) -> None:
        """Create every file empty, and fetch the small ones and those that are no scans."""
        for name, about in self.listed().items():
            path = self._root / name if name else self._root
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
            self._names[path] = about["name"]
            # Small scans are fetched at once, as requests cost more than their bytes
            of_scans = path.suffix.lower() in (
                ".pcd", ".ply", ".npy", ".xyz", ".csv", ".txt", ".png", ".jpg", ".jpeg", ".bmp",
                ".tif", ".tiff",
            )  # fmt: skip
            if of_scans and (about.get("size") or 0) > 1_000_000:
                self.later[path] = about
            else:
                self.fetch(path)

    def fetch(self, path: Path) -> None:
        """Fetch the content of one file into the local folder."""
        with one_line_errors(with_urls(str(path))):
            self._system.get_file(self._names[path], str(path))

    def _name_of(self, path: str) -> str:
        name = path.removeprefix(self._there.rstrip("/")).lstrip("/")
        if ".." in PurePosixPath(name).parts:
            raise StageError(f"{self.url}: holds a file called '{name}', which leads out of it")
        return name


_STANDING_IN: dict[Path, _Mirror] = {}


def _of(path: Path) -> _Mirror | None:
    return next((s for root, s in _STANDING_IN.items() if path.is_relative_to(root)), None)


def _state(about: Mapping[str, Any]) -> str:
    """Return a hash of size and checksum; without a checksum, of size, name and time of change."""
    sums = [about[key] for key in ("ETag", "md5Hash", "content_md5", "CRC") if about.get(key)]
    known = sums or (about.get("name"), about.get("mtime") or about.get("LastModified"))
    return hashlib.sha256(f"{about.get('size')} {known}".encode()).hexdigest()


def system_of(url: str) -> tuple[Any, str]:
    """Return the file system of a URL and the path in it.

    Raises:
        StageError: The kind of URL is not supported, or its library is not installed.
    """
    protocols = ("s3", "gs", "az", "https", "zip")  # none of them runs anything
    for each in url.split("::"):
        protocol = each.partition("://")[0]
        if "://" in each and protocol not in protocols:
            raise StageError(
                f"{url}: {protocol}:// is not supported; "
                f"known: {', '.join(f'{p}://' for p in protocols)}"
            )
    try:
        import fsspec

        with one_line_errors(url):
            # A cached listing may be out of date, so the store is asked again.
            fresh = {"skip_instance_cache": True} if url.startswith("zip:") else {}
            system, path = fsspec.url_to_fs(url, **fresh)
            system.invalidate_cache()
    except ImportError as error:
        raise StageError(
            f"{url}: {error.name or 'fsspec'} is not installed; install with: "
            "pip install 'flangeye[cloud]'"
        ) from None
    return system, str(path)


@contextmanager
def one_line_errors(url: str) -> Iterator[None]:
    """Turn any error of a remote store into one line.

    Raises:
        StageError: The store raised an error.
    """
    try:
        yield
    except (FlangeyeError, ImportError):
        raise
    except Exception as error:  # each store has errors of its own
        lines = str(error).strip().splitlines() or [""]
        raise StageError(f"{url}: cannot be reached: {type(error).__name__}: {lines[0]}") from None

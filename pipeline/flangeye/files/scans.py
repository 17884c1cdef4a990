"""The scans beside poses: clouds, and images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from glob import escape
from pathlib import Path

from flangeye.errors import StageError
from flangeye.files.recording import Recording
from flangeye.types import FLANGE, Floats

CLOUDS = (".pcd", ".ply", ".npy", ".xyz")
IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
VENDOR = {".zdf": "Zivid's SDK", ".praw": "Photoneo's PhoXi Control", ".mraw": "Mech-Mind's SDK"}
"""Files that only their maker can read, and with what to turn them into others."""


def scans_in(folder: Path, stem: str = "*") -> list[Path]:
    """Return the scans of a folder by name, clouds before images of the same name.

    Raises:
        StageError: There are only scans that their maker alone can read.
    """
    found = sorted(p for p in folder.glob(f"{stem}.*") if p.suffix.lower() in (*CLOUDS, *IMAGES))
    foreign = sorted(p for p in folder.glob(f"{stem}.*") if p.suffix.lower() in VENDOR)
    if foreign and not found:
        first = foreign[0]
        raise StageError(
            f"{first}: only {VENDOR[first.suffix.lower()]} reads it; export it as .ply or .pcd"
        )
    return found


def recording_of(name: str, pose: Floats, scans: Sequence[Path]) -> Recording:
    """Return a pose with its cloud and its image, whichever there are.

    Raises:
        StageError: It has two of one sort, or a file is neither.
    """
    clouds = [p for p in scans if p.suffix.lower() in CLOUDS]
    images = [p for p in scans if p.suffix.lower() in IMAGES]
    if len(clouds) > 1 or len(images) > 1:
        names = ", ".join(p.name for p in scans)
        raise StageError(f"pose '{name}' has more than one cloud or image: {names}")
    if len(clouds) + len(images) < len(scans):
        raise StageError(f"{scans[0]}: is neither a cloud nor an image this can read")
    return Recording(
        name, {FLANGE: pose}, clouds[0] if clouds else None, image=images[0] if images else None
    )


def with_companion(recording: Recording) -> Recording:
    """Return a recording with the image of its cloud's name, or the cloud of its image's.

    Raises:
        StageError: There are two.
    """
    if recording.cloud and not recording.image:
        return replace(recording, image=_beside(recording.cloud, IMAGES))
    if recording.image and not recording.cloud:
        return replace(recording, cloud=_beside(recording.image, CLOUDS))
    return recording


def _beside(scan: Path, suffixes: Sequence[str]) -> Path | None:
    named_alike = sorted(scan.parent.glob(f"{escape(scan.stem)}.*"))
    found = [path for path in named_alike if path.suffix.lower() in suffixes]
    if len(found) > 1:
        names = " and ".join(path.name for path in found)
        raise StageError(f"{scan.parent}: {names} both belong to {scan.name}; keep one of them")
    return found[0] if found else None

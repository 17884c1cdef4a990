"""Arrays of poses as numerical programs save them: NumPy, MATLAB, OpenCV, ViSP, and text."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from flangeye import StageError
from flangeye.files.arrays import read_arrays
from flangeye.files.recording import NotThisLayout
from flangeye.files.regular import MAX_TEXT, read_regular, read_text
from flangeye.types import Floats

MAX_MATLAB = 1_000_000
"""Longest .mat file [bytes]: its compression makes a thousand times as much of it at most."""
_DIGITS = re.compile(r"(\d+)")
_NUMBER = re.compile(r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?")


def arrays_at(folder: Path, place: str) -> tuple[list[Path], list[tuple[str, Floats]]]:
    """Return the files read, and each pose's name and numbers, in the order of their names.

    Args:
        folder: Where files are.
        place: ``poses.npz:robot``, ``data.yml:T1_*``, ``poses.npy``, or ``robot/*.txt``: a file or
            a pattern of files, and behind a colon the array in it, or a pattern of arrays.

    Raises:
        NotThisLayout: There is no such file.
        StageError: A file cannot be read, or holds no such array.
    """
    name, _, key = place.partition(":")
    files = sorted((p for p in folder.glob(name) if p.is_file()), key=lambda p: _natural(str(p)))
    if not files:
        raise NotThisLayout(f"{folder}: holds no {name}")
    found: list[tuple[str, Floats]] = []
    for file in files:
        arrays = _chosen(file, _read(file), key)
        for array_name, array in arrays:
            alone = file.stem if len(arrays) == 1 else array_name
            found += _split(f"{file}: {array_name}".rstrip(": "), alone, array)
    return files, found


def _natural(text: str) -> list[tuple[int, str]]:
    """Return a key that sorts pose_2 before pose_10."""
    return [(int(p), "") if p.isdigit() else (-1, p) for p in _DIGITS.split(text)]


def _chosen(file: Path, arrays: dict[str, Floats], key: str) -> list[tuple[str, Floats]]:
    names = sorted(arrays, key=_natural)
    pattern = re.compile(re.escape(key).replace(r"\*", ".*") or ".*")
    chosen = [name for name in names if pattern.fullmatch(name)]
    if not chosen or (not key and len(chosen) > 1):
        what = f"has no array '{key}'" if key else "has several arrays"
        raise StageError(
            f"{file}: {what}; name one behind a colon, {file.name}:NAME; it has "
            f"{', '.join(names) or 'none'}"
        )
    return [(name, arrays[name]) for name in chosen]


def _split(where: str, name: str, array: Floats) -> list[tuple[str, Floats]]:
    """Return the poses of an array: one matrix, a pile of them, or a row each."""
    if array.shape in ((4, 4), (3, 4)) or array.ndim == 1 or min(array.shape) == 1:
        return [(name, array if array.ndim == 2 and min(array.shape) > 1 else array.ravel())]
    if array.ndim == 3 and array.shape[:2] in ((4, 4), (3, 4)) and array.shape[1:] != (4, 4):
        array = np.moveaxis(array, 2, 0)  # MATLAB counts poses last
    if array.ndim == 2 or (array.ndim == 3 and array.shape[1:] in ((4, 4), (3, 4))):
        return [(f"{i:04}", pose) for i, pose in enumerate(array)]
    raise StageError(f"{where}: is {'x'.join(map(str, array.shape))}, expected N x 4 x 4 or rows")


def _read(file: Path) -> dict[str, Floats]:
    """Return the arrays of a file by name; the name is empty where there is none.

    Raises:
        StageError: It cannot be read.
    """
    readers = {".npy": _numpy, ".npz": _numpy, ".mat": _matlab, ".xml": _opencv}
    try:
        head = read_regular(file, MAX_MATLAB if file.suffix.lower() == ".mat" else MAX_TEXT)[:10]
        reader = _opencv if head.startswith(b"%YAML") else readers.get(file.suffix.lower(), _text)
        return reader(file)
    except StageError:
        raise
    except Exception as error:  # damaged bytes can break these parsers in any way
        raise StageError(f"{file}: cannot be read: {error}") from None


def _numbers(arrays: Iterable[tuple[str, object]]) -> dict[str, Floats]:
    """Return those of a file's values that are arrays of numbers."""
    found = {name: np.asarray(value) for name, value in arrays}
    return {name: a.astype(np.float64) for name, a in found.items() if a.dtype.kind in "iuf"}


def _numpy(file: Path) -> dict[str, Floats]:
    return _numbers(read_arrays(file).items())


def _matlab(file: Path) -> dict[str, Floats]:
    from scipy.io import loadmat

    return _numbers((n, value) for n, value in loadmat(file).items() if not n.startswith("__"))


def _opencv(file: Path) -> dict[str, Floats]:
    import cv2

    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    root = storage.root()
    nodes = [(name, storage.getNode(name)) for name in root.keys()]  # noqa: SIM118  not a dict
    return _numbers((name, node.mat()) for name, node in nodes if node.isMap())


def _text(file: Path) -> dict[str, Floats]:
    """Return the numbers of a text, or of what ViSP calls YAML: those behind ``data:``."""
    lines = [line for line in read_text(file).splitlines() if line.strip()[:1] != "#"]
    text = "\n".join(lines)
    rows = _rows(text.rpartition("data:")[2].splitlines())
    if not rows or len({len(row) for row in rows}) != 1:
        raise StageError(f"{file}: is no table of numbers")
    return {"": np.array(rows)}


def _rows(lines: Sequence[str]) -> list[list[float]]:
    rows = [_NUMBER.findall(line.lstrip(" -") if "[" in line else line) for line in lines]
    return [[float(number) for number in row] for row in rows if row]

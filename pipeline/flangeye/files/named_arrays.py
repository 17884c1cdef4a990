"""Arrays of poses as numerical programs save them: NumPy, MATLAB, OpenCV, ViSP, JSON, and text."""

from __future__ import annotations

import io
import json
import re
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flangeye.errors import StageError
from flangeye.files import matlab_parser
from flangeye.files.arrays import read_arrays
from flangeye.files.children import python_command
from flangeye.files.pairs import natural
from flangeye.files.printable import reason_of
from flangeye.files.recording import NotThisLayout
from flangeye.files.regular import MAX_TEXT, read_regular, read_text
from flangeye.types import Floats

MAX_MATLAB = 1_000_000
"""Longest .mat file [bytes]."""
HDF5 = b"\x89HDF\r\n"
MATRICES = ((4, 4), (3, 3), (3, 4))
"""Shapes of a pose, of its rotation, and of a pose without its last row."""
_IN_YAML = re.compile(
    r"^ *(?P<name>[\w-]+): !!opencv-matrix\s+rows: (?P<rows>\d{1,9})\s+cols: (?P<cols>\d{1,9})\s+"
    r"dt: \"?(?P<channels>\d{0,3})[a-z]\"?\s+data: \[(?P<data>[^\]]*)\]",
    re.MULTILINE,
)
_IN_XML = re.compile(
    r"<(?P<name>[\w-]+) type_id=\"opencv-matrix\">\s*<rows>(?P<rows>\d{1,9})</rows>\s*"
    r"<cols>(?P<cols>\d{1,9})</cols>\s*<dt>\"?(?P<channels>\d{0,3})[a-z]\"?</dt>\s*"
    r"<data>(?P<data>[^<]*)</data>"
)
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
    files = sorted((p for p in folder.glob(name) if p.is_file()), key=lambda p: natural(str(p)))
    if not files:
        raise NotThisLayout(f"{folder}: holds no {name}")
    found: list[tuple[str, Floats]] = []
    for file in files:
        arrays = _chosen(file, arrays_of(file), key)
        for array_name, array in arrays:
            alone = file.stem if len(arrays) == 1 else array_name
            found += _split(f"{file}: {array_name}".rstrip(": "), alone, array)
    return files, found


def _chosen(file: Path, arrays: dict[str, Floats], key: str) -> list[tuple[str, Floats]]:
    names = sorted(arrays, key=natural)
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
    """Return the poses of an array: one matrix, a stack of them, or a row each."""
    if array.shape in MATRICES or array.ndim == 1 or (min(array.shape) == 1 and array.ndim == 2):
        return [(name, array if array.shape in MATRICES else array.ravel())]
    if array.ndim == 3 and array.shape[:2] in MATRICES and array.shape[1:] not in MATRICES:
        array = np.moveaxis(array, 2, 0)  # MATLAB counts poses last
    if array.ndim == 3 and 1 in array.shape[1:]:
        array = array.reshape(len(array), -1)  # OpenCV's vectors are columns
    if array.ndim == 2 or (array.ndim == 3 and array.shape[1:] in MATRICES):
        return [(f"{i:04}", pose) for i, pose in enumerate(array)]
    raise StageError(f"{where}: is {'x'.join(map(str, array.shape))}, expected N x 4 x 4 or rows")


def arrays_of(file: Path) -> dict[str, Floats]:
    """Return the arrays of a file by name; the name is empty where there is none.

    Raises:
        StageError: It cannot be read.
    """
    readers = {".npy": _numpy, ".npz": _numpy, ".mat": _matlab, ".xml": _opencv, ".json": _json}
    try:
        head = read_regular(file, MAX_MATLAB if file.suffix.lower() == ".mat" else MAX_TEXT)[:10]
        reader = _opencv if head.startswith(b"%YAML") else readers.get(file.suffix.lower(), _text)
        return reader(file)
    except StageError:
        raise
    except Exception as error:  # damaged bytes can break these parsers in any way
        raise StageError(f"{file}: cannot be read: {reason_of(error)}") from None


def _numbers(arrays: Iterable[tuple[str, object]]) -> dict[str, Floats]:
    """Return those of a file's values that are arrays of numbers."""
    found = {name: _array(value) for name, value in arrays}
    return {name: array for name, array in found.items() if array is not None}


def _array(value: object) -> Floats | None:
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths
        return None
    return array.astype(np.float64) if array.dtype.kind in "iuf" else None


def _numpy(file: Path) -> dict[str, Floats]:
    return _numbers(read_arrays(file).items())


def _matlab(file: Path) -> dict[str, Floats]:
    """Return the arrays of a .mat file: its parser, which damage can crash, has its own process."""
    command = python_command(matlab_parser.__file__)
    content = read_regular(file, MAX_MATLAB)
    if content.startswith(b"MATLAB 7.3") or content.startswith(HDF5):
        raise StageError(
            f"{file}: is a MATLAB 7.3 file (HDF5), which is not read; in MATLAB, write it anew: "
            f"load('{file.name}'); save('{file.name}', '-v7')"
        )
    try:
        done = subprocess.run(
            command, input=content, capture_output=True, timeout=matlab_parser.SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        raise StageError(
            f"{file}: cannot be read: its parser took more than {matlab_parser.SECONDS} s"
        ) from None
    if done.returncode < 0:
        raise StageError(f"{file}: cannot be read: it is damaged, its parser crashed")
    if done.returncode:
        raise ValueError(done.stderr.decode("utf-8", "replace"))
    found = np.load(io.BytesIO(done.stdout), allow_pickle=False)
    return {n.removeprefix(matlab_parser.PREFIX): a.astype(np.float64) for n, a in found.items()}


def _opencv(file: Path) -> dict[str, Floats]:
    """Return the matrices of a file that cv2.FileStorage wrote; damage would crash that class."""
    text = read_text(file)
    matrices = _IN_XML if file.suffix.lower() == ".xml" else _IN_YAML
    return {
        found["name"]: np.array(found["data"].replace(",", " ").split(), float).reshape(
            int(found["rows"]), int(found["cols"]), *map(int, filter(None, [found["channels"]]))
        )
        for found in matrices.finditer(text)
    }


def _json(file: Path) -> dict[str, Floats]:
    """Return what each key of an object holds; of a list of objects, each key of them all."""
    data: Any = json.loads(read_text(file))
    if isinstance(data, list) and data and all(isinstance(item, dict) for item in data):
        keys = [key for key in data[0] if all(key in item for item in data)]
        data = {key: [item[key] for item in data] for key in keys}
    return _numbers(data.items() if isinstance(data, dict) else [("", data)])


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

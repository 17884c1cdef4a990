"""Arrays of numbers in files, with the shape that a layout states."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye.errors import StageError
from flangeye.files.clouds.plain import load_npy, load_npz
from flangeye.files.regular import read_text
from flangeye.types import Floats


def read_npy(path: Path, shape: tuple[int | None, ...]) -> Floats:
    """Return the array of a .npy file.

    Args:
        path: The file.
        shape: Required shape; None is any length.

    Raises:
        StageError: It is missing, damaged, or of another shape.
    """
    return _checked(path, load_npy(path), shape)


def read_npz(path: Path, name: str, shape: tuple[int | None, ...]) -> Floats:
    """Return the array ``name`` of an .npz file.

    Raises:
        StageError: It is missing, damaged, or of another shape.
    """
    arrays = load_npz(path, name)
    if name not in arrays:
        raise StageError(f"{path}: holds no array '{name}'")
    return _checked(path, arrays[name], shape)


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an .npz file by name; the array of a .npy file has an empty name.

    Entries of an .npz file that are not arrays are left out.

    Raises:
        StageError: It is missing or damaged.
    """
    return {"": load_npy(path)} if path.suffix.lower() == ".npy" else load_npz(path)


def read_table(path: Path, width: int, rows: slice = slice(None)) -> Floats:
    """Return the rows of ``width`` numbers of a text file, as (n, width).

    Raises:
        StageError: The file is missing, or a row is not ``width`` numbers.
    """
    lines = read_text(path).splitlines()
    numbered = [(i, line.split()) for i, line in enumerate(lines, 1) if line.strip()][rows]
    if not numbered:
        raise StageError(f"{path}: holds no numbers")
    return np.array([_numbers(f"{path}:{i}", words, width) for i, words in numbered])


def _numbers(where: str, words: list[str], width: int) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise StageError(f"{where}: {error}") from None
    if len(values) != width or not all(map(math.isfinite, values)):
        raise StageError(f"{where}: has {len(values)} numbers, expected {width} finite numbers")
    return values


def _checked(path: Path, array: NDArray[Any], shape: tuple[int | None, ...]) -> Floats:
    fits = len(array.shape) == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in "fiu":
        wanted = ", ".join("n" if want is None else str(want) for want in shape)
        raise StageError(f"{path}: has shape {array.shape}, expected ({wanted}) numbers")
    return array.astype(np.float64)

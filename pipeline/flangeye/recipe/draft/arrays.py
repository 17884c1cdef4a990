"""Arrays of a folder that may be poses: where they are, and what their names say."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from flangeye.errors import FlangeyeError
from flangeye.files.named_arrays import arrays_of
from flangeye.recipe.draft.convention import SHAPES
from flangeye.recipe.draft.frames import frames_in, is_inverse, role_in
from flangeye.types import Floats

FILES = (".npz", ".npy", ".mat", ".xml", ".yml", ".yaml", ".json")
"""Files of arrays; text files are, where each holds one matrix."""
TEXTS = (".txt", ".csv", ".dat")
LARGEST = 10_000_000
"""A file that is larger [bytes] holds scans, and is not looked into."""
FEWEST = 3
"""Poses; so many arrays or files that are named alike are one list of them."""
FULL, ROTATIONS = ((4, 4), (3, 4)), ((3, 3),)

_PART = re.compile(r"(?<![a-z])(r|rot|rotations?|rvecs?|t|trans|translations?|tvecs?|pos)(?![a-z])")


@dataclass(frozen=True)
class PoseArrays:
    """Poses, one for each arm position, as ``reader.matrices`` names them.

    Attributes:
        at: FILE, FILE:ARRAY, or a pattern of either.
        shape: Of one of them.
        count: How many there are.
        translation: Where their positions are, if ``at`` holds the rotations only.
    """

    at: str
    shape: tuple[int, ...]
    count: int
    translation: str | None = None

    def __str__(self) -> str:
        """As people are told of it."""
        size = " x ".join(map(str, (self.count, *self.shape)))
        return f"{self.at} ({size})" + (f", with {self.translation}" if self.translation else "")

    @property
    def role(self) -> str | None:
        """``arm`` or ``target``, as the name says; None where it does not."""
        return role_in(self.at)

    @property
    def frames(self) -> tuple[str, str] | None:
        """Frames A and B of A_T_B, as the name says."""
        return frames_in(self.at.rpartition(":")[2])

    @property
    def inverse(self) -> bool:
        """Whether the name says flange_T_base, or target_T_camera."""
        return self.frames is not None and is_inverse(self.frames)


# --- where they are


def pose_arrays(folder: Path) -> list[PoseArrays]:
    """Return what a folder, and the folders in it, hold of arrays that may be poses."""
    found = [
        arrays
        for place, files in places(folder, (*FILES, *TEXTS))
        for arrays in (
            _in_files(folder, place, files) if len(files) > 1 else _in_file(place, *files)
        )
    ]
    counts = {a.count for a in found if a.shape != (3,)}
    return [a for a in found if a.count in counts]


def places(folder: Path, suffixes: Sequence[str]) -> Iterator[tuple[str, list[Path]]]:
    """Yield files as a recipe names them, those that are named alike under one pattern."""
    groups: dict[str, list[Path]] = defaultdict(list)
    for file in sorted([*folder.glob("*"), *folder.glob("*/*")]):
        if file.suffix.lower() in suffixes and file.is_file():
            alike = re.sub(r"\d+$", "*", file.stem) + file.suffix
            groups[str(file.relative_to(folder).with_name(alike))].append(file)
    single = [file for files in groups.values() if len(files) < FEWEST for file in files]
    one_each = [n for n, count in Counter(f.name for f in single).items() if count >= FEWEST]
    yield from ((place, files) for place, files in groups.items() if len(files) >= FEWEST)
    for file in single:
        if file.name not in one_each:
            yield str(file.relative_to(folder)), [file]
    for name in one_each:  # a folder for each capture
        yield f"*/{name}", [file for file in single if file.name == name]


def _arrays(file: Path) -> dict[str, Floats]:
    try:
        return arrays_of(file) if file.stat().st_size <= LARGEST else {}
    except FlangeyeError:
        return {}


def _in_files(folder: Path, place: str, files: Sequence[Path]) -> list[PoseArrays]:
    """Return the poses of files that hold one each."""
    arrays = list(_arrays(files[0]).values())
    if len(arrays) != 1 or arrays[0].shape not in FULL:
        return []
    return [PoseArrays(place, arrays[0].shape, len(files))]


def _in_file(place: str, file: Path) -> list[PoseArrays]:
    """Return the lists of poses in a file, arrays that are named alike as one."""
    if file.suffix.lower() in TEXTS:
        return []
    groups: dict[str, list[Floats]] = defaultdict(list)
    arrays = _arrays(file)
    for name, array in arrays.items():
        if not name and file.suffix.lower() in (".yml", ".yaml"):
            continue  # a text with numbers in it: of OpenCV's, each array has a name
        single = array.shape in (*FULL, *ROTATIONS)
        groups[re.sub(r"\d+$", "*", name) if single else name].append(array)
    found = []
    for name, alike in groups.items():
        at = f"{place}:{name}" if name else place
        shape = _items(alike[0]) if len(alike) == 1 else (len(alike), *alike[0].shape)
        if shape is not None and shape[0] >= FEWEST:
            found.append(PoseArrays(at, shape[1:], shape[0]))
    return found


def _items(array: Floats) -> tuple[int, ...] | None:
    """Return how many poses an array holds, and the shape of one; None if it holds none."""
    shape = array.shape
    if len(shape) == 3 and shape[1:] in (*FULL, *ROTATIONS):
        return shape
    if len(shape) == 3 and shape[:2] in (*FULL, *ROTATIONS):
        return (shape[2], *shape[:2])
    if len(shape) == 3 and shape[1:] in ((3, 1), (1, 3)):
        return (shape[0], 3)
    return shape if len(shape) == 2 and shape[1] in (3, *SHAPES) else None


def whole_poses(arrays: Sequence[PoseArrays]) -> list[PoseArrays]:
    """Return the poses, rotations joined to the positions that are named as they are."""
    whole = [a for a in arrays if a.shape not in (*ROTATIONS, (3,))]
    for rotation in arrays:
        key = _key(rotation.at)
        if rotation.shape not in (*ROTATIONS, (3,)) or key is None or key[0].startswith(("t", "p")):
            continue
        others = [a for a in arrays if a.shape == (3,) and a.count == rotation.count]
        for other in others:
            other_key = _key(other.at)
            if other_key and other_key[0].startswith(("t", "p")) and other_key[1] == key[1]:
                whole.append(replace(rotation, translation=other.at))
    joined = {a.translation for a in whole} | {a.at for a in whole}
    return [*whole, *(a for a in arrays if a.shape == (3,) and a.at not in joined)]


def _key(at: str) -> tuple[str, str] | None:
    """Return whether a name is of rotations or of positions, and the rest of it."""
    name = at.lower()
    match = _PART.search(name, name.rfind(":") + 1)
    return match and (match[1], name[: match.start()] + name[match.end() :])

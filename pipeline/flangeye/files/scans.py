"""Find the scans that belong to poses: clouds and images, paired by name or number."""

import math
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from glob import escape
from itertools import chain
from pathlib import Path

from flangeye.errors import StageError
from flangeye.files.clouds import CONVERSIONS, VENDOR
from flangeye.files.clouds.plain import npy_shape, open_npz, open_text
from flangeye.files.clouds.table import read_head
from flangeye.files.images import is_depth_image
from flangeye.files.recording import Recording
from flangeye.types import FLANGE, Floats, Warn

NumberKey = str | tuple[int, ...]


def natural(text: str) -> list[tuple[int, str]]:
    """Return a key that sorts pose_2 before pose_10."""
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in re.split(r"(\d+)", text)]


def numbers_of(names: Sequence[str]) -> list[tuple[int, ...]]:
    """Return the numbers that distinguish names: ``(7,)`` of cam0_07; empty if there is none."""
    runs = [tuple(map(int, re.findall(r"\d+", name))) for name in names]
    if len({len(run) for run in runs}) > 1:
        return [run[-1:] for run in runs]
    telling = [i for i, column in enumerate(zip(*runs, strict=True)) if len(set(column)) > 1]
    return [tuple(run[i] for i in telling) or run[-1:] for run in runs]


def partners(
    where: str, poses: Sequence[str], others: Sequence[str], what: str = "scans"
) -> tuple[list[int], str]:
    """Return the index of each pose's partner, and a note on how they were paired.

    Args:
        where: Prefix of messages.
        poses: Names of the poses, without endings.
        others: Names of the scans, or of the measurements.
        what: Word for the others in messages.

    Raises:
        StageError: Neither the names nor the numbers in them match one to one.
    """
    if set(poses) == set(others) and len(set(poses)) == len(poses) == len(others):
        return [others.index(name) for name in poses], f"paired by name: {_example(poses, poses)}"
    if not others:
        raise StageError(
            f"{where}: has {len(poses)} poses ({poses[0]}, …), but there are no {what}"
        )
    keys, other_keys = numbers_of(poses), numbers_of(others)
    lone = [p for p, k in zip(poses, keys, strict=True) if k not in other_keys or not k]
    other_lone = [o for o, k in zip(others, other_keys, strict=True) if k not in keys or not k]
    twice = len(set(keys)) < len(keys) or len(set(other_keys)) < len(other_keys)
    if lone or other_lone or twice:
        raise StageError(f"{where}: {_differing((poses, lone), (others, other_lone), what)}")
    found = [other_keys.index(key) for key in keys]
    return found, f"paired by number: {_example(poses, [others[i] for i in found])}"


def in_order(where: str, count: int, what: str, names: Sequence[str]) -> str:
    """Return the note that rows without names were paired with scans in their natural order.

    Args:
        where: Prefix of messages.
        count: Number of rows.
        what: Plural word for the rows in messages: poses.
        names: Names of the scans, in their order.

    Raises:
        StageError: The number of scans differs from the number of rows.
    """
    numbers = [key[0] for key in numbers_of(names) if len(key) == 1]
    span = range(min(numbers), max(numbers) + 1) if len(numbers) == len(names) > 0 else range(0)
    gaps = sorted(set(span) - set(numbers))
    missing = f", without {_list([str(gap) for gap in gaps])}" if gaps else ""
    if count != len(names):
        raise StageError(
            f"{where}: has {count} {what}, but the folder has {len(names)} scans{missing}; "
            "name the scan of each pose in a column called scan, or remove the surplus"
        )
    last = f", …, row {count} with {names[-1]}" if count > 1 else ""
    return f"{what} without names are paired in order: row 1 with {names[0]}{last}{missing}"


def _example(poses: Sequence[str], others: Sequence[str]) -> str:
    """Return the first and the last pair."""
    ends = dict.fromkeys((0, len(poses) - 1))
    return ", …, ".join(f"{poses[i]} with {others[i]}" for i in ends)


def _differing(
    ours: tuple[Sequence[str], Sequence[str]],
    theirs: tuple[Sequence[str], Sequence[str]],
    what: str,
) -> str:
    """Return a text with the names of each side, and those without a partner."""
    (poses, lone), (others, other_lone) = ours, theirs
    count = f"{len(poses)} poses ({poses[0]}, …) and {len(others)} {what} ({others[0]}, …)"
    if not lone and not other_lone:
        return f"{count}: some have the same number; give each pair a name or number of its own"
    sides = [f"no partner for {_list(names)}" for names in (lone, other_lone) if names]
    return f"{count} differ in their numbers: {', and '.join(sides)}; rename or remove them"


def _list(names: Sequence[str]) -> str:
    shown = 4
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    return ", ".join(names[:shown]) + more


CLOUD_SUFFIXES = (".pcd", ".ply", ".npy", ".xyz", ".pts", ".asc")
POINTS = (".csv", ".txt", ".npz")
"""Files that hold points or poses; their content decides which."""
IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


def scans_in(folder: Path, stem: str = "*") -> list[Path]:
    """Return the scans of a folder in natural order, clouds before images of the same name.

    Texts are scans where :func:`texts_of_points` says so.

    Raises:
        StageError: All scans are in a proprietary format.
    """
    files = sorted(folder.glob(f"{stem}.*"), key=lambda p: (natural(p.stem), p.suffix))
    points = texts_of_points(files)
    known = [p for p in files if p.suffix.lower() in (*CLOUD_SUFFIXES, *IMAGES) or p in points]
    found = [p for p in known if not is_matrix(p)]
    foreign = [p for p in files if p.suffix.lower() in VENDOR]
    if foreign and not found:
        raise StageError(f"{foreign[0]}: {CONVERSIONS[foreign[0].suffix.lower()]}")
    return found


def is_matrix(path: Path) -> bool:
    """Return whether a file is an array of no more numbers than a pose or a camera has."""
    if path.suffix.lower() != ".npy":
        return False
    try:
        return math.prod(npy_shape(path)) <= 16
    except StageError:
        return False


def texts_of_points(files: Iterable[Path]) -> set[Path]:
    """Return the text and .npz files that hold one cloud each.

    They are at least three files whose names differ in a number only.
    """
    alike: dict[str, list[Path]] = defaultdict(list)
    for path in files:
        if path.suffix.lower() in POINTS:
            alike[re.sub(r"\d+", "*", str(path))].append(path)
    groups = [group for group in alike.values() if len(group) > 2 and _holds_points(group[0])]
    return {path for group in groups for path in group}


def _holds_points(path: Path) -> bool:
    """Return whether a file has enough rows for a cloud: more than a pose or a camera has."""
    try:
        if path.suffix.lower() == ".npz":
            return math.prod(open_npz(path).shape) > 100
        table = open_text(path)
        head = read_head(path)[:500].decode("latin-1").lower()
    except StageError:
        return False
    rotation = re.search(r"\b(qx|rx|roll|yaw)", head)
    coloured = re.search(r"\b(r\W+g\W+b|red|nx|normal|intensity)\b", head)
    # x, y, z; intensity; a normal or a colour. Seven without names are a pose, and eight with time
    sized = table.width in (3, 4, 6) or coloured
    return bool(not rotation and len(table.shape) == 1 and table.shape[0] > 100 and sized)


@dataclass(frozen=True)
class PoseNames:
    """The poses for which scans are sought.

    Attributes:
        where: The poses' file or pattern, the prefix of messages.
        count: Number of poses.
        files: The file of each pose, if each has its own; else empty.
        names: Name of each pose, if they have names; else empty.
        ranked: Whether names that have no number in common with the scans' may be paired in order.
    """

    where: str
    count: int
    files: Sequence[Path] = ()
    names: Sequence[str] = ()
    ranked: bool = False

    @property
    def apart(self) -> bool:
        """Whether each pose has its own folder."""
        return len({file.parent for file in self.files}) == self.count > 1


def scans_of(
    folder: Path, poses: PoseNames, taken: Collection[Path] = ()
) -> tuple[list[list[Path]], list[str]]:
    """Return the scans of each pose, and notes of how they were paired.

    The scans are in the folder, in subfolders (``images/``, ``clouds/``), or in a folder for each
    pose. Named poses are paired by a common name or number, rows of a table by order. If no number
    is common, ``ranked`` poses are paired in order, with a warning.

    Args:
        folder: Folder of the scans.
        poses: The poses.
        taken: Files with poses, which are not scans.

    Raises:
        StageError: Names or numbers of scans and poses differ, or two folders have scans for all
            poses.
    """
    if poses.apart:
        lone = next((file for file in poses.files if not scans_in(file.parent)), None)
        if lone is not None:
            raise StageError(f"{lone}: no scan lies beside it; put it there, or remove the pose")
        return [scans_in(file.parent) for file in poses.files], []
    all_places = {p: _scans_by_stem(p, taken) for p in (folder, *sorted(folder.glob("*/")))}
    places = {p: found for p, found in all_places.items() if found} or {folder: {}}
    fitting, failed = {}, []
    for place, scans in places.items():
        try:
            fitting[place] = _paired(replace(poses, ranked=False), scans)
        except StageError as error:
            failed.append((len(scans), error))
    if not fitting:
        # Only then: a folder of other files, equal in number, must not compete with one that fits
        fullest = max(places, key=lambda place: len(places[place]))
        if not poses.ranked:
            raise max(failed, key=lambda pair: pair[0])[1]
        return _paired(poses, places[fullest])
    return _together(folder, [fitting[folder]] if folder in fitting else list(fitting.values()))


def _scans_by_stem(folder: Path, taken: Collection[Path]) -> dict[str, list[Path]]:
    found: dict[str, list[Path]] = {}
    for scan in scans_in(folder):
        if scan not in taken:
            found.setdefault(scan.stem, []).append(scan)
    return found


def _paired(poses: PoseNames, scans: dict[str, list[Path]]) -> tuple[list[list[Path]], list[str]]:
    """Return the scans of each pose, paired by name, or by number for a cloud and an image."""
    kinds = [
        {stem: [p for p in found if is_cloud(p) is kind] for stem, found in scans.items()}
        for kind in (True, False)
    ]
    split = [{stem: found for stem, found in kind.items() if found} for kind in kinds]
    try:
        return _by_name(poses, scans)
    except StageError:
        if not all(split):
            raise
        return _together(Path(poses.where), [_by_name(poses, kind) for kind in split])


def _by_name(poses: PoseNames, scans: dict[str, list[Path]]) -> tuple[list[list[Path]], list[str]]:
    stems = list(scans)
    if not poses.names:
        note = in_order(poses.where, poses.count, "poses", [scans[stem][0].name for stem in stems])
        return list(scans.values()), [note]
    ranked = _in_rank(poses.names, stems) if poses.ranked else None
    order, note = ranked or partners(poses.where, poses.names, stems)
    return [scans[stems[i]] for i in order], [note]


def _in_rank(poses: Sequence[str], others: Sequence[str]) -> tuple[list[int], Warn] | None:
    """Return partners in the order of the numbers in both names, with a warning.

    Two counters that never meet, such as p0 … p7 and frame_101 … frame_108, count the same things.
    If they share a number, pairing by number was meant, and a difference is a lost scan or pose.

    Returns:
        None if names share a number, have none, or differ in count.
    """
    keys, other_keys = numbers_of(poses), numbers_of(others)
    each = {*keys, *other_keys}
    if len(keys) != len(other_keys) or len(each) < 2 * len(keys) or {*map(len, each)} != {1}:
        return None
    ranks = {key: i for i, key in enumerate(sorted(keys))}
    sorted_others = sorted(range(len(others)), key=other_keys.__getitem__)
    order = [sorted_others[ranks[key]] for key in keys]
    pairs = _example(poses, [others[i] for i in order])
    return order, Warn(
        f"poses and scans have no number in common, so they are paired in order: {pairs}",
        "check the pairs; if they are wrong, name the scan of each pose in a column called scan",
    )


def _together(
    where: Path, found: Sequence[tuple[list[list[Path]], list[str]]]
) -> tuple[list[list[Path]], list[str]]:
    """Merge the clouds of one folder with the images of another."""
    scans = [list(chain.from_iterable(each)) for each in zip(*(s for s, _ in found), strict=True)]
    twice = next((paths for paths in scans if len({*map(is_cloud, paths)}) < len(paths)), None)
    if twice is not None:
        named = " and ".join(str(path.relative_to(path.parent.parent)) for path in twice)
        raise StageError(
            f"{where}: {named} could both belong to one pose; name the scan of each pose in a "
            "column called scan, or remove one folder"
        )
    return scans, list(dict.fromkeys(note for _, notes in found for note in notes))


def is_cloud(path: Path) -> bool:
    """Return whether a scan is a cloud, by its ending, or a depth image."""
    return path.suffix.lower() in (*CLOUD_SUFFIXES, *POINTS) or is_depth_image(path)


def recording_of(name: str, pose: Floats, scans: Sequence[Path]) -> Recording:
    """Return a pose with its cloud, its image, or both.

    Raises:
        StageError: A pose has two clouds or two images, or a file is neither.
    """
    clouds = [p for p in scans if is_cloud(p)]
    images = [p for p in scans if p.suffix.lower() in IMAGES and p not in clouds]
    if len(clouds) > 1 or len(images) > 1:
        names = ", ".join(p.name for p in scans)
        raise StageError(f"pose '{name}' has more than one cloud or image: {names}")
    if len(clouds) + len(images) < len(scans):
        raise StageError(f"{scans[0]}: is neither a cloud nor an image that flangeye reads")
    return Recording(
        name, {FLANGE: pose}, clouds[0] if clouds else None, image=images[0] if images else None
    )


def with_companion(recording: Recording) -> Recording:
    """Return a recording of a cloud or image with the other file of the same name, if there is one.

    Raises:
        StageError: There are two such files.
    """
    if recording.cloud and not recording.image:
        return replace(recording, image=_beside(recording.cloud, IMAGES))
    if recording.image and not recording.cloud:
        return replace(recording, cloud=_beside(recording.image, CLOUD_SUFFIXES))
    return recording


def _beside(scan: Path, suffixes: Sequence[str]) -> Path | None:
    try:
        named_alike = sorted(scan.parent.glob(f"{escape(scan.stem)}.*"))
    except OSError as error:  # its folder has a name that no file system takes
        raise StageError(f"{scan}: {error.strerror}") from None
    found = [p for p in named_alike if p.suffix.lower() in suffixes and p != scan]
    if len(found) > 1:
        names = " and ".join(path.name for path in found)
        raise StageError(f"{scan.parent}: {names} both belong to {scan.name}; keep one of them")
    return found[0] if found else None

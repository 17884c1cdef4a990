"""Which of two lists of names belong together: by the name or the number they have in common."""

from __future__ import annotations

import re
from collections.abc import Sequence

from flangeye.errors import StageError

Key = str | tuple[int, ...]


def natural(text: str) -> list[tuple[int, str]]:
    """Return a key that sorts pose_2 before pose_10."""
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in re.split(r"(\d+)", text)]


def numbers_of(names: Sequence[str]) -> list[tuple[int, ...]]:
    """Return the numbers that distinguish names: ``(7,)`` of cam0_07; empty where there is none."""
    runs = [tuple(map(int, re.findall(r"\d+", name))) for name in names]
    if len({len(run) for run in runs}) > 1:
        return [run[-1:] for run in runs]
    telling = [i for i, column in enumerate(zip(*runs, strict=True)) if len(set(column)) > 1]
    return [tuple(run[i] for i in telling) or run[-1:] for run in runs]


def partners(where: str, poses: Sequence[str], others: Sequence[str]) -> tuple[list[int], str]:
    """Return for each pose which of the others belongs to it, and a note of how they were paired.

    Args:
        where: What messages begin with.
        poses: Names of the poses, without endings.
        others: Names of the scans, or of what was measured at the poses.

    Raises:
        StageError: Neither the sets of names nor those of the numbers in them are equal, or two
            have one number.
    """
    if set(poses) == set(others) and len(set(poses)) == len(poses) == len(others):
        return [others.index(name) for name in poses], f"paired by name: {_example(poses, poses)}"
    if not others:
        raise StageError(f"{where}: has {len(poses)} poses ({poses[0]}, …), but there are no scans")
    keys, other_keys = numbers_of(poses), numbers_of(others)
    lone = [p for p, k in zip(poses, keys, strict=True) if k not in other_keys or not k]
    other_lone = [o for o, k in zip(others, other_keys, strict=True) if k not in keys or not k]
    twice = len(set(keys)) < len(keys) or len(set(other_keys)) < len(other_keys)
    if lone or other_lone or twice:
        raise StageError(f"{where}: {_differing(poses, others, lone, other_lone)}")
    found = [other_keys.index(key) for key in keys]
    return found, f"paired by number: {_example(poses, [others[i] for i in found])}"


def in_order(where: str, count: int, what: str, names: Sequence[str]) -> str:
    """Return the note that rows without names were paired with scans in their natural order.

    Args:
        where: What messages begin with.
        count: How many rows there are.
        what: What stands in a row, in the plural: poses.
        names: Of the scans, in their order.

    Raises:
        StageError: There are not as many.
    """
    numbers = [key[0] for key in numbers_of(names) if len(key) == 1]
    span = range(min(numbers), max(numbers) + 1) if len(numbers) == len(names) > 0 else range(0)
    gaps = sorted(set(span) - set(numbers))
    missing = f", without {_list([str(gap) for gap in gaps])}" if gaps else ""
    if count != len(names):
        raise StageError(
            f"{where}: has {count} {what}, but the folder {len(names)} scans{missing}; name the "
            "scan of each pose in a column called scan, or take the surplus away"
        )
    last = f", …, row {count} with {names[-1]}" if count > 1 else ""
    return f"{what} without names are paired in order: row 1 with {names[0]}{last}{missing}"


def _example(poses: Sequence[str], others: Sequence[str]) -> str:
    """Return the first and the last pair."""
    ends = dict.fromkeys((0, len(poses) - 1))
    return ", …, ".join(f"{poses[i]} with {others[i]}" for i in ends)


def _differing(
    poses: Sequence[str], others: Sequence[str], lone: Sequence[str], other_lone: Sequence[str]
) -> str:
    count = f"{len(poses)} poses ({poses[0]}, …) and {len(others)} scans ({others[0]}, …)"
    if not lone and not other_lone:
        return f"{count} share a number more than once; give each pair one name or number"
    sides = [f"no partner for {_list(names)}" for names in (lone, other_lone) if names]
    return f"{count} differ in their numbers: {', and '.join(sides)}; rename or remove them"


def _list(names: Sequence[str]) -> str:
    shown = 4
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    return ", ".join(names[:shown]) + more

"""Every combination of the grid's values."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

from flangeye.batch.request import SEED, BatchError, Request

_OPENING, _CLOSING = "[{", "]}"


def variants(request: Request) -> Iterator[dict[str, str]]:
    """Yield every combination of the grid: path in the recipe -> value as written.

    Args:
        request: What was asked for.

    Raises:
        BatchError: The grid or the repetition is not well written.
    """
    axes = _grid(request.grid)
    if request.repeat is not None:
        _check_repetition(request, taken=SEED in axes)
    for values in itertools.product(*axes.values()):
        yield dict(zip(axes, values, strict=True))


def split_values(text: str) -> list[str]:
    """Split ``a,b,c`` at its commas, those inside brackets and quotes aside."""
    values, depth, quote = [""], 0, ""
    for character in text:
        if quote:
            quote = "" if character == quote else quote
        elif character in "'\"":
            quote = character
        depth += (character in _OPENING) - (character in _CLOSING) if not quote else 0
        if character == "," and not depth and not quote:
            values.append("")
        else:
            values[-1] += character
    return [value.strip() for value in values]


def _grid(texts: Sequence[str]) -> dict[str, list[str]]:
    axes = dict(_axis(text) for text in texts)
    if len(axes) < len(texts):
        raise BatchError("--set-grid: the same path is given twice; write its values in one list")
    return axes


def _axis(text: str) -> tuple[str, list[str]]:
    path, equals, values = text.partition("=")
    split = split_values(values)
    if not equals or not path or not all(split):
        raise BatchError(
            f"--set-grid {text}: write PATH=a,b,c, for example steps.2.inlier='0.2 mm,0.3 mm'"
        )
    return path, split


def _check_repetition(request: Request, taken: bool) -> None:
    if request.vary != SEED:
        raise BatchError(
            f"--vary {request.vary}: only the seed can be repeated with; for other values write "
            f"--set-grid {request.vary}=a,b,c"
        )
    if taken:
        raise BatchError("--repeat counts the seed up, and --set-grid sets it; use one of them")

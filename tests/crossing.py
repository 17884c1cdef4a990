"""Pairs of what two parametrized arguments of a test may be."""

from collections.abc import Sequence
from typing import Any

import pytest


def crossed(some: Sequence[tuple[Any, ...]], others: Sequence[tuple[Any, ...]]) -> list[Any]:
    """Return every pair: each value with one of the others', and all that remain marked slow."""
    return [
        pytest.param(*one, *other, marks=[] if (i - j) % len(others) == 0 else pytest.mark.slow)
        for i, one in enumerate(some)
        for j, other in enumerate(others)
    ]

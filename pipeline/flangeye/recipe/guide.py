"""How a ``guide`` part, a procedure that leads a person, is called."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from flangeye.devices import MotionAllowed
from flangeye.recipe.load import Recipe

__all__ = ["Guide", "Recipe"]


class Guide(Protocol):
    """How a ``guide`` part is called."""

    def __call__(
        self, recipe: Recipe, motion: MotionAllowed, ask: Callable[[str], None], out: Path
    ) -> str:
        """Lead the person, write the outcome to ``out`` and return a line about it."""
        ...

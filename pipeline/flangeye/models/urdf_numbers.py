"""Numbers in a URDF's attributes."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

from flangeye.errors import RecipeError


def numbers_of(
    urdf: Path, element: ET.Element | None, name: str, default: str, count: int = 3
) -> list[float]:
    """Return the numbers of an attribute.

    Args:
        urdf: The file, for the message.
        element: What has it; None is as without it.
        name: Of the attribute.
        default: Its text where there is none.
        count: How many they are.

    Raises:
        RecipeError: They are others, or not finite.
    """
    text = default if element is None else element.get(name, default)
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        words = {1: "one finite number", 3: "three finite numbers"}
        raise RecipeError(f'{urdf}: {name}="{text[:80]}" is not {words[count]}')
    return numbers

"""What a function's signature says of its arguments, evaluated no earlier than it is asked for."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable, Iterator, Mapping
from types import SimpleNamespace
from typing import Any, get_type_hints


class Hints(Mapping[str, Any]):
    """Argument name -> type, each evaluated when it is read, and ``return``.

    A name such as ``np.random.Generator`` takes NumPy along, which takes longer than to check a
    recipe that names such a part.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        """Take note of what is written, and of what the names in it mean."""
        self._written = dict(inspect.get_annotations(function))
        self._names: dict[str, Any] = getattr(inspect.unwrap(function), "__globals__", {})

    def pop(self, name: str) -> Any:
        """Return one without keeping it, None where nothing is written."""
        found = self[name] if name in self else type(None)
        self._written.pop(name, None)
        return found

    def __getitem__(self, name: str) -> Any:
        """Return one; KeyError where nothing is written, NameError where it means nothing."""
        one = SimpleNamespace(__annotations__={name: self._written[name]})
        return get_type_hints(one, self._names)[name]

    def __contains__(self, name: object) -> bool:
        return name in self._written

    def __iter__(self) -> Iterator[str]:
        return iter(self._written)

    def __len__(self) -> int:
        return len(self._written)

    def says_as(self, other: Hints, name: str) -> bool:
        """Return whether both write the same of an argument, and mean the same by its names."""
        written = self._written[name]
        if not isinstance(written, str) or written != other._written[name]:
            return False
        names = {node.id for node in ast.walk(ast.parse(written)) if isinstance(node, ast.Name)}
        return all(self._names.get(each) is other._names.get(each) for each in names)

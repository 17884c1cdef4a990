"""Libraries that are there at once and loaded when something of them is first asked for."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from types import ModuleType
from typing import Any


class _Deferred(ModuleType):
    """A module until its first attribute is read; then the library of that name."""

    def __getattr__(self, attribute: str) -> Any:
        spec = self.__spec__
        if spec is None or spec.loader is None:
            raise AttributeError(attribute)
        # What the library reads of itself must not be asked for here again.
        self.__class__ = ModuleType  # type: ignore[assignment]
        self.__path__ = spec.submodule_search_locations or []
        spec.loader.exec_module(self)
        return getattr(self, attribute)


def defer(name: str) -> None:
    """Let ``import name`` cost nothing until something of it is used.

    For a command of one thread: another one could see the library half loaded. Python's own
    ``LazyLoader`` loads a library when it is imported a second time.

    Args:
        name: A library with no parent package; one that is loaded or not installed stays as it is.
    """
    spec = None if name in sys.modules else find_spec(name)
    if spec is None:
        return
    module = _Deferred(name)
    module.__spec__, module.__loader__, module.__file__ = spec, spec.loader, spec.origin
    sys.modules[name] = module

"""The garbage collector, paused where nothing is thrown away."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def collector_paused(keep: bool = False) -> Iterator[None]:
    """Leave the garbage collector off: modules stay, so looking through them finds nothing.

    Args:
        keep: Never look through what is there by the end, not even when Python ends, which takes a
            tenth of a short command. For processes that do one thing: garbage is kept as well.
    """
    running = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if keep:
            gc.freeze()
        if running:
            gc.enable()

"""Time and memory of a call."""

import time
import tracemalloc
from collections.abc import Callable
from typing import NamedTuple


class Cost(NamedTuple):
    """The best of a few calls, and what one call allocates at its peak.

    Memory is what Python and numpy allocate; what open3d takes inside is not seen.
    """

    seconds: float
    peak_mb: float


def measure(call: Callable[[], object], repeats: int = 3) -> Cost:
    """Return the cost of ``call``; it is called once more before, for late imports."""
    call()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    tracemalloc.start()
    call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return Cost(min(seconds), peak / 1e6)

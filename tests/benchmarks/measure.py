"""Time and memory of a call."""

import resource
import time
import tracemalloc
from collections.abc import Callable
from typing import NamedTuple


class Cost(NamedTuple):
    """The best of a few calls, and what one call allocates at its peak.

    Seconds are those of the processor, in this process and the ones it started and waited for:
    others who use the machine do not count. Memory is what Python and numpy allocate here; what
    open3d takes inside is not seen. Of a process of its own it is all that this held, if the call
    returns that [MB].
    """

    seconds: float
    peak_mb: float


def measure(call: Callable[[], object], repeats: int = 3) -> Cost:
    """Return the cost of ``call``; it is called once more before, for late imports."""
    call()
    seconds = []
    for _ in range(repeats):
        start = _spent()
        call()
        seconds.append(_spent() - start)
    tracemalloc.start()
    held = call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return Cost(min(seconds), held if isinstance(held, float) else peak / 1e6)


def _spent() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime

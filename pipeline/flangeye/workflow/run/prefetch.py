"""Process the next items in other threads, in order and bounded, with the same results."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")


@dataclass(frozen=True)
class FinishedCall:
    """A finished call: its result or exception, and its duration.

    Attributes:
        value: Returned value; None if it raised.
        error: Raised exception; None if it returned.
        seconds: Duration [s].
    """

    value: Any
    error: Exception | None
    seconds: float

    @classmethod
    def of(cls, call: Callable[[], Any]) -> FinishedCall:
        """Make a call and return it with its result or exception."""
        start = time.perf_counter()
        try:
            value, error = call(), None
        except Exception as raised:
            value, error = None, raised
        return cls(value, error, time.perf_counter() - start)

    def result(self) -> Any:
        """Return the call's result, or raise its exception."""
        if self.error is not None:
            raise self.error
        return self.value


def cores() -> int:
    """Return the number of worker threads: the process's cores, or OMP_NUM_THREADS."""
    told = os.environ.get("OMP_NUM_THREADS", "")
    # In a batch job or container the process may use fewer cores than the machine has
    own = hasattr(os, "sched_getaffinity")
    mine = len(os.sched_getaffinity(0)) if own else os.cpu_count() or 1
    return min(mine, int(told) or mine) if told.isdigit() else mine


def prefetched(
    items: Iterator[Item], work: Callable[[Item], Made], workers: int
) -> Generator[tuple[Item, Callable[[], Made]]]:
    """Yield each item in order with a function that returns or raises its result.

    Items are pulled in this thread and processed in worker threads. At most ``workers`` + 1 items
    are in flight, so memory does not grow with the number of items. If the consumer stops early,
    pending items are cancelled.
    """
    pool = ThreadPoolExecutor(workers, thread_name_prefix="flangeye")
    waiting: deque[tuple[Item, Future[Made]]] = deque()
    try:
        while (pulled := FinishedCall.of(partial(next, items))).error is None:
            waiting.append((pulled.value, pool.submit(work, pulled.value)))
            # One item more than workers waits, so that no worker is idle while the consumer holds
            # this thread
            while waiting and (len(waiting) > workers or waiting[0][1].done()):
                yield _first(waiting)
        while waiting:
            yield _first(waiting)
        if not isinstance(pulled.error, StopIteration):
            pulled.result()  # what ended the items is raised after what they were
    finally:
        pool.shutdown(cancel_futures=True)


def _first(waiting: deque[tuple[Item, Future[Made]]]) -> tuple[Item, Callable[[], Made]]:
    item, future = waiting.popleft()
    return item, future.result

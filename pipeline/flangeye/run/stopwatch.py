"""What each step of a run takes, the steps it pulls from excluded."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Exclusive time per label: while an inner step runs, the outer one stands still.

    Attributes:
        seconds: By label.
        calls: By label.
        idle: By label, share of the time in which an arm had nothing to do; None without an arm.
    """

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.calls: Counter[str] = Counter()
        self.idle: dict[str, float | None] = {}
        self._running: list[str] = []
        self._since: float  # when time was charged last

    @contextmanager
    def timing(self, label: str) -> Iterator[None]:
        """Charge the time inside to ``label``."""
        self._charge()
        self._running.append(label)
        self.calls[label] += 1
        try:
            yield
        finally:
            self._charge()
            self._running.pop()

    def add(self, label: str, seconds: float) -> None:
        """Charge what was done meanwhile, on another core, to ``label``."""
        self.calls[label] += 1
        self.seconds[label] += seconds

    def _charge(self) -> None:
        now = time.perf_counter()
        if self._running:
            self.seconds[self._running[-1]] += now - self._since
        self._since = now

"""What each step of a run takes, the steps it pulls from excluded."""

from __future__ import annotations

import time
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
        self.seconds: dict[str, float] = {}
        self.calls: dict[str, int] = {}
        self.idle: dict[str, float | None] = {}
        self._running: list[str] = []
        self._since = 0.0

    @contextmanager
    def timing(self, label: str) -> Iterator[None]:
        """Charge the time inside to ``label``."""
        self._charge()
        self._running.append(label)
        self.calls[label] = self.calls.get(label, 0) + 1
        try:
            yield
        finally:
            self._charge()
            self._running.pop()

    def add(self, label: str, seconds: float) -> None:
        """Charge what was done meanwhile, on another core, to ``label``."""
        self.calls[label] = self.calls.get(label, 0) + 1
        self.seconds[label] = self.seconds.get(label, 0.0) + seconds

    def _charge(self) -> None:
        now = time.perf_counter()
        if self._running:
            label = self._running[-1]
            self.seconds[label] = self.seconds.get(label, 0.0) + now - self._since
        self._since = now

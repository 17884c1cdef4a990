"""How long an arm has nothing to do."""

from __future__ import annotations


class Idle:
    """The time in which an arm stood while nothing was exposed, since it first set off.

    What is computed while the arm is under way, or stands for a scan, costs no time.
    """

    def __init__(self) -> None:
        self._began = self._stands_since = self._idle = 0

    def leaves(self, time_ns: int) -> None:
        """The arm sets off; before the first time it had no session to be idle in."""
        if self._began:
            self._idle += time_ns - self._stands_since
        else:
            self._began = time_ns

    def exposed(self, arrived_ns: int, began_ns: int, ended_ns: int) -> None:
        """It arrived, and was scanned for some time."""
        self._idle += max(0, began_ns - arrived_ns)
        self._stands_since = ended_ns

    @property
    def share(self) -> float | None:
        """Share of the session up to the last exposure; None before there was one."""
        whole = self._stands_since - self._began
        return self._idle / whole if whole > 0 else None

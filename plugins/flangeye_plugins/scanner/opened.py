"""What all open scanners share."""

from __future__ import annotations

from collections.abc import Mapping

from flangeye.devices import Device


class OpenScanner(Device):
    """A scanner that is in use; a driver adds ``expose``, and ``close`` where there is a device."""

    def __init__(self, name: str, facts: Mapping[str, str]) -> None:
        """Say who it is; see :class:`flangeye.devices.Scanner`."""
        self.name = name
        self.facts = dict(facts)

    def close(self) -> None:
        """Let go of the device; safe to call twice."""

"""What can go wrong with a controller of Universal Robots, on command."""

from __future__ import annotations

import asyncio

from flangeye_plugins.loopback.faults import Kind
from flangeye_plugins.loopback.network import Network
from flangeye_plugins.loopback.ur.controller import URController

DEFAULT_LATENCY = 0.1
"""[s]"""


class Mischief:
    """Causes faults, and ends those that can be ended.

    * ``protective-stop``, ``singularity``, ``joint-limit``: a protective stop, with that reason.
    * ``emergency-stop``: the button is pressed, the power goes.
    * ``program-stop``: somebody stops the program at the pendant.
    * ``remote-control-off``: somebody takes local control.
    * ``drop``: every connection is reset, once.
    * ``die``: connections are reset and nobody answers any more, for good or for a duration.
    * ``freeze``: connections stay open and nothing comes through, for good or for a duration.
    * ``latency``: every byte comes late by a duration, in both directions.

    The arm goes on with what it was doing when the network fails, as a real one does.

    Attributes:
        kinds: The faults by name.
    """

    def __init__(self, box: URController, network: Network) -> None:
        self._box, self._network = box, network
        self._dead = False
        self._revival: asyncio.Task[None] | None = None
        self.kinds = {
            "protective-stop": Kind(lambda _: box.protective_stop("on command")),
            "singularity": Kind(lambda _: box.protective_stop("near a singularity, on command")),
            "joint-limit": Kind(lambda _: box.protective_stop("a joint's limit, on command")),
            "emergency-stop": Kind(lambda _: box.emergency_stop("on command")),
            "program-stop": Kind(lambda _: box.stop_program("at the pendant")),
            "remote-control-off": Kind(self._go_local),
            "drop": Kind(lambda _: network.drop()),
            "die": Kind(self._die, takes_seconds=True),
            "freeze": Kind(self._freeze, takes_seconds=True),
            "latency": Kind(self._slow_down, takes_seconds=True),
        }

    def clear(self) -> None:
        """End a dead, frozen or slow network and local control."""
        self._network.latency = 0.0
        self._network.freeze(False)
        self._box.remote_control = True
        self._revive()

    def _go_local(self, seconds: float | None) -> None:
        del seconds
        self._box.remote_control = False

    def _die(self, seconds: float | None) -> None:
        self._network.kill()
        self._dead = True
        if seconds is not None:
            asyncio.get_running_loop().call_later(seconds, self._revive)

    def _revive(self) -> None:
        if self._dead:
            self._dead = False
            self._revival = asyncio.get_running_loop().create_task(self._network.listen())

    def _freeze(self, seconds: float | None) -> None:
        self._network.freeze(True)
        if seconds is not None:
            asyncio.get_running_loop().call_later(seconds, self._network.freeze, False)

    def _slow_down(self, seconds: float | None) -> None:
        self._network.latency = DEFAULT_LATENCY if seconds is None else seconds

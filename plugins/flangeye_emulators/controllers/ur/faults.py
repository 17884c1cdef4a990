"""What can go wrong with a controller of Universal Robots besides."""

from __future__ import annotations

from flangeye_emulators.controllers.fault_injection import FaultInjector
from flangeye_emulators.controllers.faults import Kind
from flangeye_emulators.controllers.network import Network
from flangeye_emulators.controllers.ur.controller import URController


class URFaultInjector(FaultInjector):
    """Causes three more faults.

    * ``program-stop``: somebody stops the program at the pendant.
    * ``remote-control-off``: somebody takes local control.
    * ``inputs-low``: what the digital outputs started does not run any more.
    """

    def __init__(self, box: URController, network: Network) -> None:
        super().__init__(box, network)
        self._box = box
        self.kinds["program-stop"] = Kind(lambda _: box.stop_program("at the pendant"))
        self.kinds["remote-control-off"] = Kind(self._go_local)
        self.kinds["inputs-low"] = Kind(lambda _: setattr(box, "wired", False))

    def clear(self) -> None:
        """End local control too, and wire the inputs again."""
        super().clear()
        self._box.remote_control = self._box.wired = True

    def _go_local(self, seconds: float | None) -> None:
        del seconds
        self._box.remote_control = False

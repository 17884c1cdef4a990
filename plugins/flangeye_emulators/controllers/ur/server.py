"""An emulated controller of Universal Robots as a process, with its dashboard server."""

from collections.abc import Callable

from flangeye.models.graph import EmulatorOptions
from flangeye_emulators.controllers.arm import joint_zeros, starting_joints
from flangeye_emulators.controllers.network import (
    Connection,
    FaultInjector,
    Kind,
    LineConnection,
    Network,
)
from flangeye_emulators.controllers.server import Server, run_server
from flangeye_emulators.controllers.ur import rtde
from flangeye_emulators.controllers.ur.controller import RefusedError, Runtime, URController
from flangeye_emulators.controllers.ur.script import run_program, take_program

DASHBOARD_PORT = 29999

Reply = Callable[[URController], str]


class DashboardSession(LineConnection):
    """Connection of one client of the dashboard."""

    def __init__(self, network: Network, box: URController) -> None:
        super().__init__(network)
        self._box = box

    def opened(self) -> None:
        """Send the greeting."""
        self.say("Connected: Universal Robots Dashboard Server")

    def line(self, text: str) -> None:
        """Answer one command."""
        if text.lower() in ("quit", "exit"):
            self.say("Disconnected")
            self.close()
            return
        self.say(answer(self._box, text))


def answer(box: URController, text: str) -> str:
    """Execute one command and return its answer."""
    act = DASHBOARD.get(text.lower())
    if act is None:
        return f"could not understand: '{text}'"
    try:
        return act(box)
    except RefusedError as refused:
        return str(refused)


def _doing(action: Callable[[URController], None], words: str) -> Reply:
    def act(box: URController) -> str:
        action(box)
        return words

    return act


def _stop(box: URController) -> None:
    box.stop_program("stopped at the dashboard")


DASHBOARD: dict[str, Reply] = {
    "polyscopeversion": lambda box: f"URSoftware {'.'.join(map(str, box.box.version))} (loopback)",
    "get serial number": lambda box: "20245500001",
    "get robot model": lambda box: box.robot.model.rstrip("e").upper(),
    "is in remote control": lambda box: str(box.remote_control).lower(),
    "running": lambda box: f"Program running: {str(box.runtime is Runtime.PLAYING).lower()}",
    "robotmode": lambda box: f"Robotmode: {box.robot_mode.name}",
    "safetymode": lambda box: f"Safetymode: {box.safety.name}",
    "stop": _doing(_stop, "Stopped"),
    "power on": _doing(URController.power_on, "Powering on"),
    "power off": _doing(URController.power_off, "Powering off"),
    "brake release": _doing(URController.release_brakes, "Brake releasing"),
    "unlock protective stop": _doing(URController.unlock, "Protective stop releasing"),
    "restart safety": _doing(URController.release_emergency_stop, "Restarting safety"),
}
"""Commands and what they answer."""


class URFaultInjector(FaultInjector):
    """Injects three faults specific to Universal Robots, besides the common ones.

    * ``program-stop``: the program is stopped at the pendant.
    * ``remote-control-off``: the controller is switched to local control.
    * ``inputs-low``: the feedback inputs of devices switched by outputs go low.
    """

    def __init__(self, box: URController, network: Network) -> None:
        super().__init__(box, network)
        self._box = box
        self.kinds["program-stop"] = Kind(lambda _: box.stop_program("at the pendant"))
        self.kinds["remote-control-off"] = Kind(self._go_local)
        self.kinds["inputs-low"] = Kind(lambda _: setattr(box, "wired", False))

    def clear(self) -> None:
        """Clear every fault, return to remote control and reconnect the inputs."""
        super().clear()
        self._box.remote_control = self._box.wired = True

    def _go_local(self, _: float | None) -> None:
        self._box.remote_control = False


class ScriptSession(Connection):
    """One client; each complete program that it sends replaces the running one."""

    def __init__(self, network: Network, box: URController) -> None:
        super().__init__(network)
        self._box = box
        self._buffer = ""

    def received(self, data: bytes) -> None:
        """Run each complete program."""
        self._buffer += data.decode("utf-8", "replace")
        source, self._buffer = take_program(self._buffer)
        while source is not None:
            run_program(self._box, source)
            source, self._buffer = take_program(self._buffer)
        # Bytes without the end of a program after which a client is cut off
        if len(self._buffer) > 1 << 20:
            self.abort()


def serve(options: EmulatorOptions) -> None:
    """Run a controller until the process is told to stop.

    Raises:
        StageError: A port is taken, or an option is wrong.
    """
    zeros = joint_zeros(options.robot, options.seed)
    box = URController(options.robot, starting_joints(options.robot, options.joints), zeros)
    network = Network(options.host)
    stream = rtde.RtdePort(network, box)
    script = 30003
    network.offer(script, lambda: ScriptSession(network, box))
    network.offer(DASHBOARD_PORT, lambda: DashboardSession(network, box))
    ports = {"RTDE": rtde.RTDE_PORT, "script": script, "dashboard": DASHBOARD_PORT}
    run_server(Server(options, box, network, URFaultInjector(box, network), ports), stream.publish)

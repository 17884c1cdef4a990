"""The dashboard server: commands and answers, a line of text each."""

from __future__ import annotations

from collections.abc import Callable

from flangeye_emulators.controllers.network import LineConnection, Network
from flangeye_emulators.controllers.ur.controller import (
    RefusedError,
    Runtime,
    URController,
    dashboard_name_of,
)

PORT = 29999
SERIAL_NUMBER = "20245500001"
PROGRAM_NAME = "loopback.urp"

Answer = Callable[[URController, str], str]


class DashboardSession(LineConnection):
    """One client."""

    def __init__(self, network: Network, box: URController) -> None:
        super().__init__(network)
        self._box = box

    def opened(self) -> None:
        """Greet."""
        self.say("Connected: Universal Robots Dashboard Server")

    def line(self, text: str) -> None:
        """Answer one command."""
        if text.lower() in ("quit", "exit"):
            self.say("Disconnected")
            self.close()
            return
        self.say(answer(self._box, text))


def answer(box: URController, text: str) -> str:
    """Return the answer to one command, after doing what it says."""
    lowered = text.lower()
    for command, act in ANSWERS.items():
        if lowered == command or lowered.startswith(command + " "):
            try:
                return act(box, text[len(command) :].strip())
            except RefusedError as refused:
                return str(refused)
    return f"could not understand: '{text}'"


def _doing(action: Callable[[URController], None], words: str) -> Answer:
    def act(box: URController, argument: str) -> str:
        del argument
        action(box)
        return words

    return act


def _telling(words: Callable[[URController], str]) -> Answer:
    return lambda box, argument: words(box)


def _stop(box: URController) -> None:
    box.stop_program("stopped at the dashboard")


def _program_state(box: URController) -> str:
    words = {Runtime.PLAYING: "PLAYING", Runtime.PAUSED: "PAUSED", Runtime.STOPPED: "STOPPED"}
    return f"{words[box.runtime]} {PROGRAM_NAME}"


def _version(box: URController) -> str:
    return f"URSoftware {'.'.join(map(str, box.box.version))} (loopback)"


ANSWERS: dict[str, Answer] = {
    "polyscopeversion": _telling(_version),
    "get serial number": _telling(lambda box: SERIAL_NUMBER),
    "get robot model": _telling(lambda box: dashboard_name_of(box.robot)),
    "is in remote control": _telling(lambda box: str(box.remote_control).lower()),
    "running": _telling(
        lambda box: f"Program running: {str(box.runtime is Runtime.PLAYING).lower()}"
    ),
    "programstate": _telling(_program_state),
    "robotmode": _telling(lambda box: f"Robotmode: {box.robot_mode.name}"),
    "safetymode": _telling(lambda box: f"Safetymode: {box.safety.name}"),
    "safetystatus": _telling(lambda box: f"Safetystatus: {box.safety.name}"),
    "get loaded program": _telling(lambda box: f"Loaded program: /programs/{PROGRAM_NAME}"),
    "isprogramsaved": _telling(lambda box: f"true {PROGRAM_NAME}"),
    "load": lambda box, name: f"Loading program: {name}",
    "play": _doing(URController.play, "Starting program"),
    "pause": _doing(URController.pause, "Pausing program"),
    "stop": _doing(_stop, "Stopped"),
    "power on": _doing(URController.power_on, "Powering on"),
    "power off": _doing(URController.power_off, "Powering off"),
    "brake release": _doing(URController.release_brakes, "Brake releasing"),
    "unlock protective stop": _doing(URController.unlock, "Protective stop releasing"),
    "restart safety": _doing(URController.release_emergency_stop, "Restarting safety"),
    "close safety popup": _telling(lambda box: "closing safety popup"),
    "close popup": _telling(lambda box: "closing popup"),
    "popup": _telling(lambda box: "showing popup"),
    "addtolog": _telling(lambda box: "Added log message"),
    "setuserrole": lambda box, role: f"Setting user role: {role}",
}
"""Commands and what they answer; a command with an argument is followed by it."""

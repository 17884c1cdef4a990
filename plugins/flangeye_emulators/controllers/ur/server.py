"""A controller of Universal Robots as a process, and its dashboard server."""

from __future__ import annotations

import re
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
from flangeye_emulators.controllers.poses import pose_matrix
from flangeye_emulators.controllers.server import Server, run_server
from flangeye_emulators.controllers.ur import rtde, server
from flangeye_emulators.controllers.ur.commands import COMMANDS, STREAMED, travel
from flangeye_emulators.controllers.ur.controller import (
    RefusedError,
    Registers,
    Runtime,
    URController,
    dashboard_name_of,
)
from flangeye_emulators.controllers.ur.program import Program, ProgramError, Thread
from flangeye_emulators.controllers.ur.script import (
    CONTROL_SCRIPT,
    ControlScript,
    ScriptSource,
    find_move,
    injected_path,
    register_offset,
    take_program,
)

PORT = 29999
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
    """Execute one command and return its answer."""
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
    "get serial number": _telling(lambda box: "20245500001"),
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


READY, DONE = 1, 2


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
        """Clear every fault, return to remote control and connect the inputs again."""
        super().clear()
        self._box.remote_control = self._box.wired = True

    def _go_local(self, seconds: float | None) -> None:
        del seconds
        self._box.remote_control = False


class CommandLoop(ControlScript):
    """Takes commands from the input registers, cycle by cycle."""

    def main(self) -> Thread:
        """Take commands until one ends the script."""
        self.show_progress(None)
        self._signal(READY)
        executed = False
        while True:
            code = self.integer(0) or self._take_internal()
            if code == 255:  # stop script
                return
            if code == 0:
                executed = False
                self._signal(READY)
            elif code in STREAMED:
                yield from self._process(code)
                self._signal(READY)
            elif not executed:
                self.box.note(f"command {code}")
                yield from self._process(code)
                self._signal(DONE)
                executed = True
            yield

    def _process(self, code: int) -> Thread:
        handler = COMMANDS.get(code)
        if handler is None:
            self.box.note(f"command {code} is not simulated")
            return
        thread = handler(self)
        if thread is not None:
            yield from thread

    def _take_internal(self) -> int:
        code, self.internal = self.internal, 0
        return code

    def _signal(self, state: int) -> None:
        self.box.registers.output_int[self.offset] = state


class ScriptSession(Connection):
    """One client; every whole program it sends takes the place of the one that runs."""

    def __init__(self, network: Network, box: URController) -> None:
        super().__init__(network)
        self._box = box
        self._buffer = ""

    def received(self, data: bytes) -> None:
        """Run each whole program."""
        self._buffer += data.decode("utf-8", "replace")
        source, self._buffer = take_program(self._buffer)
        while source is not None:
            run_program(self._box, source)
            source, self._buffer = take_program(self._buffer)
        # Bytes without the end of a program after which a client is cut off
        if len(self._buffer) > 1 << 20:
            self.abort()


def run_program(box: URController, source: ScriptSource) -> None:
    """Run a program; a controller that is not ready ignores it, as the robot does."""
    program: CommandLoop | CustomProgram
    if source.name == CONTROL_SCRIPT:
        program = CommandLoop(box, register_offset(source.text), injected_path(source.text))
    else:
        program = CustomProgram(box, source.text)
    try:
        box.load(program, source.name)
    except RefusedError as error:
        box.note(f"program {source.name} ignored: {error}")


def serve(options: EmulatorOptions) -> None:
    """Run a controller until the process is asked to end.

    Raises:
        StageError: A port is taken, or an option is wrong.
    """
    zeros = joint_zeros(options.robot, options.seed)
    box = URController(options.robot, starting_joints(options.robot, options.joints), zeros)
    network = Network(options.host)
    stream = rtde.RtdePort(network, box)
    script = 30003
    network.offer(script, lambda: ScriptSession(network, box))
    network.offer(server.PORT, lambda: server.DashboardSession(network, box))
    ports = {"RTDE": rtde.PORT, "script": script, "dashboard": server.PORT}
    run_server(Server(options, box, network, URFaultInjector(box, network), ports), stream.publish)


class CustomProgram(Program):
    """A program of plain calls: moves, registers, ``sleep``, ``stopj``, ``stopl``, ``set_tcp``."""

    def __init__(self, box: URController, source: str) -> None:
        """Run ``source``, from ``def`` to ``end``, on ``box``."""
        super().__init__(box.arm)
        self._box = box
        lines = [line.split("#")[0].strip() for line in source.splitlines()[1:-1]]
        self._lines = [line for line in lines if line]

    def main(self) -> Thread:
        """Run line after line."""
        for line in self._lines:
            move = find_move(line)
            if move is not None:
                yield from self.complete(lambda move=move: travel(self.arm, [move]))  # type: ignore[misc]
                continue
            call = re.fullmatch(r"(\w+)\((.*)\)", line)
            if call is None or call[1] not in CALLS:
                raise ProgramError(f"'{line}' is not simulated")
            numbers = [
                float(number) for number in re.findall(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?", call[2])
            ]
            thread = CALLS[call[1]](self, numbers)
            if thread is not None:
                yield from thread
        yield

    def write_integer(self, numbers: list[float]) -> None:
        """``write_output_integer_register(0 +24, 1)``: the last number is the value."""
        self._box.registers.output_int[self._register(numbers)] = int(numbers[-1])

    def write_float(self, numbers: list[float]) -> None:
        """``write_output_float_register(12, 0.5)``."""
        self._box.registers.output_double[self._register(numbers)] = numbers[-1]

    def _register(self, numbers: list[float]) -> int:
        register = int(sum(numbers[:-1]))
        if len(numbers) < 2 or not 0 <= register < Registers.COUNT:
            raise ProgramError(f"there is no register {register}")
        return register

    def sleep(self, numbers: list[float]) -> Thread:
        """``sleep(0.5)``."""
        until = self._box.time + sum(numbers)
        while self._box.time < until:
            yield

    def stop_joints_at(self, numbers: list[float]) -> Thread:
        """``stopj(2)``."""
        return self.stop_joints(numbers[0] if numbers else 2.0)

    def stop_in_space_at(self, numbers: list[float]) -> Thread:
        """``stopl(2)``."""
        return self.stop_in_space(numbers[0] if numbers else 2.0)

    def set_tool(self, numbers: list[float]) -> None:
        """``set_tcp(p[0, 0, 0.1, 0, 0, 0])``."""
        if len(numbers) != 6:
            raise ProgramError("set_tcp takes a pose of six numbers")
        self.arm.set_tool(pose_matrix(numbers))

    def say(self, numbers: list[float]) -> None:
        """``textmsg(...)``: nobody reads it."""
        del numbers


CALLS: dict[str, Callable[[CustomProgram, list[float]], Thread | None]] = {
    "write_output_integer_register": CustomProgram.write_integer,
    "write_output_float_register": CustomProgram.write_float,
    "sleep": CustomProgram.sleep,
    "stopj": CustomProgram.stop_joints_at,
    "stopl": CustomProgram.stop_in_space_at,
    "set_tcp": CustomProgram.set_tool,
    "textmsg": CustomProgram.say,
    "sync": CustomProgram.say,
}

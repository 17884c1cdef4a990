"""The port programs are uploaded to."""

from __future__ import annotations

from flangeye_emulators.controllers.network import Connection, Network
from flangeye_emulators.controllers.ur.command_loop import CommandLoop
from flangeye_emulators.controllers.ur.controller import RefusedError, URController
from flangeye_emulators.controllers.ur.custom import CustomProgram
from flangeye_emulators.controllers.ur.urscript import (
    CONTROL_SCRIPT,
    ScriptSource,
    injected_path,
    register_offset,
    take_program,
)

PORT = 30003


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

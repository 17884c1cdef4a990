"""Commands that set something."""

from __future__ import annotations

from typing import TYPE_CHECKING

from flangeye_emulators.controllers.poses import pose_matrix

if TYPE_CHECKING:
    from flangeye_emulators.controllers.ur.script import ControlScript


def set_payload(script: ControlScript) -> None:
    """17 and 65, setPayload and setTargetPayload; a centre of zeros keeps the old one."""
    centre = script.numbers(1, 3)
    script.box.payload = (
        script.number(0),
        centre if centre.any() else script.box.payload[1],
    )


def set_tool(script: ControlScript) -> None:
    """29, setTcp."""
    script.arm.set_tool(pose_matrix(script.numbers(0)))


def protective_stop(script: ControlScript) -> None:
    """31, triggerProtectiveStop."""
    script.box.protective_stop("commanded")


def set_watchdog(script: ControlScript) -> None:
    """35, setWatchdog: stop the program when commands come more slowly than [Hz]."""
    script.box.set_watchdog(script.offset, script.number(0))


def accept(script: ControlScript) -> None:
    """Do nothing: what is set has no effect on this arm."""
    del script


COMMANDS = {
    17: set_payload,
    20: accept,  # force mode damping
    29: set_tool,
    31: protective_stop,
    35: set_watchdog,
    56: accept,  # external force sensor through RTDE
    57: accept,  # external force sensor
    59: accept,  # gravity
    65: set_payload,
}

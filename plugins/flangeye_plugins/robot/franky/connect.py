"""The first connection to a controller, where nothing can hang."""

from __future__ import annotations

import subprocess

from flangeye.devices import DeviceError
from flangeye.files.children import python_command

CONNECTING = 2.5
"""Longest time until the controller answers [s]; the library itself waits for ever."""

TRIAL = """
import os, sys, franky
realtime = franky.RealtimeConfig.Enforce if sys.argv[2] == "True" else franky.RealtimeConfig.Ignore
try:
    franky.Robot(sys.argv[1], realtime_config=realtime)
except Exception as error:
    print(" ".join(str(error).split()), flush=True)
os._exit(0)
"""
"""Connects once, in a process that can be killed: where a host is silent, the library never
returns."""


def require_answer(name: str, host: str, realtime: bool) -> None:
    """Connect once, and let go again.

    Args:
        name: Name of the robot, for messages.
        host: Address of the controller.
        realtime: Whether to insist on a real-time kernel.

    Raises:
        DeviceError: It does not work, or takes too long.
    """
    command = python_command("-c", TRIAL, host, str(realtime))
    try:
        tried = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            timeout=CONNECTING,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise cannot_connect(name, f"nothing within {CONNECTING:g} s") from None
    if tried.stdout:
        raise cannot_connect(name, tried.stdout)
    if tried.returncode:
        raise cannot_connect(name, f"the library ended with {tried.returncode}")


def cannot_connect(name: str, why: str) -> DeviceError:
    """Return the error to raise."""
    return DeviceError(
        f"{name}: cannot connect ({one_line(why)}): is FCI active in Desk, is this its address, "
        "is this computer in its network?"
    )


def one_line(text: str) -> str:
    """Return what the library says, without its own line ends."""
    return " ".join(text.split())

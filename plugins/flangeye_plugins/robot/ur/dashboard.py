"""The first questions to a controller, before the client library is let near it."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import NamedTuple

from flangeye.devices import DeviceError
from flangeye_plugins.robot.ur import status
from flangeye_plugins.robot.ur.worker import ask_dashboard, read_remote

PATIENCE = 0.5
"""Longest wait for one answer [s]."""

ROUND_TRIP = 0.08
"""Longest way to the controller and back [s]: connecting takes twenty-five of them, and who is told
so late cannot stop an arm in time."""

QUESTIONS = ("PolyscopeVersion", "safetymode", "robotmode", "is in remote control")

_VERSION = re.compile(r"(\d+)\.\d+")


class Facts(NamedTuple):
    """What the dashboard says.

    Attributes:
        version: Version of the controller's software.
        period: Length of its cycle [s].
    """

    version: str
    period: float


def facts_of(name: str, host: str, to_drive: bool = True) -> Facts:
    """Return what there is to know of a controller that answers and, if asked, can be driven.

    Raises:
        DeviceError: Nobody answers; or it cannot be driven: it is not ready, the network is slow.
    """
    try:
        with ask_dashboard(host, PATIENCE) as ask:
            said, trips = zip(*(_timed(ask, question) for question in QUESTIONS), strict=True)
    except OSError as error:
        raise DeviceError(
            f"{name}: its dashboard server does not answer ({_reason(error)}): is the controller "
            f"on, is {host} its address, is this computer in its network?"
        ) from None
    version, safety, power, remote = said
    # One answer may be late because this computer is busy; all of them are where the network is.
    trouble = _trouble(safety.rpartition(" ")[2], power.rpartition(" ")[2], remote, min(trips))
    if trouble and to_drive:
        raise DeviceError(f"{name}: {trouble}")
    found = _VERSION.search(version)
    # CB3 controllers (version 3) have cycles of 8 ms, all later ones of 2 ms.
    return Facts(version, 0.008 if found and int(found[1]) < 5 else 0.002)


def stop(host: str) -> None:
    """Stop the controller's program on a way of its own: the last resort.

    Raises:
        OSError: Nobody answers.
    """
    with ask_dashboard(host, PATIENCE) as ask:
        ask("stop")


def _timed(ask: Callable[[str], str], question: str) -> tuple[str, float]:
    began = time.monotonic()
    return ask(question), time.monotonic() - began


def _trouble(safety: str, power: str, remote: str, trip: float) -> str:
    if safety in status.SAFETY_NAMES:
        return status.SAFETY[status.SAFETY_NAMES[safety]][1]
    if power != "RUNNING":
        return status.POWER
    if read_remote(remote) == 0:
        return status.REMOTE
    if trip > ROUND_TRIP:
        return (
            f"the network takes {trip * 1e3:.0f} ms to it and back, at most {ROUND_TRIP * 1e3:.0f} "
            "ms are allowed: connect it by cable, to a switch of its own"
        )
    return ""


def _reason(error: OSError) -> str:
    if isinstance(error, TimeoutError):
        return f"nothing within {PATIENCE:g} s"
    return error.strerror or str(error)

"""Libraries of the arms' makers, which not everybody has."""

from __future__ import annotations

import importlib.util

from flangeye.devices import DeviceError


def require_sdk(driver: str, module: str, extra: str) -> None:
    """Do nothing when ``module`` is installed; it is not imported yet.

    Raises:
        DeviceError: It is not; says how to install it.
    """
    if importlib.util.find_spec(module) is None:
        raise DeviceError(
            f"{driver}: the library {module} is not installed: pip install 'flangeye[{extra}]'"
        )

"""Import a vendor's SDK when a device is opened, or say in one line how to get it."""

from __future__ import annotations

import importlib
from typing import Any

from flangeye.devices import DeviceError


def load_sdk(module: str, driver: str, install: str) -> Any:
    """Return the module ``module``.

    Args:
        module: What to import.
        driver: Who needs it, for example ``scanner.realsense``.
        install: What brings it, for example ``pip install 'flangeye[realsense]'``.

    Raises:
        DeviceError: It is not there, or does not load; with the reason and the install hint.
    """
    try:
        return importlib.import_module(module)
    except (ImportError, OSError) as error:
        reason = str(error).strip().partition("\n")[0]
        raise DeviceError(f"{driver}: needs {module} ({reason}); {install}") from None

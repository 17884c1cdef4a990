"""Where an arm stands, for plans: asked without anything that could move it."""

from __future__ import annotations

from flangeye.devices import DeviceError, RobotDriver, RobotState
from flangeye.errors import FlangeyeError


def read_state(driver: RobotDriver) -> tuple[str, RobotState]:
    """Return an arm's name and its state; nothing is started on its controller, nothing commanded.

    Raises:
        DeviceError: The driver has no way to read alone, or the arm cannot be read: why.
    """
    if driver.read is None:
        raise DeviceError(f"{driver.name} has no way to read it without connecting to drive it")
    try:
        with driver.read() as robot:
            return robot.name, robot.state()
    except FlangeyeError:
        raise
    except Exception as error:  # a vendor's client may fail in any way
        raise DeviceError(
            f"{driver.name} failed with {type(error).__name__}: {' '.join(str(error).split())}"
        ) from error

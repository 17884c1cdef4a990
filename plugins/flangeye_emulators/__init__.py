"""Simulated hardware: cells, robot controllers, scanners and fingers.

The package is registered like a vendor's plugin. Nothing here runs on a real cell.
"""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from flangeye import hookimpl

if TYPE_CHECKING:
    from flangeye.models.graph import Emulator, EmulatorOptions


@hookimpl
def flangeye_stages() -> Mapping[str, str]:
    """Return the simulated stages: name to module and function."""
    return {
        "acquire.simulated": "flangeye_emulators.acquire.simulated:acquire_simulated",
        "acquire.simulated_cell": "flangeye_emulators.acquire.simulated_poses:"
        "acquire_simulated_cell",
        "acquire.simulated_cell_scans": "flangeye_emulators.acquire.simulated_scans:"
        "acquire_simulated_cell_scans",
        "acquire.simulated_marker": "flangeye_emulators.acquire.simulated_poses:"
        "acquire_simulated_marker",
        "acquire.simulated_session": "flangeye_emulators.acquire.simulated_scans:"
        "acquire_simulated_session",
        "acquire.simulated_images": "flangeye_emulators.acquire.simulated_images:"
        "acquire_simulated_images",
        "acquire.simulated_profiles": "flangeye_emulators.acquire.simulated_profiles:"
        "acquire_simulated_profiles",
        "scan.simulated": "flangeye_emulators.scan:scan_simulated",
    }


@hookimpl
def flangeye_parts() -> Mapping[str, str]:
    """Return the simulated parts: name to module and function."""
    return {
        "scanner.emulator": "flangeye_emulators.scanner:scanner_loopback",
        "scanner.mounted": "flangeye_emulators.scanner:scanner_mounted",
        "robot.emulator": "flangeye_emulators.robot:robot_loopback",
        "robot.simulated": "flangeye_emulators.robot:robot_simulated",
        "arc.simulated": "flangeye_emulators.arc:arc_simulated",
        "profiler.simulated": "flangeye_emulators.finger.profiler:profiler_simulated",
        "sensor.simulated_finger": "flangeye_emulators.finger.sensor:sensor_simulated_finger",
    }


def _serve_ur(options: "EmulatorOptions") -> None:
    from flangeye_emulators.controllers.ur.server import serve

    serve(options)


def _serve_aubo(options: "EmulatorOptions") -> None:
    from flangeye_emulators.controllers.aubo import serve

    serve(options)


@hookimpl
def flangeye_emulators() -> Iterable["Emulator"]:
    """Yield the emulators of the controllers of Universal Robots and of AUBO."""
    from flangeye.models.graph import Emulator

    return (
        Emulator("ur", "Universal Robots", _serve_ur),
        Emulator("aubo", "AUBO", _serve_aubo),
    )

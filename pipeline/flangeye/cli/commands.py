"""Every command: importing their modules declares them, in the order in which they are listed."""

from flangeye.cli import running, drafting, page, plugins, catalogue  # noqa: I001  their order
from flangeye.cli import logs, watching, exporting, hardware
from flangeye.cli.app import app

__all__ = [
    "app",
    "catalogue",
    "drafting",
    "exporting",
    "hardware",
    "logs",
    "page",
    "plugins",
    "running",
    "watching",
]

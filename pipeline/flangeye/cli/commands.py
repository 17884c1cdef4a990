"""Every command: importing their modules declares them."""

from flangeye.cli import catalogue, drafting, exporting, hardware, logs, running, watching
from flangeye.cli.app import app

__all__ = ["app", "catalogue", "drafting", "exporting", "hardware", "logs", "running", "watching"]

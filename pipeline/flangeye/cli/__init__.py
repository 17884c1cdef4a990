"""The ``flangeye`` command: parse, delegate, say what happened. No logic of the field is here.

Modules are imported inside the commands, so that ``--help`` answers at once. Commands are listed
in the order in which they are declared: running first.
"""

from flangeye.cli import running, drafting, page, offering, catalogue  # noqa: I001
from flangeye.cli import logs, watching, exporting, hardware
from flangeye.cli.app import app, main

__all__ = [
    "app",
    "catalogue",
    "drafting",
    "exporting",
    "hardware",
    "logs",
    "main",
    "offering",
    "page",
    "running",
    "watching",
]

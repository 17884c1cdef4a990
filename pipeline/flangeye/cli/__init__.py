"""The ``flangeye`` command: parse options, call the library, print. No calibration logic here.

Modules are imported inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING

from flangeye.cli.console import report_errors

if TYPE_CHECKING:
    from typer import Typer


def main() -> None:
    """Run the command line; an expected error is printed as one line and gives an exit code."""
    # Captures are worked on side by side and matrices are small: more threads in one product only
    # wait for each other, which costs a run twice its seconds. Read when numpy is imported
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    report_errors(lambda: commands()())


def commands() -> Typer:
    """Return the application with every command; importing a command's module declares it."""
    from flangeye.cli.app import app

    for name in ["catalogue", "drafting", "exporting", "hardware", "logs", "running", "watching"]:
        import_module(f"flangeye.cli.{name}")
    return app

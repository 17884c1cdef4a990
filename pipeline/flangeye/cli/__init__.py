"""The ``flangeye`` command: parse, delegate, say what happened. No logic of the field is here.

Modules are imported inside the commands, so that ``--help`` answers at once.
"""

import os

from flangeye.cli.console import end_in_words


def main() -> None:
    """Run the command line; every foreseen mistake is one line and an exit code."""
    # Captures are worked on side by side and matrices are small: more threads in one product only
    # wait for each other, which costs a run twice its seconds. Read when numpy is imported
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    end_in_words(_command)


def _command() -> None:
    from flangeye.cli.commands import app

    app()

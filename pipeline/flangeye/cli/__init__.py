"""The ``flangeye`` command: parse, delegate, say what happened. No logic of the field is here.

Modules are imported inside the commands, so that ``--help`` answers at once, and what was said
before, nothing having changed since, is said again before there is a parser.
"""

import sys

from flangeye.cli.saying import end_in_words


def main() -> None:
    """Run the command line; every foreseen mistake is one line and an exit code."""
    end_in_words(_command)


def _command() -> None:
    from flangeye.cli.remembered import said_again

    if not said_again(sys.argv[1:]):
        from flangeye.cli.commands import app

        app()

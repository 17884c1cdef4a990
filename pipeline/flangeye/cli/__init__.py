"""The ``flangeye`` command: parse, delegate, say what happened. No logic of the field is here.

Modules are imported inside the commands, so that ``--help`` answers at once; ``check RECIPE`` and
``stages`` need no parser.
"""

import sys

from flangeye.cli.saying import end_in_words


def main() -> None:
    """Run the command line; every foreseen mistake is one line and an exit code."""
    end_in_words(_command)


def _command() -> None:
    from flangeye.cli.unparsed import answered

    if not answered(sys.argv[1:]):
        from flangeye.cli.commands import app

        app()

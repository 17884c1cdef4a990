"""Every command: importing their modules declares them, in the order in which they are listed."""

from collections.abc import Sequence  # noqa: I001  the order of the commands
from copy import copy

import typer
from typer.main import get_command_name
from typer.models import CommandInfo

from flangeye.cli import running, drafting, page, plugins, catalogue
from flangeye.cli import logs, watching, exporting, hardware
from flangeye.cli.app import app

__all__ = [
    "app",
    "catalogue",
    "drafting",
    "exporting",
    "hardware",
    "logs",
    "named_in",
    "page",
    "plugins",
    "running",
    "watching",
]


def named_in(words: Sequence[str]) -> typer.Typer:
    """Return the app, the options known of those commands alone that are named in ``words``.

    Of the others the name and the help remain, which is what a list of commands shows: making the
    options of all of them takes longer than importing numpy.
    """
    some = copy(app)
    some.registered_commands = [_listed(each, words) for each in app.registered_commands]
    return some


def _listed(command: CommandInfo, words: Sequence[str]) -> CommandInfo:
    call = command.callback
    assert call is not None  # noqa: S101  for type checkers
    name = command.name or get_command_name(call.__name__)
    if name in words:
        return command
    listed = copy(command)
    listed.name, listed.help, listed.callback = name, command.help or call.__doc__, lambda: None
    return listed

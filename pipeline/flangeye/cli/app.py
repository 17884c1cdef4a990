"""The ``flangeye`` command itself, what its commands share, and how mistakes end it."""

from __future__ import annotations

import os
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from flangeye import __version__
from flangeye.errors import FlangeyeError, NothingMoved

if TYPE_CHECKING:
    from flangeye.registry import Registry

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Hand-eye calibration from the robot's own flange, driven by YAML recipes.\n\n"
    "Start with: flangeye run ur5_phoxi-m_simulated\n\n"
    "Exit codes: 0 done, 1 the calibration was refused, 2 bad input.",
)

RecipeName = Annotated[str, typer.Argument(help="A recipe file, or the name of a shipped recipe.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="PATH=VALUE", help="Override one value: steps.2.inlier='0.2 mm'."
    ),
]
LogFile = Annotated[Path, typer.Argument(help="The run.mcap of a run.")]


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"flangeye {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Say which one this is."
        ),
    ] = False,
) -> None:
    """Nothing but what stands before a command."""


def load_plugins() -> Registry:
    """Load every installed plugin, and leave their list for the next ``flangeye stages``."""
    from flangeye.listing import remember
    from flangeye.registry import load_registry

    registry = load_registry()
    remember(registry)
    return registry


def main() -> None:
    """Run the command line; every foreseen mistake is one line and an exit code."""
    try:
        app()
    except NothingMoved as plan:
        typer.echo(str(plan))
    except FlangeyeError as error:
        _fail(error)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:
        if error.filename is None:  # not a file the person named
            raise
        _fail(FlangeyeError(f"{error.filename}: cannot be read or written: {error.strerror}"))


def _fail(error: FlangeyeError) -> NoReturn:
    if os.environ.get("FLANGEYE_DEBUG"):
        traceback.print_exception(error)
    for line in str(error).splitlines():
        sys.stderr.write(f"error: {line}\n")
    sys.exit(error.exit_code)

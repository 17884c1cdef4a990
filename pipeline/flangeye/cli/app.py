"""The ``flangeye`` command itself, what its commands share, and how mistakes end it."""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from flangeye.errors import FlangeyeError, NothingMoved
from flangeye.files.children import keep_current_folder_out
from flangeye.files.printable import printable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from flangeye.plugin.registry import Registry
    from flangeye.recipe.load import Recipe

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Hand-eye calibration from the robot's own flange, driven by YAML recipes.\n\n"
    "Start with: flangeye run ur5_phoxi-m_simulated\n\n"
    "Exit codes: 0 done, 1 the calibration was refused, 2 bad input.",
)


def complete_recipe(typed: str) -> list[str]:
    """Return the bundled recipes that begin as typed; the shell completes files itself."""
    from flangeye.recipe.load import recipe_names

    return [name for name in recipe_names() if name.startswith(typed)]


RecipeName = Annotated[
    str,
    typer.Argument(
        help="A recipe file, or the name of a bundled recipe.", autocompletion=complete_recipe
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="PATH=VALUE",
        help="Override one value: fit.rim.inlier='0.2 mm', or a step: steps.3=solve.svd.",
    ),
]
LogFile = Annotated[Path, typer.Argument(help="A run's folder, or its run.mcap.")]


def _print_version(wanted: bool) -> None:
    if wanted:
        from flangeye.files.bundled import VERSION

        say(f"flangeye {VERSION}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Nothing but what stands before a command."""


def say(text: object, err: bool = False) -> None:
    """Write a line; what others wrote in it reaches the terminal as text, never as commands."""
    typer.echo(printable(str(text)), err=err)


def load_plugins() -> Registry:
    """Find every installed plugin."""
    from flangeye.plugin.registry import load_registry

    return load_registry()


def read_recipe(name: str, registry: Registry, overrides: Sequence[str] | None = None) -> Recipe:
    """Return a checked recipe by path or name; say which names in it are outdated."""
    from flangeye.recipe.load import find_recipe, load_recipe

    recipe = load_recipe(find_recipe(name), registry, overrides or ())
    for note in registry.notes():
        sys.stderr.write(f"note: {note}\n")
    return recipe


def main() -> None:
    """Run the command line; every foreseen mistake is one line and an exit code."""
    keep_current_folder_out()
    # Ours are no plugins of pydantic; it would look for one in every installed distribution.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    _open_streams()
    try:
        try:
            app()
        finally:
            sys.stdout.flush()
    except NothingMoved as plan:
        say(plan)
    except FlangeyeError as error:
        _fail(error)
    except BrokenPipeError:
        _discard_output()
        sys.exit(0)
    except OSError as error:
        what = error.filename or "standard output"
        if error.filename is None:
            _discard_output()
        _fail(FlangeyeError(f"{what}: cannot be read or written: {error.strerror or error}"))


def _open_streams() -> None:
    """Make sure that there is something to write to, in any locale, whoever closed it."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _discard_output() -> None:
    """Forget what could not be written, or the interpreter would try again at its end."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(error: FlangeyeError) -> NoReturn:
    if os.environ.get("FLANGEYE_DEBUG"):
        import traceback

        traceback.print_exception(error)
    with suppress(OSError):
        for line in printable(str(error)).splitlines():
            sys.stderr.write(f"error: {line}\n")
    sys.exit(error.exit_code)

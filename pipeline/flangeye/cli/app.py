"""The ``flangeye`` command, and what its subcommands share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from flangeye.cli.console import say, say_notes
from flangeye.errors import FlangeyeError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from flangeye.plugin.registry import Registry
    from flangeye.workflow.recipe.load import Recipe

GROUPS = {
    "Calibrate": ("init", "check", "run", "ui", "watch"),
    "Judge": ("show", "report", "doctor", "certificate", "touch"),
    "Use": ("export", "publish", "monitor", "layout"),
    "Many": ("batch", "regress"),
    "Extend": (
        "new-plugin", "new-robot", "new-scanner", "plugins", "stages", "schema", "emulator",
        "tactile",
    ),
    "Catalogue": ("recipes", "robots", "scanners", "standards"),
}  # fmt: skip
"""Commands by what a person wants to do, in the order in which ``--help`` lists them."""


class GroupedCommands(TyperGroup):
    """Lists commands under the headings of :data:`GROUPS`; those of no group come last."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one section for each group."""
        shown = {name: each for name, each in self.commands.items() if not each.hidden}
        grouped = {name for names in GROUPS.values() for name in names}
        sections = {**GROUPS, "More": [name for name in shown if name not in grouped]}
        for title, names in sections.items():
            # Whole sentences, which the formatter wraps, and does not cut as Click's own help
            rows = [(n, shown[n].get_short_help_str(200)) for n in names if n in shown]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


app = typer.Typer(
    cls=GroupedCommands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Hand-eye calibration from the robot's own flange, driven by YAML recipes.\n\n"
    "Start with: flangeye run ur5_phoxi-m_simulated\n\n"
    "Exit codes: 0 done, 1 the calibration was refused, 2 bad input.",
)


def complete_recipe(typed: str) -> list[str]:
    """Return the bundled recipes that match a prefix; the shell completes files itself."""
    from flangeye.workflow.recipe.find import recipe_names

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
RunArgument = Annotated[
    Path, typer.Argument(help="A run: its folder, run.mcap or calibration.yaml.")
]


def _print_version(wanted: bool) -> None:
    if wanted:
        from flangeye.files.paths import VERSION

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
    """Handle the options that stand before a command."""


def load_plugins() -> Registry:
    """Find every installed plugin."""
    from flangeye.plugin.registry import load_registry

    return load_registry()


def read_recipe(name: str, registry: Registry, overrides: Sequence[str] | None = None) -> Recipe:
    """Return a checked recipe by path or name; print its notes."""
    from flangeye.workflow.recipe.find import find_recipe
    from flangeye.workflow.recipe.load import load_recipe

    recipe = load_recipe(find_recipe(name), registry, overrides or ())
    say_notes(recipe.notes)
    return recipe


def ask(question: str, instead: str, default: str | None = None) -> str:
    """Ask at the terminal and return the answer; ``default`` for an empty line.

    Raises:
        FlangeyeError: There is nobody to answer; the message says what to give ``instead``.
    """
    shown = bool(default)  # an empty default is only what Enter says
    try:
        return str(typer.prompt(question, default=default, show_default=shown))
    except typer.Abort:
        raise FlangeyeError(f"{question}: was not answered; {instead}") from None

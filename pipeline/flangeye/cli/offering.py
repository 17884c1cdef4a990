"""What there is: recipes, stages, parts, plugins, and what a recipe may say."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flangeye.cli.app import Overrides, RecipeName, app, load_plugins


@app.command()
def check(recipe: RecipeName, overrides: Overrides = None) -> None:
    """Check a recipe without running it: every mistake, with its line; what it has to find."""
    from flangeye.configuration import Configuration
    from flangeye.recipe import find_recipe, load_recipe

    path = find_recipe(recipe)
    checked = load_recipe(path, load_plugins(), overrides or ())
    typer.echo(f"{path}: ok, {len(checked.steps)} steps")
    typer.echo(checked.context[Configuration].describe())


@app.command()
def recipes() -> None:
    """List the shipped recipes."""
    from flangeye.recipe import recipe_names
    from flangeye.yamlfile import read_yaml

    names = recipe_names()
    width = max(map(len, names), default=0)
    for name, path in names.items():
        typer.echo(f"{name:{width}}  {read_yaml(path).data.get('title', '')}")


@app.command()
def stages(
    name: Annotated[str | None, typer.Argument(help="A stage or part, for its parameters.")] = None,
) -> None:
    """List stages and parts; with NAME its parameters, units, defaults and meaning."""
    if name is None:
        from flangeye.listing import list_stages

        typer.echo(list_stages())
        return
    from flangeye.catalogue_text import describe_one

    typer.echo(describe_one(load_plugins(), name))


@app.command()
def plugins() -> None:
    """List the installed plugins, what each offers, and those that could not be loaded."""
    registry = load_plugins()
    for plugin, version in registry.versions().items():
        offers = sorted(n for n, owner in registry.owners.items() if owner == plugin)
        typer.echo(f"{plugin} {version}: {', '.join(offers) or 'no stages or parts'}")
    for plugin, error in registry.broken.items():
        typer.echo(f"{plugin}: could not be loaded: {type(error).__name__}: {error}")


@app.command()
def schema(
    result: Annotated[bool, typer.Option("--result", help="The schema of result.json.")] = False,
    out: Annotated[Path | None, typer.Option(help="File to write instead of printing.")] = None,
) -> None:
    """Print the JSON Schema of recipes, for editors that check YAML while you type."""
    import json

    from flangeye.result import Result
    from flangeye.schema import header_line, recipe_schema

    document = Result.model_json_schema() if result else recipe_schema(load_plugins())
    text = json.dumps(document, indent=2, ensure_ascii=False)
    if out is None:
        typer.echo(text)
    else:
        out.write_text(text + "\n", encoding="utf-8")
    if not result:
        typer.echo(f"first line of your recipe: {header_line(out)}", err=True)


@app.command("new-plugin")
def new_plugin(
    name: Annotated[str, typer.Argument(help="Of the plugin, for example acme_hull.")],
    kind: Annotated[str, typer.Option(help="What it is: scanner, fit, solve, …")],
    into: Annotated[Path, typer.Option(help="Where its folder is made.")] = Path(),
) -> None:
    """Write an installable package with one plugin, a stand-in whose tests pass at once."""
    from flangeye.newplugin import write_plugin

    folder = write_plugin(name, kind, into)
    typer.echo(f"{folder}: pip install --editable '{folder}[dev]' && pytest {folder}")

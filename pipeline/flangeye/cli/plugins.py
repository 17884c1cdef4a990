"""What there is: recipes, stages, parts, plugins, and what a recipe may say."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flangeye.cli.app import Overrides, RecipeName, app, load_plugins
from flangeye.cli.console import say


@app.command()
def check(recipe: RecipeName, overrides: Overrides = None) -> None:
    """Check a recipe without running it.

    Prints every mistake with its line, or the transforms that will be estimated.
    """
    from flangeye.recipe.find import find_recipe
    from flangeye.recipe.load import describe_recipe

    say(describe_recipe(find_recipe(recipe), load_plugins(), overrides or ()))


@app.command()
def recipes() -> None:
    """List the bundled recipes."""
    from flangeye.files.yaml_lines import read_yaml
    from flangeye.recipe.find import recipe_names

    names = recipe_names()
    width = max(map(len, names), default=0)
    for name, path in names.items():
        say(f"{name:{width}}  {read_yaml(path).data.get('title', '')}")


@app.command()
def stages(
    name: Annotated[
        str | None, typer.Argument(help="A stage or part, or a kind such as solve.")
    ] = None,
) -> None:
    """List stages and parts; with NAME, its parameters.

    NAME may be a kind (reader, solve, …) or one stage or part.
    """
    from flangeye.plugin.describe import describe_all, describe_one

    registry = load_plugins()
    say(describe_all(registry) if name is None else describe_one(registry, name))


@app.command()
def plugins() -> None:
    """List installed plugins and those that failed to load."""
    registry = load_plugins()
    registry.everything()
    for plugin, version in registry.versions().items():
        offers = sorted(n for n, owner in registry.owners.items() if owner == plugin)
        say(f"{plugin} {version}: {', '.join(offers) or 'no stages or parts'}")
    for plugin, error in registry.broken.items():
        say(f"{plugin}: could not be loaded: {type(error).__name__}: {error}")


@app.command()
def schema(
    result: Annotated[
        bool, typer.Option("--result", help="Print the schema of result.json instead.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="File to write instead of printing.")] = None,
) -> None:
    """Print the JSON Schema of recipes, for YAML editors."""
    import json

    from flangeye.files.written import write_whole
    from flangeye.recipe.schema import header_line, recipe_schema
    from flangeye.result import Result

    document = Result.model_json_schema() if result else recipe_schema(load_plugins())
    text = json.dumps(document, indent=2, ensure_ascii=False)
    if out is None:
        say(text)
    else:
        write_whole(out, text + "\n")
    if not result:
        say(f"first line of your recipe: {header_line(out)}", err=True)


@app.command("new-plugin")
def new_plugin(
    name: Annotated[str, typer.Argument(help="Name of the plugin, for example acme_hull.")],
    kind: Annotated[str, typer.Option(help="Kind of plugin: scanner, fit, solve, …")],
    into: Annotated[Path, typer.Option(help="Folder in which to create the package.")] = Path(),
) -> None:
    """Create a package with an example plugin and its tests."""
    from flangeye.plugin.scaffold import write_plugin

    folder = write_plugin(name, kind, into)
    say(f"{folder}: pip install --editable '{folder}[dev]' && pytest {folder}")

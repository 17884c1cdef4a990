"""List arms, scanners, standards, recipes, stages, parts and plugins; create new models."""

from pathlib import Path
from typing import Annotated

import typer

from flangeye.cli.app import Overrides, RecipeName, app, ask, load_plugins
from flangeye.cli.console import say, say_notes


@app.command()
def robots() -> None:
    """List robot models: joints, plate."""
    from flangeye.models.loading import load_model, model_names

    for name in model_names("robots"):
        robot = load_model("robots", name)
        plate = robot.flange.standard or "say the plate: feature.standard"
        say(f"{name:20}  {robot.maker:17}  {len(robot.joints)} joints  {plate}")


@app.command()
def scanners() -> None:
    """List scanner models: principle, range, noise."""
    from flangeye.models.loading import load_model, model_names

    for name in model_names("scanners"):
        s = load_model("scanners", name)
        see = f"{1e3 * s.near:.0f} to {1e3 * s.far:.0f} mm"
        say(
            f"{name:17}  {s.maker:10}  {s.principle:16}  {see:15}  {s.columns} x {s.rows}  "
            f"noise {1e3 * s.temporal_noise:g} mm"
        )


@app.command()
def standards() -> None:
    """List flange plates: diameters and threads."""
    from flangeye.models.targets import known_standards

    for plate in known_standards():
        mm = [1e3 * d for d in (plate.outer, plate.pitch_circle, plate.centring)]
        checked = "two sources agree" if plate.verified else "one source"
        say(
            f"{plate.designation:22}  outer {mm[0]:g}, pitch circle {mm[1]:g}, centring {mm[2]:g} "
            f"mm; {plate.threads} x M{1e3 * plate.thread:g}; {checked}"
        )


ModelFileOption = Annotated[Path | None, typer.Option(help="File to write; default NAME.yaml.")]


@app.command("new-robot")
def new_robot(  # noqa: PLR0913  one for each option
    name: Annotated[str, typer.Argument(help="Name of the new robot model.")],
    urdf: Annotated[Path | None, typer.Option(help="URDF file, xacro already expanded.")] = None,
    base: Annotated[str | None, typer.Option(help="With --urdf: link of the base.")] = None,
    flange: Annotated[str | None, typer.Option(help="With --urdf: link of the flange.")] = None,
    maker: Annotated[str, typer.Option(help="Manufacturer.")] = "",
    convention: Annotated[
        str,
        typer.Option(
            help="Convention of --joint: standard or modified (Denavit-Hartenberg), or urdf."
        ),
    ] = "standard",
    joint: Annotated[
        list[str] | None,
        typer.Option(help="One joint per option, base first: 'd: 89.159 mm, alpha: 90 deg'."),
    ] = None,
    standard: Annotated[
        str | None, typer.Option(help="Flange plate, for example ISO 9409-1-50-4-M6.")
    ] = None,
    out: ModelFileOption = None,
) -> None:
    """Create a robot model from a URDF or from its joints."""
    from flangeye.models.loading import require_new, robot_of_joints, write_robot
    from flangeye.models.urdf import robot_from_urdf

    path = out or Path(f"{name}.yaml")
    require_new(path)
    if urdf is not None:
        found = robot_from_urdf(urdf, base, flange, standard)
        say_notes(found.notes)
        robot = found.model_copy(update={"model": name, "maker": maker})
    else:
        robot = robot_of_joints(name, maker, convention, joint or _ask_joints(), standard)
    say(write_robot(path, robot))


def _ask_joints() -> list[str]:
    say(
        "One joint a line, base first, an empty line ends; for example: d: 89.159 mm, alpha: 90 deg"
    )
    joints: list[str] = []
    while text := ask(f"joint {len(joints) + 1}", "give --joint or --urdf", default=""):
        joints.append(text)
    return joints


@app.command("new-scanner")
def new_scanner(  # noqa: PLR0913  one for each option
    name: Annotated[str, typer.Argument(help="Name of the new scanner model.")],
    near: Annotated[
        str | None, typer.Option(help="Minimum working distance, for example '300 mm'.")
    ] = None,
    far: Annotated[
        str | None, typer.Option(help="Maximum working distance, for example '900 mm'.")
    ] = None,
    principle: Annotated[
        str | None, typer.Option(help="Measuring principle: structured light, time of flight, …")
    ] = None,
    pixels: Annotated[
        tuple[int, int] | None, typer.Option(help="Resolution: columns and rows.")
    ] = None,
    field: Annotated[
        tuple[str, str] | None, typer.Option(help="Field of view: '75 deg' '65 deg'.")
    ] = None,
    noise: Annotated[
        str | None, typer.Option(help="Noise of a pixel at mid range, for example '0.1 mm'.")
    ] = None,
    error: Annotated[
        str | None, typer.Option(help="Smooth distortion, rms, for example '0.1 mm'.")
    ] = None,
    out: ModelFileOption = None,
) -> None:
    """Create a scanner model.

    Archives need only the range, simulation needs all options.
    """
    from flangeye.models.loading import require_new, write_scanner

    path = out or Path(f"{name}.yaml")
    require_new(path)
    columns, rows = pixels or (None, None)
    values = {
        "model": name,
        "near": near or ask("minimum working distance, for example 300 mm", "give --near"),
        "far": far or ask("maximum working distance, for example 900 mm", "give --far"),
        "principle": principle, "columns": columns, "rows": rows,
        "field_of_view": list(field) if field else None,
        "temporal_noise": noise, "calibration_error": error,
    }  # fmt: skip
    if principle or pixels or field or noise or error:
        values |= {"maker": "", "source": "entered by the user with flangeye new-scanner"}
    say(write_scanner(path, values))


@app.command()
def check(recipe: RecipeName, overrides: Overrides = None) -> None:
    """Check a recipe without running it.

    Prints every mistake with its line, or the transforms that will be estimated.
    """
    from flangeye.workflow.recipe.find import find_recipe
    from flangeye.workflow.recipe.load import describe_recipe

    say(describe_recipe(find_recipe(recipe), load_plugins(), overrides or ()))


@app.command()
def recipes() -> None:
    """List the bundled recipes."""
    from flangeye.files.yaml_lines import read_yaml
    from flangeye.workflow.recipe.find import recipe_names

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

    from flangeye.files.regular import write_whole
    from flangeye.workflow.recipe.schema import header_line, recipe_schema
    from flangeye.workflow.result.contract import Result

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

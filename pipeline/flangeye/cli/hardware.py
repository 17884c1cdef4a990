"""Commands for devices: calibrate a finger, touch points, emulate a controller."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from flangeye.cli.app import Overrides, RecipeName, app, ask, load_plugins, read_recipe
from flangeye.cli.console import say

tactile = typer.Typer(no_args_is_help=True, help="Calibrate tactile fingers.")
app.add_typer(tactile, name="tactile")


@tactile.callback()
def tactile_group() -> None:
    """Keep 'calibrate' a subcommand, though it is the only one yet."""


@tactile.command("calibrate")
def tactile_calibrate(
    recipe: RecipeName,
    out: Annotated[Path, typer.Option(help="Finger file to write.")] = Path("finger.yaml"),
    overrides: Overrides = None,
    move: Annotated[
        bool,
        typer.Option("--move", help="Move the arm, by a few millimetres; without it, a dry run."),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not wait for confirmation.")] = False,
    body: Annotated[
        bool,
        typer.Option(
            "--body",
            help="Also calibrate tip and torch in the flange frame, with covariance: you "
            "bring each to a mark with the tool in seven orientations.",
        ),
    ] = False,
) -> None:
    """Calibrate a finger's rest pose, gain and stiffness with a recipe's arm and sensor."""
    from flangeye.devices import MotionAllowed

    registry = load_plugins()
    checked = read_recipe(recipe, registry, overrides)

    guide = registry.part("guide.tool" if body else "guide.tactile")
    say(guide(checked, MotionAllowed(move), _asker(yes), out))


def _asker(yes: bool) -> Callable[[str], None]:
    """Return a function that prints a text and waits for Enter, unless ``yes`` is set."""

    def wait(text: str) -> None:
        say(text)
        if not yes:
            ask("then press Enter", "--yes waits for nobody", default="")

    return wait


@app.command()
def touch(  # noqa: PLR0913  one for each option
    run: Annotated[Path, typer.Argument(help="The calibration's run: folder or run.mcap.")],
    seen: Annotated[
        list[str],
        typer.Option(metavar="X,Y,Z", help="Point in the camera frame: '12 mm, -40 mm, 702 mm'."),
    ],
    tip: Annotated[
        str,
        typer.Option(metavar="X,Y,Z", help="Tool tip in the flange frame: '0 mm, 0 mm, 152 mm'."),
    ],
    move: Annotated[
        bool,
        typer.Option(
            "--move", help="Move the arm to 5 mm before each point; without it, jog it there."
        ),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not wait for confirmation.")] = False,
    out: Annotated[Path, typer.Option(help="Recipe step to write.")] = Path("touch.yaml"),
    overrides: Overrides = None,
) -> None:
    """Touch scanned points and compare with the prediction.

    With --move the arm moves at 20 mm/s and keeps its orientation.
    """
    from flangeye.cli.touching import touch_points

    registry = load_plugins()
    given, wait = (seen, tip), _asker(yes)
    for line in touch_points(run, registry, given, move, wait, out, overrides or ()):
        say(line)


@app.command()
def emulator(  # noqa: PLR0913  one for each option
    robot: Annotated[str, typer.Argument(help="A robot model, for example ur5e, or a file.")],
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    faults: Annotated[
        list[str] | None,
        typer.Option(
            "--fault",
            metavar="NAME[=DURATION][@WHEN]",
            help="Inject a fault, for example 'freeze=3 s@moving'.",
        ),
    ] = None,
    floor: Annotated[
        str | None, typer.Option(help="Height of a surface to touch, for example '100 mm'.")
    ] = None,
    joints: Annotated[
        str | None, typer.Option(help="Initial joint angles, for example '0 -90 90 -90 -90 0 deg'.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Add random joint zero errors, drawn with this seed.")
    ] = None,
    with_input: Annotated[
        bool,
        typer.Option(
            "--with-input", help="Exit when standard input closes, for use as a child process."
        ),
    ] = False,
) -> None:
    """Emulate a robot controller on this machine."""
    from flangeye.models.graph import EmulatorOptions, find_emulator, read_height, read_joints
    from flangeye.models.loading import load_model

    model = load_model("robots", robot)
    offered = [each for some in load_plugins().hooks.hook.flangeye_emulators() for each in some]
    options = EmulatorOptions(
        robot=model,
        host=host,
        joints=read_joints(joints) if joints is not None else None,
        floor=read_height(floor) if floor is not None else None,
        faults=tuple(faults or ()),
        seed=seed,
        with_input=with_input,
    )
    find_emulator(offered, model).serve(options)

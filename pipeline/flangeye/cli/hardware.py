"""Devices: calibrate a finger, touch points of a calibration, be a controller."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
import yaml

from flangeye.cli.app import Overrides, RecipeName, app, ask, load_plugins, read_recipe
from flangeye.cli.console import say
from flangeye.devices import RobotDriver
from flangeye.errors import StageError
from flangeye.files.regular import write_whole
from flangeye.log.read import read_run
from flangeye.maths.geometry import rpy_from_rotation
from flangeye.models.robots import RobotModel
from flangeye.motion.limits import limits_of
from flangeye.motion.touching import Touched, Toucher
from flangeye.plugin.registry import Registry
from flangeye.recipe.header import LimitsSection
from flangeye.recipe.load import Recipe
from flangeye.run.folder import recipe_of_log
from flangeye.types import Floats, FrameMismatchError
from flangeye.units import parse_quantity


def touch_points(  # noqa: PLR0913  one for each option
    run: Path,
    registry: Registry,
    given: tuple[Sequence[str], str],
    move: bool,
    ask: Callable[[str], None],
    out: Path,
    overrides: Sequence[str] = (),
) -> Iterator[str]:
    """Yield a line for each point that was touched, and write the step ``verify.touch``.

    Args:
        run: The calibration's run.
        registry: The plugins.
        given: Points in the camera and the tip in the flange, as text with units.
        move: Let the arm go near each.
        ask: Shows a person a sentence and returns when it is done.
        out: File for the step.
        overrides: Changes to the calibration's recipe: another address of the arm.

    Raises:
        StageError: There is no calibration, its recipe names no arm, or a point is no point.
    """
    seen, tip = np.array([_point("--seen", x) for x in given[0]]), _point("--tip", given[1])
    log = read_run(run)
    calibration = log.calibration()
    if calibration is None:
        raise StageError(f"{log.path}: holds no calibration, so nothing is predicted")
    try:
        predicted = calibration.base_T_camera.transform.apply(seen)
    except FrameMismatchError as error:
        raise StageError(f"{log.path}: {error}") from None
    recipe = recipe_of_log(log, registry, overrides)
    touched = []
    for each in _toucher(recipe, tip, ask).touch(predicted, move):
        touched.append(each)
        yield _touched_line(len(touched), each)
    write_whole(out, _step(seen, tip, touched))
    sizes = [float(np.linalg.norm(t.error)) for t in touched]
    yield f"off by {1e3 * max(sizes):.2f} mm at most; {out}: the step, to put into the recipe"


def _toucher(recipe: Recipe, tip: Floats, ask: Callable[[str], None]) -> Toucher:
    robot, driver = recipe.context.get(RobotModel), recipe.context.get(RobotDriver)
    section = recipe.context.get(LimitsSection)
    if robot is None or driver is None or section is None:
        raise StageError(
            f"{recipe.name}: its recipe names no robot.driver with robot.limits, so no arm can be "
            "read; touch with the calibration of a live recipe, or write the step verify.touch "
            "with poses from the pendant ('flangeye stages verify.touch')"
        )
    return Toucher(driver, robot, limits_of(section, robot), tip, ask)


def _point(option: str, text: str) -> Floats:
    parts = text.split(",")
    try:
        if len(parts) != 3:
            raise ValueError(f"has {len(parts)} coordinates, not 3")
        return np.array([parse_quantity(part.strip(), "length") for part in parts])
    except ValueError as error:
        raise StageError(f"{option} '{text}': {error}; write '12 mm, -40 mm, 702 mm'") from None


def _touched_line(number: int, touched: Touched) -> str:
    at = ", ".join(f"{1e3 * x:.2f}" for x in touched.actual)
    off = ", ".join(f"{1e3 * x:+.2f}" for x in touched.error)
    size = 1e3 * float(np.linalg.norm(touched.error))
    return (
        f"point {number}: touched at ({at}) mm in base; predicted is off by ({off}), {size:.2f} mm"
    )


def _step(seen: Floats, tip: Floats, touched: Sequence[Touched]) -> str:
    """Return the step ``verify.touch`` of what was touched, as a line of a recipe."""
    touches = [
        {
            "seen": _lengths(point),
            "position": _lengths(each.base_T_flange[:3, 3]),
            "rpy": [f"{x:.9f} rad" for x in rpy_from_rotation(each.base_T_flange[:3, :3])],
        }
        for point, each in zip(seen, touched, strict=True)
    ]
    step = {"verify.touch": {"tip": _lengths(tip), "touches": touches}}
    return str(yaml.safe_dump([step], sort_keys=False, default_flow_style=None, width=120))


def _lengths(point: Floats) -> list[str]:
    return [f"{1e3 * x:.4f} mm" for x in point]


tactile = typer.Typer(no_args_is_help=True, help="Calibrate tactile fingers.")
app.add_typer(tactile, name="tactile")


@tactile.callback()
def tactile_group() -> None:
    """Keep 'calibrate' a word of its own, though it is the only one yet."""


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
            help="Then find tip and torch in the flange, and how well: you bring each to a mark, "
            "the tool in seven attitudes.",
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
    """Return what says a text and, unless everything is confirmed, waits for Enter."""

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
        str | None,
        typer.Option(help="Height of a surface to touch, for example '100 mm'."),
    ] = None,
    joints: Annotated[
        str | None,
        typer.Option(help="Initial joint angles, for example '0 -90 90 -90 -90 0 deg'."),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Add random joint zero errors, drawn with this seed."),
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

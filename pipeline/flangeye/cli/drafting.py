"""``flangeye init``: a recipe for what a folder holds, or for what runs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flangeye.cli.app import app, ask, load_plugins, open_graph
from flangeye.cli.console import say
from flangeye.errors import RecipeError

if TYPE_CHECKING:
    from flangeye.plugin.registry import Registry
    from flangeye.recipe.draft import Draft, Questions

TARGETS = re.compile(r"^.*?: steps\.\d+\.fit\.", re.MULTILINE)
"""Where mistakes in a target are, in a recipe that was drafted."""
NO_FLANGE = (
    "no scan shows the flange; what is seen instead, 'body: gripper.stl' for a tool by its mesh"
)
Answer = str | None
"""To a question that a person is asked otherwise."""

Folder = Annotated[Path, typer.Argument(help="Folder with the recordings.")]
Robot = Annotated[Answer, typer.Option(help="Robot model, its .urdf or .yaml file, or none.")]
Plate = Annotated[Answer, typer.Option(help="Flange plate, for example ISO 9409-1-50-4-M6.")]
Scanner = Annotated[Answer, typer.Option(help="Scanner model, or none.")]
Camera = Annotated[Answer, typer.Option(help="Where the camera is mounted: base or flange.")]
Target = Annotated[
    Answer,
    typer.Option(
        help="Target: flange; 'body: gripper.stl', a tool by its mesh; "
        "'sphere: {diameter: …, centre: […]}'; 'charuco: {columns: …}' and so on, with the "
        "parameters of that fit."
    ),
]
Table = Annotated[Answer, typer.Option(help="Table or array with the arm's poses.")]
Columns = Annotated[
    Answer,
    typer.Option(help="Columns of the arm's pose, position first: X,Y,Z,A,B,C or 1,2,3,4,5,6."),
]
Rotation = Annotated[
    Answer,
    typer.Option(
        help="Rotation format: kuka, fanuc, vector, xyzw, …; see flangeye stages reader.table"
    ),
]
Length = Annotated[Answer, typer.Option(help="Unit of the positions: m or mm.")]
Angle = Annotated[Answer, typer.Option(help="Unit of the angles: deg or rad.")]
Pose = Annotated[
    Answer, typer.Option(help="Direction of the poses: base_T_flange or flange_T_base.")
]
TargetColumns = Annotated[
    Answer, typer.Option(help="Columns of the target in the camera: a point or a pose.")
]
TargetRotation = Annotated[
    Answer, typer.Option(help="Rotation format of the target, as for --rotation.")
]
TargetLength = Annotated[Answer, typer.Option(help="Unit of the target's positions: m or mm.")]
TargetAngle = Annotated[Answer, typer.Option(help="Unit of the target's angles: deg or rad.")]
TargetPose = Annotated[
    Answer, typer.Option(help="Direction of the target: camera_T_target or target_T_camera.")
]
Reader = Annotated[
    Answer, typer.Option(help="Reader as written in a recipe; replaces the options above.")
]
Ros2 = Annotated[
    bool, typer.Option("--ros2", help="Look at the arm and the camera that run under ROS 2.")
]
FlangeLink = Annotated[
    Answer, typer.Option("--flange", help="With --ros2: the flange's link, where no name says it.")
]
Trajectory = Annotated[
    Answer, typer.Option(help="With --ros2: topic of the controller that moves the arm, or none.")
]
Scans = Annotated[Answer, typer.Option(help="With --ros2: topic of clouds or depth images.")]
Trigger = Annotated[Answer, typer.Option(help="With --ros2: service that takes a scan, or none.")]
View = Annotated[
    Answer, typer.Option(help="With --ros2: where the scanner roughly stands: '620, 0, 980 mm'.")
]
LimitBox = Annotated[
    Answer,
    typer.Option(
        "--box",
        help="With --ros2: the flange's box, centre; size: '450, 0, 300; 600, 600, 600 mm'.",
    ),
]
Yes = Annotated[bool, typer.Option("--yes", help="Do not ask; use the defaults and print them.")]
Out = Annotated[Path, typer.Option(help="Recipe file to write.")]


@app.command()
def init(  # noqa: PLR0913  one for each option
    folder: Folder = Path(),
    robot: Robot = None,
    plate: Plate = None,
    scanner: Scanner = None,
    camera: Camera = None,
    target: Target = None,
    table: Table = None,
    columns: Columns = None,
    rotation: Rotation = None,
    length: Length = None,
    angle: Angle = None,
    pose: Pose = None,
    target_columns: TargetColumns = None,
    target_rotation: TargetRotation = None,
    target_length: TargetLength = None,
    target_angle: TargetAngle = None,
    target_pose: TargetPose = None,
    reader: Reader = None,
    ros2: Ros2 = False,
    flange: FlangeLink = None,
    trajectory: Trajectory = None,
    scans: Scans = None,
    trigger: Trigger = None,
    view: View = None,
    box: LimitBox = None,
    yes: Yes = False,
    out: Out = Path("recipe.yaml"),
) -> None:
    """Write a recipe for recordings, or for ROS 2 (--ros2).

    Inspects the folder or the running graph and asks for what it does not show.
    """
    from flangeye.recipe.draft import Questions
    from flangeye.recipe.load import load_recipe

    if out.exists():
        raise RecipeError(f"{out}: is there already; take another name with --out")
    registry = load_plugins()
    given = {
        "robot": robot, "plate": plate, "scanner": scanner, "camera": camera, "target": target,
        "table": table, "columns": columns, "rotation": rotation, "length": length,
        "angle": angle, "pose": pose, "target-columns": target_columns,
        "target-rotation": target_rotation, "target-length": target_length,
        "target-angle": target_angle, "target-pose": target_pose, "reader": reader,
        "flange": flange, "trajectory": trajectory, "scans": scans, "trigger": trigger,
        "view": view, "box": box,
    }  # fmt: skip
    questions = Questions(given, None if yes else _prompt)
    draft = (_of_what_runs if ros2 else _of_folder)(folder, out, questions, registry)
    for path, text in {**draft.files, out: draft.text}.items():
        path.write_text(text, "utf-8")
    try:
        checked = load_recipe(out, registry)
    except RecipeError as error:
        for path in (out, *draft.files):
            path.unlink()
        # Of the recipe that is not kept nobody knows: its target is what was asked for.
        raise RecipeError(TARGETS.sub("--target ", str(error))) from None
    for line in (*draft.told, *(f"assumed: {line}" for line in questions.assumed)):
        say(line)
    say(f"{out}: ok, {len(checked.steps)} steps; next: flangeye run {out}")


def _of_folder(folder: Path, out: Path, questions: Questions, registry: Registry) -> Draft:
    from flangeye.recipe.draft import draft_recipe, look

    survey = look(folder)
    for line in survey.lines():
        say(line)
    draft = draft_recipe(survey, out, questions, registry)
    if "fit.rim" not in draft.text or _shows_target(draft, folder, out, registry):
        return draft
    questions.given["target"] = None
    questions.ask("target", NO_FLANGE, "flange")
    return draft_recipe(survey, out, questions, registry)


def _shows_target(draft: Draft, folder: Path, out: Path, registry: Registry) -> bool:
    """Return whether any scan shows what a drafted recipe looks for; True if it does not run."""
    from flangeye.errors import FlangeyeError, NothingSeen
    from flangeye.recipe.load import parse_recipe
    from flangeye.run.runner import Runner
    from flangeye.types import ArchivePath

    try:
        # Its paths start at the recipe's folder.
        recipe = parse_recipe(draft.text, out.name, registry, [f"steps.0.path={folder}"])
        return bool(Runner(recipe, registry, ArchivePath(folder)).take(1))
    except NothingSeen:
        return False
    except FlangeyeError:
        return True


def _of_what_runs(folder: Path, out: Path, questions: Questions, registry: Registry) -> Draft:
    from flangeye.recipe.draft import draft_live

    del folder
    with open_graph(registry) as graph:
        cell = graph.cell(questions.ask, out.stem)
    for line in cell.seen:
        say(line)
    return draft_live(cell, questions, out)


def _prompt(question: str, default: str | None) -> str:
    return ask(question, "give the option, or --yes for the defaults", default)

"""``flangeye init``: a recipe for what a folder holds."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from flangeye.cli.app import app, ask, load_plugins
from flangeye.cli.console import say
from flangeye.errors import RecipeError

TARGETS = re.compile(r"^.*?: steps\.\d+\.fit\.", re.MULTILINE)
"""Where mistakes in a target are, in a recipe that was drafted."""
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
        help="Target: flange; 'sphere: {diameter: …, centre: […]}'; 'charuco: {columns: …}' "
        "and so on, with the parameters of that fit."
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
    yes: Yes = False,
    out: Out = Path("recipe.yaml"),
) -> None:
    """Write a recipe for a folder of recordings.

    Inspects the folder and asks for what it does not show.
    """
    from flangeye.recipe.draft import Questions, draft_recipe, look
    from flangeye.recipe.load import load_recipe

    if out.exists():
        raise RecipeError(f"{out}: is there already; take another name with --out")
    registry = load_plugins()
    survey = look(folder)
    for line in survey.lines():
        say(line)
    given = {
        "robot": robot, "plate": plate, "scanner": scanner, "camera": camera, "target": target,
        "table": table, "columns": columns, "rotation": rotation, "length": length,
        "angle": angle, "pose": pose, "target-columns": target_columns,
        "target-rotation": target_rotation, "target-length": target_length,
        "target-angle": target_angle, "target-pose": target_pose, "reader": reader,
    }  # fmt: skip
    questions = Questions(given, None if yes else _prompt)
    draft = draft_recipe(survey, out, questions, registry)
    out.write_text(draft.text, "utf-8")
    try:
        checked = load_recipe(out, registry)
    except RecipeError as error:
        out.unlink()
        # Of the recipe that is not kept nobody knows: its target is what was asked for.
        raise RecipeError(TARGETS.sub("--target ", str(error))) from None
    for line in (*draft.told, *(f"assumed: {line}" for line in questions.assumed)):
        say(line)
    say(f"{out}: ok, {len(checked.steps)} steps; next: flangeye run {out}")


def _prompt(question: str, default: str | None) -> str:
    return ask(question, "give the option, or --yes for the defaults", default)

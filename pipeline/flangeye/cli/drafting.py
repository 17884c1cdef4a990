"""``flangeye init``: a recipe for what a folder holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flangeye.cli.app import app, load_plugins, say
from flangeye.errors import RecipeError

Columns = Annotated[
    str | None, typer.Option(help="Of the arm's pose, position first: X,Y,Z,A,B,C or 1,2,3,4,5,6.")
]


@app.command()
def init(  # noqa: PLR0913  one for each option
    folder: Annotated[Path, typer.Argument(help="Where the recordings are.")] = Path(),
    robot: Annotated[
        str | None, typer.Option(help="Name of the arm, its .urdf or .yaml, or none.")
    ] = None,
    plate: Annotated[str | None, typer.Option(help="Plate: ISO 9409-1-50-4-M6.")] = None,
    scanner: Annotated[str | None, typer.Option(help="Name of the scanner, or none.")] = None,
    camera: Annotated[str | None, typer.Option(help="What carries it: base or flange.")] = None,
    target: Annotated[
        str | None,
        typer.Option(
            help="What is seen: flange; 'sphere: {diameter: …, centre: […]}'; 'charuco: {columns: "
            "…}' and so on, with the parameters of that fit."
        ),
    ] = None,
    table: Annotated[str | None, typer.Option(help="Which table has the arm's poses.")] = None,
    columns: Columns = None,
    rotation: Annotated[
        str | None, typer.Option(help="kuka, fanuc, vector, xyzw, …: flangeye stages reader.table")
    ] = None,
    length: Annotated[str | None, typer.Option(help="Unit of the positions: m or mm.")] = None,
    angle: Annotated[str | None, typer.Option(help="Unit of the angles: deg or rad.")] = None,
    pose: Annotated[str | None, typer.Option(help="base_T_flange, or flange_T_base.")] = None,
    target_columns: Annotated[
        str | None, typer.Option(help="Columns of what the camera saw: a point or a pose.")
    ] = None,
    target_rotation: Annotated[str | None, typer.Option(help="As --rotation.")] = None,
    target_length: Annotated[str | None, typer.Option(help="As --length.")] = None,
    target_angle: Annotated[str | None, typer.Option(help="As --angle.")] = None,
    reader: Annotated[
        str | None, typer.Option(help="The reader, as a recipe has it, instead of all of these.")
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Ask nothing: take the defaults, and tell them.")
    ] = False,
    out: Annotated[Path, typer.Option(help="The recipe to write.")] = Path("recipe.yaml"),
) -> None:
    """Look at recordings, ask what they do not show, and write a recipe for them."""
    from flangeye.recipe.draft import Questions, draft_recipe, look
    from flangeye.recipe.load import load_recipe

    if out.exists():
        raise RecipeError(f"{out}: is there already; take another name with --out")
    registry = load_plugins()
    sights = look(folder)
    for line in sights.lines():
        say(line)
    given = {
        "robot": robot, "plate": plate, "scanner": scanner, "camera": camera, "target": target,
        "table": table, "columns": columns, "rotation": rotation, "length": length,
        "angle": angle, "pose": pose, "target-columns": target_columns,
        "target-rotation": target_rotation, "target-length": target_length,
        "target-angle": target_angle, "reader": reader,
    }  # fmt: skip
    questions = Questions(given, None if yes else _prompt)
    draft = draft_recipe(sights, out, questions, registry)
    out.write_text(draft.text, "utf-8")
    try:
        checked = load_recipe(out, registry)
    except RecipeError:
        out.unlink()
        raise
    for line in (*draft.told, *(f"assumed: {line}" for line in questions.assumed)):
        say(line)
    say(f"{out}: ok, {len(checked.steps)} steps; next: flangeye run {out}")


def _prompt(question: str, default: str | None) -> str:
    try:
        return str(typer.prompt(question, default=default))
    except typer.Abort:
        raise RecipeError(
            f"{question}: was not answered; give the option, or --yes for the defaults"
        ) from None

"""``flangeye init``: write a recipe for a folder of recordings or a running ROS 2 cell."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flangeye.cli.app import app, ask, load_plugins
from flangeye.cli.console import progress_bar, say
from flangeye.errors import FlangeyeError, NothingSeen, RecipeError

if TYPE_CHECKING:
    from flangeye.plugin.registry import Registry
    from flangeye.types import Observation
    from flangeye.workflow.recipe.draft import Draft, Questions
    from flangeye.workflow.recipe.draft.survey import FolderSurvey

ANSWER_HELP = {
    "robot": "Robot model, its .urdf or .yaml file, or none.",
    "plate": "Flange plate, for example ISO 9409-1-50-4-M6.",
    "scanner": "Scanner model, or none.",
    "camera": "Where the camera is mounted: base or flange.",
    "target": "Target: flange; 'body: gripper.stl', a tool by its mesh; "
    "'sphere: {diameter: …, centre: […]}'; 'charuco: {columns: …}' and so on, with the parameters "
    "of that fit.",
    "table": "Table or array with the arm's poses.",
    "columns": "Columns of the arm's pose, position first: X,Y,Z,A,B,C or 1,2,3,4,5,6.",
    "rotation": "Rotation format: kuka, fanuc, vector, xyzw, …; see flangeye stages reader.table",
    "length": "Unit of the positions: m or mm.",
    "angle": "Unit of the angles: deg or rad.",
    "pose": "Direction of the poses: base_T_flange or flange_T_base.",
    "target-columns": "Columns of the target in the camera: a point or a pose.",
    "target-rotation": "Rotation format of the target, as for --rotation.",
    "target-length": "Unit of the target's positions: m or mm.",
    "target-angle": "Unit of the target's angles: deg or rad.",
    "target-pose": "Direction of the target: camera_T_target or target_T_camera.",
    "reader": "Reader as written in a recipe; replaces the options above.",
    "flange": "With --ros2: link of the flange, if no link's name shows it.",
    "trajectory": "With --ros2: topic of the controller that moves the arm, or none.",
    "scans": "With --ros2: topic of clouds, depth images or images.",
    "trigger": "With --ros2: service that takes a scan, or none.",
    "view": "With --ros2: rough position in the base of the scanner, or of a camera in "
    "hand's target: '620, 0, 980 mm'.",
    "box": "With --ros2: box that the flange may move in, centre; size: '450, 0, 300; 600, 600, "
    "600 mm'.",
}
"""Options of ``init`` that answer what a person is asked otherwise, with their help."""


def _with_answers(command: Any) -> Any:
    """Return a command that takes each of ANSWERS as an option of its own."""
    answers = [
        Parameter(
            name.replace("-", "_"), Parameter.KEYWORD_ONLY, default=None,
            annotation=Annotated[str | None, typer.Option(f"--{name}", help=text)],
        )
        for name, text in ANSWER_HELP.items()
    ]  # fmt: skip
    folder, ros2, *rest, _ = signature(command, eval_str=True).parameters.values()
    flags = [each.replace(kind=Parameter.KEYWORD_ONLY) for each in rest]
    # typer reads a command's options from its signature
    command.__signature__ = Signature([folder, ros2, *answers, *flags])
    command.__annotations__ |= {each.name: each.annotation for each in answers}
    return command


@app.command()
@_with_answers
def init(
    folder: Annotated[Path, typer.Argument(help="Folder with the recordings.")] = Path(),
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Look at the arm and the camera that run under ROS 2.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not ask; use the defaults and print them.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Recipe file to write.")] = Path("recipe.yaml"),
    **answers: str | None,
) -> None:
    """Write a recipe for recordings, or for ROS 2 (--ros2).

    Inspects the folder or the running graph, and asks for what these do not show.
    """
    from flangeye.files.regular import write_whole
    from flangeye.types.arrays import Warn, as_line
    from flangeye.workflow.recipe.draft import Questions
    from flangeye.workflow.recipe.load import load_recipe

    if out.exists():
        raise RecipeError(f"{out}: exists already; choose another name with --out")
    registry = load_plugins()
    given = {name: answers[name.replace("-", "_")] for name in ANSWER_HELP}
    questions = Questions(given, None if yes else _prompt)
    draft = (_of_what_runs if ros2 else _of_folder)(folder, out, questions, registry)
    texts = {**draft.files, out: draft.text}
    new = [path for path in texts if not path.exists()]
    for path in set(texts) - set(new):
        # An equal file, such as a model that an earlier try has written, may stay
        if path.read_bytes() != texts[path].encode():
            raise RecipeError(f"{path}: exists already; choose another name with --out")
    try:
        for path in new:
            write_whole(path, texts[path], RecipeError)
        checked = load_recipe(out, registry)
    except RecipeError as error:
        for path in new:
            with suppress(OSError):  # those that could not be written
                path.unlink()
        # The drafted recipe is not kept, so a mistake in its target is named by the option --target
        raise RecipeError(
            re.sub(r"^.*?: steps\.\d+\.fit\.", "--target ", str(error), flags=re.MULTILINE)
        ) from None
    for line in (*draft.told, *(f"assumed: {line}" for line in questions.assumed)):
        say(as_line(line) if isinstance(line, Warn) else line)
    say(f"{out}: ok, {len(checked.steps)} steps; next: flangeye run {out}")


def _of_folder(folder: Path, out: Path, questions: Questions, registry: Registry) -> Draft:
    from flangeye.workflow.recipe.draft import look

    survey = look(folder)
    for line in survey.lines():
        say(line)
    if questions.prompt is not None:
        # What the data decide is the default of each question, as it is the answer with --yes
        alone = replace(questions, given=dict(questions.given), prompt=None, assumed=[])
        with suppress(FlangeyeError):
            _of_survey(survey, out, alone, registry)
        questions.likely = alone.likely
    return _of_survey(survey, out, questions, registry)


def _of_survey(survey: FolderSurvey, out: Path, questions: Questions, registry: Registry) -> Draft:
    """Return a draft from a folder's content; the scans answer what they can.

    Raises:
        FlangeyeError: An answer is missing or invalid, or the recordings cannot be read.
    """
    from flangeye.workflow.recipe.draft import draft_recipe, mounting_seen

    given = dict(questions.given)
    draft = _drafted(survey, out, questions, registry)
    turned = {name: found for name, found in questions.likely.items() if name == "rotation"}
    if "acquire.images" in draft.text and given["camera"] is None and questions.prompt is None:
        shown = _seen(draft, survey.folder, out, registry, 12, needed=True)
        mounting = mounting_seen(shown or ())
        if mounting is None:
            return draft
        questions.given, questions.likely = given, {**turned, "camera": mounting}
        questions.assumed.clear()
        return draft_recipe(survey, out, questions, registry)
    if "fit.rim" not in draft.text or _seen(draft, survey.folder, out, registry, 1) != []:
        return draft
    # The scanner's range tells metres from millimetres; centimetres lie between, so they are tried
    in_cm = replace(draft, text=draft.text.replace("archive: {", "archive: {unit: cm, ", 1))
    if _seen(in_cm, survey.folder, out, registry, 1):
        questions.assumed.append(
            "unit of the clouds: cm, because no scan shows the flange when read in m or mm"
        )
        return in_cm
    questions.given["target"] = None
    seen = "which target they show ('body: gripper.stl' for a tool by its mesh)"
    questions.ask("target", f"no scan shows the flange; {seen}", "flange")
    return draft_recipe(survey, out, questions, registry)


def _drafted(survey: FolderSurvey, out: Path, questions: Questions, registry: Registry) -> Draft:
    """Return a draft; the scans decide the arm's rotation convention if nothing else shows it.

    Raises:
        FlangeyeError: As :func:`draft_recipe`.
    """
    from flangeye.workflow.recipe.draft import draft_recipe
    from flangeye.workflow.recipe.draft.evidence import usual_rotations

    anew = replace(
        questions, given=dict(questions.given), likely=dict(questions.likely), assumed=[]
    )
    unnamed = ("quaternion_xyzw", "quaternion_wxyz")
    try:
        draft = draft_recipe(survey, out, questions, registry)
    except RecipeError:
        found = None
        if questions.open == "rotation":
            found = _decided(usual_rotations(), survey, out, anew, registry)
        if found is None:
            raise
    else:
        unsure = any(line.startswith("rotation convention") for line in questions.assumed)
        rivals = unnamed if questions.given["rotation"] in unnamed else questions.rivals
        if not unsure or "fit." not in draft.text or not rivals:
            return draft
        found = _decided(rivals, survey, out, anew, registry)
        if found is None:
            return draft
    questions.given, questions.likely = anew.given, anew.likely
    questions.assumed[:] = anew.assumed
    return found


def _decided(
    names: Sequence[str], survey: FolderSurvey, out: Path, questions: Questions, registry: Registry
) -> Draft | None:
    """Return a draft with the rotation convention inferred from scans; None if not decided.

    Raises:
        FlangeyeError: As :func:`draft_recipe`.
    """
    from flangeye.workflow.recipe.draft import draft_recipe, rotation_seen

    drafts = {}
    for name in names:
        given = questions.given | {"rotation": name}
        tried = replace(questions, given=given, likely={}, assumed=[])
        drafts[name] = draft_recipe(survey, out, tried, registry)
    seen = _seen(drafts[names[0]], survey.folder, out, registry, 12)
    decided = rotation_seen(drafts, seen) if seen else None
    if decided is None:
        return None
    questions.likely["rotation"] = decided
    return draft_recipe(survey, out, questions, registry)


def _seen(
    draft: Draft, folder: Path, out: Path, registry: Registry, count: int, needed: bool = False
) -> list[Observation] | None:
    """Return the first scans that show a drafted recipe's target; None if it does not run.

    Raises:
        RecipeError: No scan shows the target, and ``needed`` is set.
    """
    from flangeye.types import ArchivePath
    from flangeye.workflow.recipe.load import parse_recipe
    from flangeye.workflow.run.runner import Runner

    try:
        # Its paths start at the recipe's folder.
        recipe = parse_recipe(draft.text, out.name, registry, [f"steps.0.path={folder}"])
        with progress_bar("looking for the target"):
            return Runner(recipe, registry, ArchivePath(folder)).take(count)
    except NothingSeen as error:
        if needed:
            raise RecipeError(str(error).replace("write fit.", "say --target ")) from None
        return []
    except FlangeyeError:
        return None


def _of_what_runs(_: Path, out: Path, questions: Questions, registry: Registry) -> Draft:
    from flangeye.workflow.recipe.draft import draft_live

    with registry.graph() as graph:
        cell = graph.cell(questions.ask, out.stem)
    for line in cell.seen:
        say(line)
    return draft_live(cell, questions, out)


def _prompt(question: str, default: str | None) -> str:
    return ask(question, "give the option, or --yes for the defaults", default)

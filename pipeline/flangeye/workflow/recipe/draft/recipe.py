"""Write a recipe's text from a survey and its answers."""

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flangeye.errors import RecipeError, StageError
from flangeye.files.cameras import cameras_in
from flangeye.files.clouds import CONVERSIONS
from flangeye.files.depth import read_scan
from flangeye.files.images import ImageError, decode_image, is_depth_image
from flangeye.files.recording import Archive, NotThisLayout, Recording
from flangeye.files.regular import MAX_FILE, read_regular
from flangeye.files.scans import IMAGES
from flangeye.files.tables import tables_in
from flangeye.files.yaml_lines import entry, flow, parse_value
from flangeye.models.loading import load_model
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerData, detect_unit, median_distance
from flangeye.models.targets import load_standard
from flangeye.models.urdf import robot_from_urdf
from flangeye.plugin.registry import Registry
from flangeye.plugin.stage import BoundPart
from flangeye.types import FLANGE, Floats, Observation, PoseFeature
from flangeye.workflow.recipe.draft.convention import measured, table_params
from flangeye.workflow.recipe.draft.evidence import mounting_of, rotation_of
from flangeye.workflow.recipe.draft.survey import FolderSurvey, Questions, one_of, too_long
from flangeye.workflow.recipe.load import parse_recipe

PLATE = "ISO 9409-1-50-4-M6"
"""Flange plate of most small arms."""


@dataclass(frozen=True)
class Draft:
    """A drafted recipe, and the notes about it.

    Attributes:
        text: The recipe as YAML.
        told: Lines about what was found in the archive.
        files: Contents of the files that it names.
        poses: (4, 4) pose of the flange as it is read, by the name of the recording.
    """

    text: str
    told: Sequence[str]
    files: Mapping[Path, str] = field(default_factory=dict)
    poses: Mapping[str, Floats] = field(default_factory=dict)


def draft_recipe(
    survey: FolderSurvey, out: Path, questions: Questions, registry: Registry
) -> Draft:
    """Return a recipe for a surveyed folder.

    Args:
        survey: Contents of the folder.
        out: Path of the recipe, to which its paths are relative.
        questions: Answers to what cannot be detected.
        registry: The installed plugins.

    Raises:
        FlangeyeError: Required information is missing; the message has the line to add.
    """
    unread = _convertible(survey, 1)
    read = survey.tables or survey.clouds or survey.of((*IMAGES, ".mcap", ".db3"))
    if unread and not read and questions.given.get("reader") is None:
        raise unread
    robot = _robot(survey, out, questions)
    reader = _reader(survey, questions, registry, robot)
    archive = _bound(reader, registry, robot)(survey.folder)
    stage, target = _what(archive, questions)
    head = _head(survey.folder, out, robot, target, questions)
    first: dict[str, Any] = {"path": os.path.relpath(survey.folder, out.parent)}
    first |= {} if reader == "auto" else {"reader": reader}
    first |= _camera(archive, target, questions) if stage == "acquire.images" else {}
    # A scale of the arm's motion is as uncertain as the arm: the estimate has to say so
    data = head | {"steps": [{stage: first}, *steps_of(target, "scale" not in questions.mended)]}
    poses = {r.id: r.poses[FLANGE] for r in archive.recordings if FLANGE in r.poses}
    return Draft(yaml_of(data), _summary(archive, reader), poses=poses)


def _robot(survey: FolderSurvey, out: Path, questions: Questions) -> dict[str, Any]:
    """Return the arm as asked, or by the one URDF of the folder."""
    urdfs = survey.of((".urdf",))
    usual = os.path.relpath(urdfs[0], out.parent) if len(urdfs) == 1 else "none"
    question = "which arm ('flangeye robots', or a .urdf)"
    answer = questions.ask("robot", question, usual, check=lambda a: _known_robot(a, out))
    if answer == "none":
        return {}
    return {"urdf": answer} if answer.endswith(".urdf") else {"model": answer}


def _known_robot(answer: str, out: Path) -> None:
    """Refuse a robot that is neither in the catalogue nor a file beside the recipe."""
    if answer.endswith(".urdf") and not (out.parent / answer).is_file():
        raise RecipeError(f"{answer}: is not a file")
    if answer != "none" and not answer.endswith(".urdf"):
        load_model("robots", answer, out.parent)


# --- how the archive is read


def _reader(
    survey: FolderSurvey, questions: Questions, registry: Registry, robot: Mapping[str, Any]
) -> Any:
    """Return the reader as a recipe writes it: given, known by the layout, or made for a table."""
    given = questions.given.get("reader")
    if given is not None:
        return parse_value(given, "--reader")
    try:
        _bound("auto", registry, robot)(survey.folder)
    except StageError as error:
        reason = error
    else:
        return "auto"
    if any(p.name.startswith("pos0") and p.suffix in (".yaml", ".yml") for p in survey.files):
        return {"zivid": {"length": _length_of_files(questions)}}
    if survey.tables:
        # Of images it would have to be asked what they show
        seen = None if questions.given.get("target") else measured(survey.tables)
        scans = bool(survey.clouds or (survey.images and seen is None))
        if survey.images and seen is not None and not scans:
            questions.assumed.append(
                f"what the camera saw: {seen.name}, not the images (--target says what they show)"
            )
        try:
            read = {"table": table_params(survey.tables, questions, _model(robot), scans)}
            mended = {"corrected": {"reader": read, "target": questions.mended}}
            return mended if questions.mended else read
        except RecipeError as error:
            # Scans in a form that is not read are what is missing beside poses
            many = len(survey.tables[0].rows)
            raise (None if scans else _convertible(survey, many)) or error from None
    raise StageError(_missing(survey, reason))


def _bound(reader: Any, registry: Registry, robot: Mapping[str, Any]) -> BoundPart:
    """Return a reader with its parameters, checked as a recipe's are."""
    section = {"robot": robot} if robot else {}
    steps = [{"acquire.centres": {"reader": reader}}, "solve.svd"]
    probe = {"title": "draft", **section, "steps": steps}
    try:
        params: Any = parse_recipe(json.dumps(probe), "probe", registry).steps[0].params
    except RecipeError as error:
        # The probe's recipe has no file, so its mistakes are named by the command's options
        told = str(error).replace("probe:1: steps.0.acquire.centres.reader", "--reader")
        told = told.replace("probe:1: robot.", "--robot ")
        raise RecipeError(told.replace("--reader.", "--reader ")) from None
    bound: BoundPart = params.reader
    return bound


def _model(robot: Mapping[str, Any]) -> RobotModel | None:
    if "urdf" in robot:
        return robot_from_urdf(Path(robot["urdf"]))
    return load_model("robots", robot["model"]) if "model" in robot else None


def _missing(survey: FolderSurvey, reason: StageError) -> str:
    """Return a message that names what is missing, and the line to add."""
    if not isinstance(reason, NotThisLayout):
        lines = re.search(r"\b(?:reader|robot): ", str(reason)) is not None
        how = "; flangeye init takes such lines as --reader '{…}' and --robot NAME"
        return f"{reason}{how if lines else ''}"
    # Files of arrays that hold nothing else
    for path in survey.of((".mat", ".npz", ".npy")):
        try:
            tables_in(path.parent, path.name)
        except StageError as error:
            return str(error)
    scans = survey.clouds or survey.images
    if scans:
        column = "cloud" if survey.clouds else "image"
        line = "x_mm,y_mm,z_mm,rx_rad,ry_rad,rz_rad"
        return (
            f"{survey.folder}: holds {len(scans)} scans, but nothing that says where the flange "
            f"was; put poses.csv beside them, its first line: {column},{line}; then a line "
            f"for each, {scans[0].name},412.1,-33.0,501.7,2.91,0.12,-0.03"
        )
    # Tables that other programs keep; some of them can hold code
    closed = survey.of(
        (".parquet", ".feather", ".pkl", ".pickle", ".xlsx", ".xls", ".ods", ".h5", ".hdf5")
    )
    if closed:
        return f"{survey.folder}: {closed[0].name} is a table that is not read; save it as .csv"
    some = 6  # names that a line shows
    named = [str(path.relative_to(survey.folder)) for path in survey.files]
    if long := next((path for path in survey.files if too_long(path)), None):
        return (
            f"{long}: is larger than 10 MB, so it was not looked into for poses; keep the rows "
            "that belong to scans or markers, or state how it is read: --reader 'table: {file: …}'"
        )
    if not named:
        return f"{survey.folder}: holds no files that can be read; put clouds or images there"
    more = f" and {len(named) - some} more" if len(named) > some else ""
    return (
        f"{survey.folder}: no scans and no table of poses in {', '.join(named[:some])}{more}; "
        "write the poses as .csv, a row each, or name the reader that knows them: --reader NAME "
        "('flangeye stages reader' lists them)"
    )


def _convertible(survey: FolderSurvey, count: int) -> RecipeError | None:
    """Return an error if recordings must be converted first; None if not."""
    bag = (
        "is a ROS 1 bag; convert it: pip install rosbags && rosbags-convert --src {file} "
        "--dst {stem}"
    )
    # Beside poses; alone it is taken for them
    cloud = (
        "holds no poses; if it holds a cloud, write it with MATLAB: pcwrite(pointCloud(xyz), "
        "'{stem}.ply')"
    )
    ways = {".bag": bag, **CONVERSIONS, **({".mat": cloud} if survey.tables else {})}
    for suffix, way in ways.items():
        others = survey.of((suffix,))
        if len(others) >= count:
            named = way.format(file=others[0], stem=others[0].with_suffix(""))
            return RecipeError(f"{others[0]}: {named}; then flangeye init {survey.folder} again")
    return None


# --- what is in it


def _what(archive: Archive, questions: Questions) -> tuple[str, dict[str, Any]]:
    """Return the acquire stage, and the target: its name with parameters, empty where measured."""
    records = archive.recordings
    if _shows_print(records, questions):
        return "acquire.images", printed_target(_some_images(records), questions)
    if any(r.cloud for r in records):
        answer = questions.ask(
            "target",
            "what the scans show (flange, 'body: MESH' for a tool, sphere, charuco, checkerboard, "
            "circles, aruco)",
            "flange",
            check=_target,
        )
        return "acquire.archive", _target(answer)
    for stage, seen in (
        ("acquire.samples", [r.camera_T_target for r in records]),
        ("acquire.centres", [r.centre_in_camera for r in records]),
    ):
        both = [(r.poses[FLANGE], each) for r, each in zip(records, seen, strict=True)
                if each is not None and FLANGE in r.poses]  # fmt: skip
        if both and (mounting := _mounting(both)):
            questions.likely.setdefault("camera", mounting)
        if both:
            return stage, {}
    raise StageError(f"{archive.root}: holds poses, but neither scans nor what the camera measured")


def _shows_print(records: Sequence[Recording], questions: Questions) -> bool:
    """Return whether the target is a printed one in images.

    It is if there are only images. Beside depth images the answer decides, or without one the
    content of an image.
    """
    from flangeye.models.corners import board_seen

    images = any(r.image for r in records)
    if not images or not any(r.cloud for r in records):
        return images
    if not any(r.cloud and is_depth_image(r.cloud) for r in records):
        return False
    if given := questions.given.get("target"):
        return not {"flange", "body", "sphere"} & set(_target(given))
    return any(board_seen(pixels) is not None for _, pixels in _some_images(records))


def mounting_seen(observations: Iterable[Observation]) -> tuple[str, str] | None:
    """Return the mounting of the camera that saw targets, with evidence; None if undecided."""
    both = [(o.poses[FLANGE].matrix, o.feature.camera_T_target.matrix) for o in observations
            if FLANGE in o.poses and isinstance(o.feature, PoseFeature)]  # fmt: skip
    return _mounting(both) if both else None


def rotation_seen(
    drafts: Mapping[str, Draft], observations: Sequence[Observation]
) -> tuple[str, str] | None:
    """Return the convention by which scans show the arm's poses were written, with evidence.

    Args:
        drafts: Recipes that differ in the convention only, by its name.
        observations: Observations by one of the recipes.

    Returns:
        None if they decide for none.
    """
    shown = [o for o in observations if o.feature.normal is not None]
    poses = {name: np.array([each.poses[o.id] for o in shown]) for name, each in drafts.items()}
    whole = all(isinstance(o.feature, PoseFeature) for o in shown)
    seen = [o.feature.camera_T_target.matrix if whole and isinstance(o.feature, PoseFeature)
            else o.feature.normal for o in shown]  # fmt: skip
    return rotation_of(poses, np.array(seen))


def _mounting(both: Sequence[tuple[Floats, Floats]]) -> tuple[str, str] | None:
    arm, target = map(np.array, zip(*both, strict=True))
    found = mounting_of(arm, target, ["base", "flange"], ["camera_T_target"])
    return found and (found.camera, found.told)


def printed_target(images: Iterable[tuple[str, Any]], questions: Questions) -> dict[str, Any]:
    """Return the printed target that is seen, its name with parameters.

    The question names the target found in the first image that shows one. Measure its lengths on
    the print.

    Args:
        images: Names, and pixels (H, W) or (H, W, 3).
        questions: Questions about the target.

    Raises:
        RecipeError: The answer is missing, or is none.
    """
    from flangeye.models.corners import board_seen

    told, example = "", "'charuco: {columns: 8, rows: 6, square: 30 mm, marker: 22 mm}'"
    for name, pixels in () if questions.given.get("target") else images:
        if seen := board_seen(pixels):
            lengths = {"charuco": "square: 30 mm, marker: 22 mm", "marker": "size: 50 mm"}
            measured = lengths.get(seen.kind, "square: 30 mm")
            told = f" ({name} shows {seen.what}), with the lengths measured on the print"
            example = f"'{seen.fit[:-1]}, {measured}}}'"
            break
    question = f"which printed target is seen{told}"
    return _target(questions.ask("target", question, None, example, _target))


def _some_images(records: Sequence[Recording]) -> Iterator[tuple[str, Any]]:
    """Yield name and pixels of the first, middle and last image, if readable."""
    import cv2

    paths = [r.image for r in records if r.image is not None]
    for path in dict.fromkeys((paths[0], paths[len(paths) // 2], paths[-1])):
        with suppress(ImageError, StageError):
            yield path.name, decode_image(read_regular(path, MAX_FILE), cv2.IMREAD_GRAYSCALE)


def _target(answer: str) -> dict[str, Any]:
    value = parse_value(answer, "--target")
    target = {value: {}} if isinstance(value, str) else value
    known = ("flange", "body", "sphere", "charuco", "checkerboard", "circles", "aruco")
    if not isinstance(target, dict) or len(target) != 1 or next(iter(target)) not in known:
        raise RecipeError(f"--target {answer}: is not one of {', '.join(known)}, with parameters")
    if target.get("body") == {}:
        raise RecipeError("--target body: needs its mesh, as in --target 'body: gripper.stl'")
    sphere = target.get("sphere")
    if sphere is not None and not (
        isinstance(sphere, dict) and {"diameter", "centre"} <= {*sphere}
    ):
        raise RecipeError(
            f"--target {answer}: needs its diameter and its centre in the flange's frame, as in "
            "--target 'sphere: {diameter: 38.1 mm, centre: [0 mm, 0 mm, 60 mm]}'"
        )
    return target


def _head(
    folder: Path, out: Path, robot: dict[str, Any], target: dict[str, Any], questions: Questions
) -> dict[str, Any]:
    """Return the recipe's sections above its steps."""
    head: dict[str, Any] = {"title": f"Calibration from {folder.resolve().name}"}
    feature = {"sphere": target["sphere"]} if "sphere" in target else {}
    if "flange" in target and not _has_plate(robot):
        question = "which ISO 9409-1 plate the flange has ('flangeye standards')"
        feature = {"standard": questions.ask("plate", question, PLATE, check=load_standard)}
    elif "flange" in target and (plate := questions.given.get("plate")):
        load_standard(plate)
        feature = {"standard": plate}
    if "flange" in target and not robot:
        robot, feature = {"flange": feature["standard"]}, {}
    question = "which scanner ('flangeye scanners')"
    scanner = questions.ask(
        "scanner", question, "none", check=lambda a: a == "none" or load_model("scanners", a)
    )
    configuration = configuration_of(target, questions)
    body = _body(str(target["body"]), out, configuration) if "body" in target else {}
    named: Any = robot["model"] if set(robot) == {"model"} else robot
    sections = {
        "robot": named, "scanner": {} if scanner == "none" else scanner,
        "feature": feature, "target": body, "configuration": configuration,
    }  # fmt: skip
    return head | {name: section for name, section in sections.items() if section}


def _body(mesh: str, out: Path, configuration: dict[str, Any]) -> dict[str, Any]:
    """Return a body's section; its place is unknown if the camera is on the flange."""
    name = os.path.relpath(mesh, out.parent) if Path(mesh).is_file() else mesh
    where = {"at": "unknown"} if configuration.pop("place", None) else {}
    return {"body": name, **where}


def _length_of_files(questions: Questions) -> str:
    return questions.ask(
        "length",
        "unit of the positions in pos01.yaml, pos02.yaml, …",
        "mm",
        check=one_of("m", "mm"),
    )


def _camera(archive: Archive, target: Mapping[str, Any], questions: Questions) -> dict[str, Any]:
    """Return the camera's file, or the board to calibrate it by, if the archive has neither."""
    ((kind, params),) = target.items()
    if any(r.camera for r in archive.recordings):
        return {}
    if cameras := cameras_in(archive.root):
        name = str(cameras[0].path.relative_to(archive.root))
        others = [camera.path.name for camera in cameras[1:]]
        instead = f", not {', '.join(others)}" if others else ""
        questions.assumed.append(f"{cameras[0].note()}{instead} (camera_file changes it)")
        return {"camera_file": name}
    if kind == "aruco":
        return {}
    called = {"spacing": "square", "diameter": "marker"}
    sizes = {called.get(name, name): value for name, value in params.items()}
    return {"board": {"kind": kind} | sizes}


def _has_plate(robot: Mapping[str, Any]) -> bool:
    if "model" not in robot:
        return False
    return load_model("robots", robot["model"]).flange.standard is not None


def configuration_of(target: Mapping[str, Any], questions: Questions) -> dict[str, Any]:
    """Return the configuration section; empty for a camera that sees the flange."""
    question = "where the camera is mounted (base or flange)"
    carried = questions.ask("camera", question, "base", check=one_of("base", "flange"))
    if carried not in ("base", "flange"):
        raise RecipeError(f"--camera {carried}: is neither base nor flange")
    if carried == "flange":
        return {"name": "eye-in-hand", "place": "unknown"}
    known = bool({"flange", "sphere", "body"} & set(target))
    return {} if known else {"name": "eye-on-base", "place": "unknown"}


def steps_of(target: Mapping[str, Any], sized: bool = True) -> list[Any]:
    """Return the steps from a scan of a target to the verified pose; none finds one measured.

    Args:
        target: The target, its name with parameters; empty where it is measured.
        sized: Whether the target's size is known.
    """
    found: list[Any] = []
    if "flange" in target:
        found = ["segment.flange", "fit.rim"]
    elif "body" in target:
        found = ["segment.body", "fit.body"]
    elif "sphere" in target:
        found = ["segment.sphere", "fit.sphere"]
    elif target:
        found = [{f"fit.{name}": params} for name, params in target.items()]
    solve = "solve.robust" if sized else {"solve.robust": {"target_size": "unknown"}}
    return [*found, solve, "verify.holdout"]


# --- lines for the person


def _summary(archive: Archive, reader: Any) -> list[str]:
    records = archive.recordings
    seen = {
        "a cloud": sum(r.cloud is not None for r in records),
        "an image": sum(r.image is not None for r in records),
        "a measured target": sum(
            r.camera_T_target is not None or r.centre_in_camera is not None for r in records
        ),
    }
    with_what = ", ".join(f"{n} with {what}" for what, n in seen.items() if n)
    told = [f"{len(records)} poses ({archive.layout}), {with_what}"]
    if reader != "auto":
        told.append(f"reader: {json.dumps(reader, ensure_ascii=False)}")
    first = next((r.cloud for r in records if r.cloud), None)
    if first is not None:
        told.append(_of_cloud(first))
    return [*told, *archive.notes]


def _of_cloud(path: Path) -> str:
    notes: list[str] = []
    cloud = read_scan(path, told=notes.append)
    size = " x ".join(map(str, reversed(cloud.xyz.shape[:-1])))
    far = median_distance(cloud)
    try:
        unit = detect_unit(path, far, ScannerData(model="the scanner"))
    except StageError as error:
        return str(error)
    return "; ".join([f"{path.name}: {size} points, at {far:.4g} {unit} (median)", *notes])


def yaml_of(data: Mapping[str, Any]) -> str:
    """Return a recipe's text: a line a section, a line a step."""
    lines = [f"{key}: {flow(value)}" for key, value in data.items() if key != "steps"]
    return "\n".join([*lines, "steps:", *(f"  - {entry(step)}" for step in data["steps"])]) + "\n"

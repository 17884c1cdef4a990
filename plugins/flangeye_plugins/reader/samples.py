"""Sample files of other tools, each read through ``reader.table``.

easy_handeye and easy_handeye2 (IFL-CAMP, marcoesposito1988) write ``samples:``, a list of ``robot``
and ``tracking`` transforms, or ``hand_world_samples`` and ``camera_marker_samples``, in metres with
quaternions xyzw. The marker's pose is in the camera. The robot's pose is base_T_effector for
eye-in-hand and its inverse for eye-on-base, because both tools solve eye-on-base as if it were
eye-in-hand (``handeye_sampler.py``, ``_get_transforms``).

MoveIt Calibration's RViz panel writes a list of ``effector_wrt_world`` and ``object_wrt_sensor``:
4x4 matrices row by row in metres, for either mounting (``handeye_control_widget.cpp``,
``saveSamplesBtnClicked``).

ViSP writes the flange in the base to ``pose_rPe_1.yaml`` and the object in the camera to
``pose_cPo_1.yaml``, each a position in metres and a rotation vector (``vpPoseVector``).

Zivid's samples are ``pos01.yaml``, a matrix of the SDK (``FloatMatrix: Data:``) or of OpenCV
(``PoseState``), with ``img01.ply`` beside it. Zivid's own are in millimetres.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from flangeye import Params, StageError, part
from flangeye.files.recording import Archive, NotThisLayout
from flangeye.files.scans import natural
from flangeye.files.tables import Table, document_of, files_at, read_table
from flangeye_plugins.reader.columns import CloudUnitParams
from flangeye_plugins.reader.table import TableParams, table


class EasyHandeyeParams(Params):
    """The direction of the robot's poses."""

    calibration: Literal["eye_on_base", "eye_in_hand"]
    """The type it was sampled for: with eye_on_base the tool writes the robot's poses the other way
    round (effector_T_base)."""


class ZividSamplesParams(CloudUnitParams):
    """Unit of the poses, which Zivid's samples do not state."""

    length: Literal["m", "mm"]
    """Unit of the positions; Zivid's own are mm."""


@part("reader.easy_handeye")
def easy_handeye(path: Path, params: EasyHandeyeParams) -> Archive:
    """Read the samples that easy_handeye or easy_handeye2 saved."""
    quaternion = (*(f"translation.{x}" for x in "xyz"), *(f"rotation.{x}" for x in "xyzw"))
    metres = {"rotation": "xyzw", "length": "m"}
    for file, found in _tables(path):
        # What the arm's and the marker's transforms stand under
        for robot, marker in (
            ("robot", "tracking"),
            ("hand_world_samples", "camera_marker_samples"),
            ("hand_world_samples.transforms", "camera_marker_samples.transforms"),
        ):
            if _has(found, f"{robot}.translation"):
                _refuse_other_type(file, params.calibration)
                inverse = params.calibration == "eye_on_base"
                return _read(file, "easy_handeye", metres | {
                    "columns": [f"{robot}.{name}" for name in quaternion],
                    "pose": "flange_T_base" if inverse else "base_T_flange",
                    "target": metres | {"columns": [f"{marker}.{name}" for name in quaternion]},
                })  # fmt: skip
    raise NotThisLayout(f"{path}: holds no samples of easy_handeye (samples: of robot, tracking)")


@part("reader.moveit")
def moveit(path: Path) -> Archive:
    """Read the samples that MoveIt Calibration saved."""
    matrix = {"rotation": "matrix", "length": "m"}
    effector = "effector_wrt_world"
    seen = "object_wrt_sensor"
    for file, found in _tables(path):
        if _has(found, effector):
            return _read(file, "MoveIt Calibration", matrix | {
                "columns": [effector], "pose": "base_T_flange",
                "target": matrix | {"columns": [seen]},
            })  # fmt: skip
    raise NotThisLayout(f"{path}: holds no samples of MoveIt Calibration ({effector}, {seen})")


@part("reader.visp")
def visp(path: Path) -> Archive:
    """Read ViSP's pose_rPe_N.yaml and pose_cPo_N.yaml."""
    vector = {"rotation": "vector", "length": "m", "angle": "rad"}
    return _read(path / "*rPe*.yaml", "ViSP", vector | {
        "pose": "base_T_flange", "target": vector | {"file": "*cPo*.yaml"},
    })  # fmt: skip


@part("reader.zivid")
def zivid(path: Path, params: ZividSamplesParams) -> Archive:
    """Read a folder of posNN.yaml with clouds or images imgNN beside them."""
    pattern = next((p for p in ("pos*.yaml", "pos*.yml") if files_at(path, p)), None)
    if pattern is None:
        raise NotThisLayout(f"{path}: holds no pos01.yaml")
    found = read_table(path, pattern)
    columns = [name for name in ("FloatMatrix.Data", "PoseState") if _has(found, name)]
    if not columns:
        raise StageError(f"{found.file}: holds neither FloatMatrix.Data nor PoseState.data")
    return _read(path / pattern, "Zivid", {
        "rotation": "matrix", "length": params.length, "columns": columns,
        "pose": "base_T_flange", "cloud_unit": params.cloud_unit,
    })  # fmt: skip


def _tables(path: Path) -> Iterator[tuple[Path, Table]]:
    """Yield the tables of a file, or of the documents of a folder; other files are skipped."""
    files = [path] if path.is_file() else sorted(path.glob("*"), key=lambda p: natural(p.name))
    for file in files:
        if file.suffix in (".yaml", ".yml", ".samples", ".json"):
            try:
                yield file, read_table(file.parent, file.name)
            except StageError:
                if file == path:
                    raise


def _has(found: Table, name: str) -> bool:
    return any(column == name or column.startswith(f"{name}.") for column in found.heading)


def _read(file: Path, layout: str, given: Mapping[str, Any]) -> Archive:
    archive: Archive = table(file.parent, TableParams.model_validate({"file": file.name, **given}))
    return replace(archive, layout=layout)


def _refuse_other_type(file: Path, stated: str) -> None:
    document = document_of(file)
    parameters = document.data.get("parameters") if document else None
    written = parameters.get("calibration_type") if isinstance(parameters, Mapping) else None
    if written and written != stated:
        raise StageError(f"{file}: was sampled for {written}, but the recipe states {stated}")

"""Read a camera's calibration from the files of common programs.

These are ROS's ``camera_info``, OpenCV's FileStorage, kalibr's camchain, COLMAP's ``cameras.txt``,
RealSense's and Zivid's intrinsics, NumPy arrays, and text with labels.
"""

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flangeye.errors import StageError
from flangeye.files.clouds.plain import load_npy
from flangeye.files.documents import DOCUMENT_READERS, document_of
from flangeye.files.regular import read_text
from flangeye.types import Floats

CAMERA_MATRICES = (
    "cameramatrix", "intrinsicmatrix", "intrinsics", "intrinsic", "mtx", "matrix", "k", "m",
)  # fmt: skip
"""Names of the camera matrix. Like all names here they are in lower case, without separators."""
_FIRST_CAMERA = ("", "1", "left", "l")
"""Suffixes of the names of the only camera, or of the first of a stereo pair."""
ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""OpenCV's distortion coefficients in their order."""
LABELLED = (".txt", ".csv", ".ini", ".cfg", ".toml")
"""Endings of text files with a bare matrix, or with numbers behind labels."""


class CameraFile(NamedTuple):
    """A camera's calibration.

    Attributes:
        path: The file.
        matrix: (3, 3) camera matrix [px].
        distortion: (k,) OpenCV's distortion coefficients.
        others: Number of further cameras in the file.
        lens_of: Name of the file with the distortion, if that is another file.
    """

    path: Path
    matrix: Floats
    distortion: Floats
    others: int = 0
    lens_of: str = ""

    def note(self) -> str:
        """Return a printable note on this calibration file."""
        (fx, _, cx), (_, fy, cy), _ = self.matrix
        lens = f"{len(self.distortion)} coefficients" if self.distortion.any() else "no distortion"
        lens += f" of {self.lens_of}" if self.lens_of else ""
        lens += f"; the first of {self.others + 1} cameras in this file" if self.others else ""
        return (
            f"camera of {self.path}: focal length {fx:.1f}, {fy:.1f} px, principal point {cx:.1f}, "
            f"{cy:.1f} px, {lens}"
        )


def cameras_in(folder: Path) -> list[CameraFile]:
    """Return the calibrations in the files of a folder and of the folders in it.

    Raises:
        StageError: As :func:`camera_in`.
    """
    names = (*DOCUMENT_READERS, *LABELLED)
    inside = (p for p in (*folder.glob("*"), *folder.glob("*/*")) if p.suffix.lower() in names)
    # A file that is larger [bytes] holds recordings, and is not looked into
    files = sorted(p for p in inside if p.is_file() and p.stat().st_size <= 1_000_000)
    alike = Counter(re.sub(r"\d+", "*", str(path)) for path in files)
    # Files whose names differ only in a number hold one pose each
    found = (camera_in(p) for p in files if alike[re.sub(r"\d+", "*", str(p))] < 3)
    return [camera for camera in found if camera is not None]


def camera_in(path: Path) -> CameraFile | None:
    """Return the camera calibration in a file; None if it holds none.

    Raises:
        StageError: The lens model is not OpenCV's.
    """
    try:
        data = _document(path)
    except StageError:
        return None
    if isinstance(data, CameraFile):
        return data
    if isinstance(data, np.ndarray):
        camera = _checked(path, data, ())
        return camera and _with_lens_beside(camera)
    found = [(values, matrix) for values in _mappings(data)
             if (matrix := _matrix(values)) is not None and _is_camera(matrix)]  # fmt: skip
    if not found:
        return None
    values, matrix = found[0]
    _require_opencv(path, values)
    others = sum(not np.array_equal(other, matrix) for _, other in found)
    others += _named(values, ("2", "right", "r")) is not None
    lens = _distortion(values)
    if not lens.size:  # it may stand in a mapping of its own, one for each camera
        apart = [each for mapping in _mappings(data) if (each := _distortion(mapping)).size]
        lens = apart[0] if len(apart) == len(found) else lens
    camera = _checked(path, matrix, lens)
    return camera and camera._replace(others=others)


def _document(path: Path) -> Any:
    """Return a file's content: mappings, a bare matrix, or COLMAP's camera; None for others."""
    if path.suffix.lower() == ".npy":
        array = load_npy(path)
        return array.astype(np.float64).reshape(3, 3) if array.size == 9 else None
    if path.suffix.lower() not in LABELLED:
        document = document_of(path)
        return None if document is None else document.data
    lines = read_text(path).splitlines()
    if path.name == "cameras.txt":
        return _colmap(path, lines)
    rows = [line.replace(",", " ").split() for line in lines]
    rows = [row for row in rows if row and not row[0].startswith("#")]
    words = [word for row in rows for word in row]
    if [len(row) for row in rows] in ([3, 3, 3], [9]) and all(map(_is_number, words)):
        return np.array(words, dtype=np.float64).reshape(3, 3)
    return _labelled(lines)


def _labelled(lines: Iterable[str]) -> dict[str, Any]:
    """Return the numbers behind each label: ``fx = 900``, or the rows under ``camera matrix``."""
    found: dict[str, list[float]] = {}
    label = ""
    for line in lines:
        words = re.match(r"[\s\[]*([A-Za-z][\w ]*?)\s*([\]=:]|$)", line)
        if words:
            label = words[1].lower().replace(" ", "_")
        rest = line[words.end() :] if words else line
        numbers = re.findall(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?!\w)", rest)
        found.setdefault(label, []).extend(map(float, numbers))
    return {name: n[0] if len(n) == 1 else n for name, n in found.items() if n}


def _with_lens_beside(camera: CameraFile) -> CameraFile:
    """Return a camera with the distortion from the only file ``dist…`` in its folder."""
    beside = [p for p in camera.path.parent.iterdir() if p.stem.lower().startswith("dist")]
    if len(beside) != 1:
        return camera
    try:
        lens = _numbers(_bare(beside[0]))
    except StageError:
        return camera
    fits = len(lens) >= 4 and _checked(beside[0], camera.matrix, lens) is not None
    return camera._replace(distortion=lens, lens_of=beside[0].name) if fits else camera


def _bare(path: Path) -> Any:
    """Return the numbers of a file that holds nothing else."""
    if path.suffix.lower() == ".npy":
        return load_npy(path)
    document = document_of(path)
    return read_text(path).replace(",", " ").split() if document is None else document.data


def _mappings(data: Any) -> Iterator[dict[str, Any]]:
    """Yield the mappings in a document, the outer first, names in small letters."""
    if isinstance(data, Mapping):
        yield _plain(data)
    values = data.values() if isinstance(data, Mapping) else data if isinstance(data, list) else ()
    for value in values:
        yield from _mappings(value)


def _plain(values: Mapping[Any, Any]) -> dict[str, Any]:
    """Return values with names in lower case without separators: ``cameramatrix``."""
    return {re.sub(r"[_ -]", "", str(name).lower()): value for name, value in values.items()}


def _matrix(values: Mapping[str, Any]) -> Floats | None:
    matrix = _one_by_one(values)
    matrix = _named(values, _FIRST_CAMERA) if matrix is None else matrix
    if matrix is not None and "radialdistortion" in values:  # MATLAB's first pixel is at 1, 1
        matrix = matrix - [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]
    return matrix


def _one_by_one(values: Mapping[str, Any]) -> Floats | None:
    # Names of single values: the usual ones, RealSense's, nerfstudio's
    for names in (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy"), ("flx", "fly", "cx", "cy")):
        if all(_is_number(values.get(name)) for name in names):
            return _pinhole(*(float(values[name]) for name in names))
    if (focal := _numbers(values.get("focallength"))).size == 2:
        middle = _numbers(values.get("principalpoint"))
        return _pinhole(*focal, *middle) if middle.size == 2 else None
    return None


def _named(values: Mapping[str, Any], behind: Iterable[str]) -> Floats | None:
    """Return the matrix whose name has one of these endings; None if there is none."""
    for name in (f"{name}{which}" for name in CAMERA_MATRICES for which in behind):
        value = values.get(name)
        if isinstance(value, Mapping):
            value = _matrix(_plain(value))
        numbers = _numbers(value)
        if numbers.size == 9:
            matrix = numbers.reshape(3, 3)
            # Open3D writes it column by column: a camera's last row is 0, 0, 1
            return matrix.T if (matrix[:2, 2] == 0).all() and matrix[2, 0] > 1 else matrix
        if numbers.size == 4:
            return _pinhole(*numbers)
    return None


def _distortion(values: Mapping[str, Any]) -> Floats:
    if "radialdistortion" in values:  # MATLAB's
        k1, k2, k3 = np.resize([*_numbers(values["radialdistortion"]), 0.0, 0.0, 0.0], 3)
        p1, p2 = np.resize([*_numbers(values.get("tangentialdistortion")), 0.0, 0.0], 2)
        return np.array([k1, k2, p1, p2, k3])
    others = [name for name in values if name.startswith("dist") and name != "distortionmodel"]
    usual = (
        "distortioncoefficients", "distortioncoeffs", "distcoeffs", "distortion", "dist", "coeffs",
        "d",
    )  # fmt: skip
    named = [f"{name}{which}" for name in usual for which in _FIRST_CAMERA]
    for name in (*named, *others):
        value = values.get(name)
        if isinstance(value, Mapping):
            known = _plain(value)
            value = known.get("data", _in_order(known))
        if (numbers := _numbers(value)).size:
            return numbers
    if _is_number(values.get("k1")):
        return _numbers(_in_order(values))
    return np.zeros(0)


def _in_order(values: Mapping[str, Any]) -> list[Any]:
    """Return distortion coefficients that have one name each, such as ``k1``, in OpenCV's order."""
    # OpenCV's vector has 4, 5, 8, 12 or 14 entries: with any of k4 to k6 it has eight
    count = len(ORDER) if any(values.get(name) for name in ORDER[5:]) else 5
    return [values.get(name, 0.0) for name in ORDER[:count]]


def _require_opencv(path: Path, values: Mapping[str, Any]) -> None:
    named = [str(values.get(name, "")).lower() for name in ("distortionmodel", "model")]
    # Words in the names of models whose coefficients are not OpenCV's
    words = ("equidistant", "fisheye", "kannala", "fov", "inverse", "omni", "ds", "eucm")
    other = next((name for name in named if any(word in name for word in words)), None)
    if other and _distortion(values).any():
        raise StageError(
            f"{path}: its lens is of the model {other}, whose coefficients are not OpenCV's; "
            "rectify the images, and write focal_length and principal_point of the rectified ones"
        )


def _colmap(path: Path, lines: list[str]) -> CameraFile | None:
    """Return the first camera of COLMAP's list: its id, model, width, height, parameters."""
    # Those of COLMAP's models that are OpenCV's (COLMAP, camera models)
    known_models = {
        "SIMPLE_PINHOLE": ("f", "cx", "cy"),
        "PINHOLE": ("fx", "fy", "cx", "cy"),
        "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
        "RADIAL": ("f", "cx", "cy", "k1", "k2"),
        "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
        "FULL_OPENCV": ("fx", "fy", "cx", "cy", *ORDER),
    }
    corner = 0.5  # in COLMAP the centre of the first pixel [px]; in OpenCV it is at 0
    for line in lines:
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        names = known_models.get(words[1]) if len(words) > 1 else None
        given = words[4:]
        if names is None or len(given) != len(names) or not all(map(_is_number, given)):
            return None
        known = dict(zip(names, map(float, given), strict=True))
        fx, fy = known.get("fx", known.get("f", 0.0)), known.get("fy", known.get("f", 0.0))
        matrix = _pinhole(fx, fy, known["cx"] - corner, known["cy"] - corner)
        return _checked(path, matrix, [known[name] for name in ORDER if name in known])
    return None


def _checked(path: Path, matrix: Floats, lens: Iterable[float]) -> CameraFile | None:
    """Return a calibration; None if the matrix is not a camera matrix."""
    coefficients = np.asarray(lens, dtype=np.float64).ravel()
    # OpenCV's longest vector: k1 to k6, p1, p2, s1 to s4, tau_x, tau_y
    most_coefficients = 14
    sound = len(coefficients) <= most_coefficients and np.isfinite(coefficients).all()
    return CameraFile(path, matrix, coefficients) if sound and _is_camera(matrix) else None


def _is_camera(matrix: Floats) -> bool:
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return False
    # Focal lengths and principal points are many pixels; entries of a rotation are at most 1
    (fx, _, cx), (zero, fy, cy), last = matrix.tolist()
    return bool(zero == 0 and last == [0, 0, 1] and min(fx, fy, cx, cy) > 1)


def _pinhole(fx: float, fy: float, cx: float, cy: float) -> Floats:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _numbers(value: Any) -> Floats:
    """Return the numbers of lists and arrays; none of anything else."""
    if isinstance(value, Mapping):
        value = value.get("data")
    try:
        return np.asarray([] if value is None else value, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0)


def _is_number(value: Any) -> bool:
    try:
        return math.isfinite(float(value))
    except (TypeError, ValueError, OverflowError):
        return False

"""Named values as plain data: JSON, YAML, TOML, XML, Python's literals, NumPy and MATLAB."""

import ast
import io
import json
import re
import subprocess
import tomllib
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from flangeye.errors import RecipeError, StageError
from flangeye.files.arrays import read_arrays
from flangeye.files.processes import python_command
from flangeye.files.regular import read_regular, read_text
from flangeye.files.words import reason_of
from flangeye.files.yaml_lines import YAML_BYTES, parse_yaml
from flangeye.types import Floats

MATRIX_SHAPES = ((4, 4), (3, 4), (3, 3))
"""Shapes of a pose, of a pose without its last row, and of a rotation."""


class TableDocument(NamedTuple):
    """The content of a file, and the place of each record for messages."""

    data: Any
    where: Callable[[int], str]


def document_of(file: Path) -> TableDocument | None:
    """Return a file's content as mappings, lists, numbers and arrays; None for plain text.

    Raises:
        StageError: It cannot be read, or is damaged.
    """
    read = DOCUMENT_READERS.get(file.suffix.lower())
    if read is None:
        return None
    try:
        document = read(file)
        return document and document._replace(data=_plain(document.data))
    except StageError:
        raise
    except Exception as error:  # damaged bytes can break these parsers in any way
        raise StageError(f"{file}: cannot be read: {reason_of(error)}") from None


def _json(file: Path) -> TableDocument:
    return TableDocument(_loaded(str(file), read_text(file)), lambda at: f"{file}: record {at + 1}")


def _json_lines(file: Path) -> TableDocument:
    lines = [(n, line) for n, line in enumerate(read_text(file).splitlines(), 1) if line.strip()]
    records = [_loaded(f"{file}:{n}", line) for n, line in lines]
    return TableDocument(records, lambda at: f"{file}:{lines[at][0]}")


def _loaded(where: str, text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise StageError(f"{where}: is not JSON: {reason_of(error)}") from None


def _toml(file: Path) -> TableDocument | None:
    """Return the sections of a TOML file, such as ``[12]`` with a pose; None for other texts."""
    try:
        return TableDocument(tomllib.loads(read_text(file)), lambda at: f"{file}: record {at + 1}")
    except tomllib.TOMLDecodeError:
        return None


def _yaml(file: Path) -> TableDocument:
    text = read_text(file)
    if len(text) > YAML_BYTES:
        raise StageError(f"{file}: is larger than {YAML_BYTES} bytes; write it as .json")
    text = re.sub(
        r"\n---\s*\Z",
        "\n",
        re.sub(r"\A%YAML[^\n]*\n(?:---[^\n]*\n)?|!!opencv(?:-nd)?-matrix", "", text),
    )
    # What `ros2 topic echo` prints: a document for each message
    parts = [part for part in re.split(r"^---[ \t]*$", text, flags=re.MULTILINE) if part.strip()]
    try:
        if len(parts) > 1:
            records = [
                parse_yaml(part, f"{file}, document {i}").data for i, part in enumerate(parts, 1)
            ]
            return TableDocument(records, lambda at: f"{file}: document {at + 1}")
        document = parse_yaml(text, str(file))
    except RecipeError as error:
        raise StageError(str(error)) from None
    return TableDocument(document.data, lambda at: f"{file}:{document.line((at,))}")


def _xml(file: Path) -> TableDocument:
    """Return the content of an XML file; entities are refused, since they can expand."""
    text = read_text(file)
    if "<!" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL):
        raise StageError(f"{file}: declares a document type or entities, which are not read")
    return TableDocument(
        _element(ElementTree.fromstring(text)), lambda at: f"{file}: record {at + 1}"
    )


def _element(element: ElementTree.Element) -> Any:
    """Return the content of an element: its attributes and children by name, or its numbers."""
    children = list(element)
    if children and all(child.tag == "_" for child in children):
        return [_element(child) for child in children]
    # What the storage says of its own types is no value
    found = {k: _value(v, False) for k, v in element.attrib.items() if k not in ("type_id", "type")}
    many = Counter(child.tag for child in children)
    for child in children:
        value = _element(child)
        found[child.tag] = [*found.get(child.tag, []), value] if many[child.tag] > 1 else value
    text = _value(element.text or "", element.tag == "data")
    return found | ({"": text} if text != "" and found else {}) or text


def _value(text: str, listed: bool) -> Any:
    text = text.replace('"', " ").strip()
    words = text.replace(",", " ").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return text
    return numbers if listed or len(numbers) > 1 else numbers[0] if numbers else ""


def _python(file: Path) -> TableDocument:
    """Return the lists of numbers that a script assigns or appends; nothing of it is run."""
    data: dict[str, Any] = {}
    for node in ast.walk(ast.parse(read_text(file, YAML_BYTES))):
        match node:
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                data |= _literal(name, value)
            case ast.Call(func=ast.Attribute(value=ast.Name(id=name), attr="append"), args=[value]):
                rows = data.get(name)
                if isinstance(rows, list):
                    rows += _literal(name, value).values()
    return TableDocument({k: v for k, v in data.items() if v}, lambda at: f"{file}: row {at + 1}")


def _literal(name: str, node: ast.expr) -> dict[str, Any]:
    """Return a list or mapping under its name, without calls such as np.array around it."""

    class Bare(ast.NodeTransformer):
        def visit_Call(self, node: ast.Call) -> Any:
            return self.visit(node.args[0]) if node.args else node

    try:
        value = ast.literal_eval(Bare().visit(node))
    except (ValueError, TypeError, SyntaxError):
        return {}
    return {name: value} if isinstance(value, list | dict) else {}


def _numpy(file: Path) -> TableDocument:
    arrays = read_arrays(file)
    data: Any = arrays[""] if list(arrays) == [""] else arrays
    return TableDocument(data, lambda at: f"{file}: row {at + 1}")


def _matlab(file: Path) -> TableDocument:
    """Return the arrays of a .mat file, parsed in another process: damage can crash the parser."""
    command = python_command(str(Path(__file__).with_name("matlab_parser.py")))
    # Longest .mat file [bytes]
    content = read_regular(file, 1_000_000)
    if content.startswith((b"MATLAB 7.3", b"\x89HDF\r\n")):
        raise StageError(
            f"{file}: is a MATLAB 7.3 file (HDF5), which is not read; in MATLAB, write it anew: "
            f"load('{file.name}'); save('{file.name}', '-v7')"
        )
    longest = 20  # for one file [s]
    try:
        done = subprocess.run(
            command, input=content, capture_output=True, timeout=longest, check=False
        )
    except subprocess.TimeoutExpired:
        raise StageError(f"{file}: cannot be read: its parser took more than {longest} s") from None
    if done.returncode < 0:
        raise StageError(f"{file}: cannot be read: it is damaged, its parser crashed")
    if done.returncode:
        raise ValueError(done.stderr.decode("utf-8", "replace"))
    found = np.load(io.BytesIO(done.stdout), allow_pickle=False)
    data: dict[str, Any] = {}
    for name, array in found.items():
        *structures, last = name.removeprefix("of_").split(".")
        place = data
        for each in structures:
            place = place.setdefault(each, {})
        place[last] = array
    return TableDocument(data, lambda at: f"{file}: row {at + 1}")


DOCUMENT_READERS: Mapping[str, Callable[[Path], TableDocument | None]] = {
    ".json": _json, ".jsonl": _json_lines, ".ndjson": _json_lines,
    ".yaml": _yaml, ".yml": _yaml, ".samples": _yaml, ".xml": _xml,
    ".py": _python, ".toml": _toml, ".ini": _toml, ".npz": _numpy, ".npy": _numpy, ".mat": _matlab,
}  # fmt: skip
"""Documents by their ending; everything else is text."""


def _plain(value: Any) -> Any:
    """Return data with matrices as arrays.

    Matrices state their rows and columns (OpenCV, ROS, ViSP). Stacks with a pose for each last
    index (MATLAB) are turned so that poses come first.
    """
    if isinstance(value, np.ndarray):
        return _poses_first(value)
    if isinstance(value, list):
        return [_plain(each) if isinstance(each, Mapping | list) else each for each in value]
    if not isinstance(value, Mapping):
        return value
    if {"rows", "cols", "data"} <= set(value) and isinstance(value["data"], list):
        channels = re.match(r"\d*", str(value.get("dt", "")))
        shape = [int(value["rows"]), int(value["cols"])]
        shape += [int(channels[0])] if channels and channels[0] else []
        return _poses_first(np.array(value["data"], float).reshape(shape))
    return {str(key): _plain(each) for key, each in value.items()}


def stacked(rows: Floats) -> Floats | None:
    """Return the matrices (N, r, c) stacked in an array (N r, c); None if it is no such stack."""
    for lines, width in MATRIX_SHAPES:
        if rows.ndim != 2 or rows.shape[1] != width or not len(rows) or len(rows) % lines:
            continue
        stack = rows.reshape(-1, lines, width)
        with np.errstate(all="ignore"):  # numbers that are not a rotation's can be of any size
            gram = stack[:, :3, :3] @ stack[:, :3, :3].swapaxes(1, 2)
        last = lines == 3 or bool((stack[:, 3] == [0, 0, 0, 1]).all())
        # Rows of a written rotation are rounded: so far they may be from orthonormal
        if last and np.abs(gram - np.eye(3)).max() < 2e-3:
            return stack
    return None


def _poses_first(array: Floats) -> Floats:
    stack = stacked(array) if array.dtype.kind in "iuf" else None
    if stack is not None and len(stack) > 1:
        return stack
    shape = array.shape
    if len(shape) == 3 and shape[:2] in MATRIX_SHAPES and shape[1:] not in MATRIX_SHAPES:
        return np.moveaxis(array, 2, 0)
    # A pose has at most 16 numbers; a wider array of few rows holds one pose a column
    wide = len(shape) == 2 and shape[0] in (3, 6, 7, 12, 16) and shape[1] > 16
    return array.T if wide else array

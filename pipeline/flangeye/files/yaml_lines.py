"""Read YAML as people mean it: the 1.2 core types, no surprises, and the line of every value.

PyYAML follows YAML 1.1, where ``on`` is true, ``012`` is ten, ``1e-3`` is text and the second of
two equal keys wins in silence. Here those are text, twelve, a number and an error. Tags, anchors
and aliases are refused, so nothing can be executed and nothing can expand.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from flangeye.errors import RecipeError
from flangeye.files.regular import read_text

MAX_BYTES = 1_000_000
MAX_DEPTH = 20
MAX_DIGITS = 18
"""Of an integer: it fits into 64 bits, and into a float."""

_INTEGER = re.compile(r"[-+]?\d+")
_SURROGATE = re.compile("[\ud800-\udfff]")
_FLOAT = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?")  # linear, whatever follows
_WORDS: Mapping[str, Any] = {
    "null": None,
    "~": None,
    "": None,
    "true": True,
    "false": False,
}

Keys = tuple[Hashable, ...]


@dataclass(frozen=True)
class Document:
    """A parsed file.

    Attributes:
        name: How messages call the file.
        data: Plain dicts, lists and scalars.
        lines: Path of keys -> line, counted from 1.
    """

    name: str
    data: Any
    lines: Mapping[Keys, int]

    def line(self, keys: Sequence[Hashable]) -> int:
        """Return the line of the deepest part of ``keys`` that exists."""
        path = tuple(keys)
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path, 1)


def read_yaml(path: Path) -> Document:
    """Read a YAML file.

    Raises:
        RecipeError: It cannot be read or is not plain YAML; names the line and the cure.
    """
    return parse_yaml(read_text(path, MAX_BYTES, RecipeError), str(path))


def parse_yaml(text: str, name: str) -> Document:
    """Parse YAML text; ``name`` is what messages call it.

    Raises:
        RecipeError: Names the line and the cure.
    """
    document = _parse(text, name)
    return replace(document, data=deepcopy(document.data))


@lru_cache(maxsize=64)  # a batch reads its recipe and its robot's file once a session
def _parse(text: str, name: str) -> Document:
    if _SURROGATE.search(text):  # a byte of the command line that is no UTF-8
        raise RecipeError(f"{name}: is not UTF-8 text")
    try:
        root = _composed(text, name)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f":{mark.line + 1}" if mark else ""
        raise RecipeError(f"{name}{line}: not valid YAML: {error.problem}") from None
    except yaml.YAMLError as error:
        raise RecipeError(f"{name}: not valid YAML: {str(error).splitlines()[0]}") from None
    lines: dict[Keys, int] = {}
    data = _build(root, (), lines, name) if root is not None else None
    return Document(name, data, lines)


def _composed(text: str, name: str) -> yaml.Node | None:
    """Return the root of a document; libyaml's parser is ten times as fast."""
    fast = getattr(yaml, "CSafeLoader", None)
    if fast is not None:
        with suppress(yaml.YAMLError):  # its words for a mistake are others
            _refuse_dangers(text, name, fast)
            return yaml.compose(text, Loader=fast)
    _refuse_dangers(text, name, yaml.SafeLoader)
    return yaml.compose(text, Loader=yaml.SafeLoader)


def parse_value(text: str, name: str) -> Any:
    """Parse one YAML value, as ``--set`` gives it."""
    return parse_yaml(text, name).data


def _refuse_dangers(text: str, name: str, loader: type[yaml.SafeLoader]) -> None:
    """Look at the events first: they are flat, so nothing can expand or recurse yet."""
    depth = 0
    for event in yaml.parse(text, Loader=loader):
        where = f"{name}:{event.start_mark.line + 1 if event.start_mark else 1}"
        tag = getattr(event, "tag", None)
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            raise RecipeError(
                f"{where}: anchors and aliases (& and *) are not allowed; write it out"
            )
        if tag:
            raise RecipeError(f"{where}: tags ({tag}) are not allowed; use plain values")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > MAX_DEPTH:
            raise RecipeError(f"{where}: nested deeper than {MAX_DEPTH} levels")


def _build(node: yaml.Node, path: Keys, lines: dict[Keys, int], name: str) -> Any:
    lines.setdefault(path, node.start_mark.line + 1)
    if isinstance(node, yaml.MappingNode):
        return _build_mapping(node, path, lines, name)
    if isinstance(node, yaml.SequenceNode):
        return [_build(child, (*path, i), lines, name) for i, child in enumerate(node.value)]
    text, plain = _text(node, name), not getattr(node, "style", None)
    if plain and len(text) > MAX_DIGITS and _INTEGER.fullmatch(text):
        raise RecipeError(
            f"{name}:{lines[path]}: an integer of {len(text)} digits; at most {MAX_DIGITS} are "
            "read, and a name of digits is written in quotes"
        )
    return _scalar(text, plain)


def _text(node: yaml.Node, name: str) -> str:
    """Return the text of a scalar; an escape can write what is no character and has no UTF-8."""
    text = str(node.value)
    if _SURROGATE.search(text):
        raise RecipeError(f"{name}:{node.start_mark.line + 1}: is not UTF-8 text")
    return text


def _build_mapping(
    node: yaml.MappingNode, path: Keys, lines: dict[Keys, int], name: str
) -> dict[Hashable, Any]:
    built: dict[Hashable, Any] = {}
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        if not isinstance(key_node, yaml.ScalarNode):
            raise RecipeError(f"{name}:{line}: a key must be plain text")
        key = _text(key_node, name)
        if key in built:
            first = lines[(*path, key)]
            raise RecipeError(f"{name}:{line}: duplicate key '{key}', first given on line {first}")
        lines[(*path, key)] = line
        built[key] = _build(value_node, (*path, key), lines, name)
    return built


def _scalar(text: str, plain: bool) -> Any:
    """Return the value of a scalar; only plain ones, without quotes, can be other than text."""
    if not plain:
        return text
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    if _INTEGER.fullmatch(text):
        return int(text)
    return float(text) if _FLOAT.fullmatch(text) else text

"""Read YAML with the core types of version 1.2, and with the line of every value.

PyYAML follows YAML 1.1: there ``on`` is true, ``012`` is ten, ``1e-3`` is text, and the second of
two equal keys silently replaces the first. Here these are a text, twelve, a number and an error.
Tags, anchors and aliases are refused, so nothing is executed and nothing expands.
"""

import re
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, replace
from difflib import SequenceMatcher
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from flangeye.errors import RecipeError
from flangeye.files.regular import read_text

YAML_BYTES = 1_000_000

_INTEGER = re.compile(r"[-+]?\d+")
_SURROGATE = re.compile("[\ud800-\udfff]")

YamlPath = tuple[Hashable, ...]


@dataclass(frozen=True)
class Document:
    """A parsed YAML file.

    Attributes:
        name: Name of the file in messages.
        data: Plain dicts, lists and scalars.
        lines: Path of keys -> line, counted from 1.
    """

    name: str
    data: Any
    lines: Mapping[YamlPath, int]

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
    return parse_yaml(read_text(path, YAML_BYTES, RecipeError), str(path))


def parse_yaml(text: str, name: str) -> Document:
    """Parse YAML text; messages begin with ``name``.

    Raises:
        RecipeError: Names the line and the cure.
    """
    document = _parse(text, name)
    return replace(document, data=deepcopy(document.data))


@lru_cache(maxsize=64)  # a batch reads its recipe and its robot's file once a session
def _parse(text: str, name: str) -> Document:
    if _SURROGATE.search(text):  # a byte of the command line that is not UTF-8
        raise RecipeError(f"{name}: is not UTF-8 text")
    try:
        root = _composed(text, name)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f":{mark.line + 1}" if mark else ""
        raise RecipeError(f"{name}{line}: not valid YAML: {error.problem}") from None
    except yaml.YAMLError as error:
        raise RecipeError(f"{name}: not valid YAML: {str(error).splitlines()[0]}") from None
    lines: dict[YamlPath, int] = {}
    data = _build(root, (), lines, name) if root is not None else None
    return Document(name, data, lines)


def _composed(text: str, name: str) -> yaml.Node | None:
    """Return the root of a document; libyaml's parser is ten times as fast."""
    fast = getattr(yaml, "CSafeLoader", None)
    if fast is not None:
        with suppress(yaml.YAMLError):  # it words mistakes differently: parsed again
            _refuse_dangers(text, name, fast)
            return yaml.compose(text, Loader=fast)
    _refuse_dangers(text, name, yaml.SafeLoader)
    return yaml.compose(text, Loader=yaml.SafeLoader)


def parse_value(text: str, name: str) -> Any:
    """Parse one YAML value, as given to ``--set``."""
    return parse_yaml(text, name).data


def _refuse_dangers(text: str, name: str, loader: type[yaml.SafeLoader]) -> None:
    """Refuse tags, anchors, aliases and deep nesting before anything can expand or recurse."""
    depth = 0
    deepest = 20
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
        if depth > deepest:
            raise RecipeError(f"{where}: nested deeper than {deepest} levels")


def _build(node: yaml.Node, path: YamlPath, lines: dict[YamlPath, int], name: str) -> Any:
    lines.setdefault(path, node.start_mark.line + 1)
    if isinstance(node, yaml.MappingNode):
        return _build_mapping(node, path, lines, name)
    if isinstance(node, yaml.SequenceNode):
        return [_build(child, (*path, i), lines, name) for i, child in enumerate(node.value)]
    text, plain = _text(node, name), not getattr(node, "style", None)
    digits = 18  # an integer of so many fits into 64 bits, and into a float
    if plain and len(text) > digits and _INTEGER.fullmatch(text):
        raise RecipeError(
            f"{name}:{lines[path]}: an integer of {len(text)} digits; at most {digits} are "
            "read; write a name of digits in quotes"
        )
    return _scalar(text, plain)


def _text(node: yaml.Node, name: str) -> str:
    """Return the text of a scalar; refuse escapes that are no valid Unicode characters."""
    text = str(node.value)
    if _SURROGATE.search(text):
        raise RecipeError(f"{name}:{node.start_mark.line + 1}: is not UTF-8 text")
    return text


def _build_mapping(
    node: yaml.MappingNode, path: YamlPath, lines: dict[YamlPath, int], name: str
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
    """Return the value of a scalar; a quoted one is always text."""
    if not plain:
        return text
    words = {"null": None, "~": None, "": None, "true": True, "false": False}
    if text.lower() in words:
        return words[text.lower()]
    if _INTEGER.fullmatch(text):
        return int(text)
    # This expression takes linear time on any text
    return float(text) if re.fullmatch(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?", text) else text


class Edit(NamedTuple):
    """Replace the characters of a text from ``start`` to before ``end``."""

    start: int
    end: int
    text: str


def edited(text: str, data: Mapping[Any, Any]) -> str:
    """Return a YAML text that holds ``data``, rewritten only where its values differ.

    Comments are kept, except those inside a value that was removed or changed its type.

    Args:
        text: A mapping in YAML.
        data: Content that the text shall have; new keys stand where ``data`` has them.

    Raises:
        RecipeError: The text is not plain YAML.
    """
    old = parse_yaml(text, "recipe").data
    if not isinstance(old, dict) or not old:
        return _whole(data)
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    for edit in sorted(_changes(text, root, old, data), key=lambda each: -each.start):
        text = text[: edit.start] + edit.text + text[edit.end :]
    return text if _holds(text, data) else _whole(data)


def _holds(text: str, data: Mapping[Any, Any]) -> bool:
    """Return whether the edited text holds ``data``; edits fail for some nested lists."""
    try:
        return bool(parse_yaml(text, "recipe").data == data)
    except RecipeError:
        return False


def _whole(data: Mapping[Any, Any]) -> str:
    return dumped(dict(data), width=100)


class _PlainDumper(yaml.SafeDumper):
    """YAML writer that quotes texts which :func:`read_yaml` would read as numbers: 08, 1e3."""

    def represent_text(self, text: str) -> yaml.Node:
        style = None if _scalar(text, plain=True) == text else "'"
        return self.represent_scalar("tag:yaml.org,2002:str", text, style)


_PlainDumper.add_representer(str, _PlainDumper.represent_text)


def dumped(value: Any, *, default_flow_style: bool | None = False, width: int = 80) -> str:
    """Return plain data as YAML that :func:`read_yaml` reads back as it was."""
    text: str = yaml.dump(
        value, Dumper=_PlainDumper, default_flow_style=default_flow_style, width=width,
        sort_keys=False, allow_unicode=True,
    )  # fmt: skip
    return text


def flow(value: Any) -> str:
    """Return a value as YAML on one line."""
    return dumped(value, default_flow_style=True, width=10_000).removesuffix("...\n").strip()


def entry(value: Any) -> str:
    """Return an entry of a block's list on one line: the keys of a mapping without braces."""
    if isinstance(value, dict) and len(value) == 1:
        ((key, inside),) = value.items()
        return f"{flow(key)}: {flow(inside)}"
    return flow(value)


def _changes(
    text: str, node: Any, old: Any, new: Any, whole: Callable[[Any], str] = flow
) -> Iterator[Edit]:
    """Yield the edits that turn a node's value into another; ``whole`` writes all of it."""
    if old == new:
        return
    block = getattr(node, "flow_style", None) is False
    if isinstance(node, yaml.MappingNode) and isinstance(new, Mapping) and new and old:
        # The line of the first key may be that of a list's dash
        if (block and next(iter(old)) in new) or set(old) == set(new):
            yield from _in_mapping(text, node, old, new)
            return
    elif isinstance(node, yaml.SequenceNode) and isinstance(new, list) and new and block:
        yield from _in_list(text, node, old, new)
        return
    yield Edit(node.start_mark.index, _end(node), whole(new))


def _in_mapping(
    text: str, node: yaml.MappingNode, old: Mapping[Any, Any], new: Mapping[Any, Any]
) -> Iterator[Edit]:
    nodes = dict(zip(old, node.value, strict=True))
    indent = " " * node.start_mark.column
    for key, (at, value) in nodes.items():
        if key in new:
            yield from _changes(text, value, old[key], new[key])
        else:
            yield _without_lines(text, at.start_mark.index, _end(value))
    names = list(new)
    for place, key in enumerate(names):
        if key in old:
            continue
        line = f"{flow(key)}: {flow(new[key])}"
        later = next((name for name in names[place:] if name in old), None)
        if later is None:
            end = _end(node)
            yield Edit(end, end, f"\n{indent}{line}")
        else:
            start = nodes[later][0].start_mark.index
            yield Edit(start, start, f"{line}\n{indent}")


def _in_list(
    text: str, node: yaml.SequenceNode, old: Sequence[Any], new: Sequence[Any]
) -> Iterator[Edit]:
    same = SequenceMatcher(None, [flow(each) for each in old], [flow(each) for each in new], False)
    dash = f"{' ' * node.start_mark.column}- "
    for kind, i, j, k, m in same.get_opcodes():
        if kind == "equal":
            continue
        pairs = min(j - i, m - k)
        for n in range(pairs):
            yield from _changes(text, node.value[i + n], old[i + n], new[k + n], entry)
        for gone in node.value[i + pairs : j]:
            yield _without_lines(text, gone.start_mark.index, _end(gone))
        added = [f"{dash}{entry(each)}\n" for each in new[k + pairs : m]]
        if added and i + pairs < len(node.value):
            start = _line_start(text, node.value[i + pairs].start_mark.index)
            yield Edit(start, start, "".join(added))
        elif added:
            end = _end(node)
            yield Edit(end, end, "\n" + "".join(added).rstrip("\n"))


def _without_lines(text: str, start: int, end: int) -> Edit:
    """Return the edit that deletes the lines of an entry of a block."""
    after = text.find("\n", end)
    return Edit(_line_start(text, start), len(text) if after < 0 else after + 1, "")


def _line_start(text: str, index: int) -> int:
    return text.rfind("\n", 0, index) + 1


def _end(node: Any) -> int:
    """Return the index at which a node's text ends; a block ends with its last entry."""
    block = getattr(node, "flow_style", None) is False
    if block and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    end: int = node.end_mark.index
    # A text behind | or > ends at the beginning of the next line
    return end - 1 if getattr(node, "style", None) in ("|", ">") else end

"""Change values of a YAML text and leave the rest as the person wrote it, comments included."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import SequenceMatcher
from typing import Any, NamedTuple

import yaml

from flangeye.errors import RecipeError
from flangeye.files.yaml_lines import parse_yaml


class Edit(NamedTuple):
    """Characters of a text, from ``start`` to before ``end``, and what stands there instead."""

    start: int
    end: int
    text: str


def edited(text: str, data: Mapping[Any, Any]) -> str:
    """Return a YAML text that holds ``data``, written anew only where its values differ.

    Comments stay, but for those inside a value that is gone or is of another kind now.

    Args:
        text: A mapping in YAML.
        data: What it shall hold; new keys stand where ``data`` has them.

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
    """Return whether edits came out right; lists in lists of blocks may leave no place for them."""
    try:
        return bool(parse_yaml(text, "recipe").data == data)
    except RecipeError:
        return False


def _whole(data: Mapping[Any, Any]) -> str:
    return yaml.safe_dump(dict(data), sort_keys=False, allow_unicode=True, width=100)


def flow(value: Any) -> str:
    """Return a value as YAML on one line."""
    text: str = yaml.safe_dump(
        value, default_flow_style=True, sort_keys=False, allow_unicode=True, width=10_000
    )
    return text.removesuffix("...\n").strip()


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
    """Return the edit that takes the lines out that a block's entry stands on."""
    after = text.find("\n", end)
    return Edit(_line_start(text, start), len(text) if after < 0 else after + 1, "")


def _line_start(text: str, index: int) -> int:
    return text.rfind("\n", 0, index) + 1


def _end(node: Any) -> int:
    """Return where a node's text ends; that of a block ends with its last entry."""
    block = getattr(node, "flow_style", None) is False
    if block and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    end: int = node.end_mark.index
    # A text behind | or > ends at the beginning of the next line
    return end - 1 if getattr(node, "style", None) in ("|", ">") else end

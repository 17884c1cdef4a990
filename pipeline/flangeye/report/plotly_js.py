"""plotly.js for a page, with no more than the page draws: less than half of what is installed.

The installed file is a row of modules, ``name=wrapper((exports,module)=>{…});``, each run by
calling its name, and one of them registers the kinds of traces. What is asked for stays in that
list; then the modules that nothing reaches any more lose their bodies. A file that does not look
like this is used whole. The result is remembered, for finding it takes a second.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

from flangeye.files.memory import keep, recall

SORT = "plotly"
MOST = 4
"""Results that are remembered: each is a megabyte."""

_WRAPPER = re.compile(
    r"([\w$]+)=\(\w(?:,\w)*\)=>\(\)=>.{0,50}?"
    r"(?:\{exports:\{\}\}\)\.exports|\w&&\(\w=\w\(\w=0\)\))"
)
"""How esbuild writes what runs a module once: CommonJS, and ECMAScript."""

_TOKEN = re.compile(
    r"""
    "(?:\\.|[^"\\\n])*" | '(?:\\.|[^'\\\n])*' | //[^\n]* | /\*.*?\*/
    | (?:(?<=[(,=:\[!&|?{;]) | (?<=return)) / (?![*/]) (?:\\.|\[(?:\\.|[^\]\\\n])*\]|[^/\\\[\n])+ /
    | [{}`]
    """,
    re.DOTALL | re.VERBOSE,
)
"""Strings, comments and regular expressions, in which braces mean nothing; and the braces."""
_TEMPLATE = re.compile(r"(?:\\.|[^`\\$]|\$(?!\{))*(`|\$\{)", re.DOTALL)
_CALL = re.compile(r"(?<![\w$.])([\w$]+)\(\)")
_REGISTER = re.compile(r"\.register\(\[([\w$(),]*)\]\)")
_TRACE = re.compile(r'moduleType:"trace",name:"(\w+)"')


class _Body(NamedTuple):
    """Where a module's body is in the text, its braces left out."""

    start: int
    end: int


@cache
def packed_plotly(traces: frozenset[str]) -> str:
    """Return plotly.js that draws some kinds of traces, gzip in base64: the page unpacks it."""
    key = _key(traces)
    known = recall(SORT, key)
    if known is not None:
        return known
    whole = plotly_js()
    text = partial_plotly(whole, traces) or whole
    packed = base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()
    keep(SORT, key, packed, MOST)
    return packed


def plotly_js() -> str:
    """Return plotly.js as it is installed."""
    return _installed().read_text(encoding="utf-8")


def partial_plotly(whole: str, traces: Iterable[str]) -> str | None:
    """Return plotly.js that draws some kinds of traces, None where its structure is another.

    Args:
        whole: The text of the installed file.
        traces: What is drawn: ``bar``, ``scatter3d``, … (``scatter`` is always there).
    """
    bodies = _bodies(whole)
    lists = list(_REGISTER.finditer(whole))
    if not bodies or len(lists) != 1:
        return None
    register = lists[0]
    owner = next((n for n, b in bodies.items() if b.start < register.start() < b.end), None)
    offered = {_kind(whole, bodies, name): name for name in _CALL.findall(register[1])}
    if owner is None or not {*traces, "scatter"} <= {*offered, "scatter"}:
        return None
    wanted = ",".join(f"{name}()" for kind, name in offered.items() if kind in set(traces))
    body = bodies[owner]
    registering = (
        f"{whole[body.start : register.start(1)]}{wanted}{whole[register.end(1) : body.end]}"
    )
    texts = {n: whole[b.start : b.end] for n, b in bodies.items()} | {owner: registering}
    return _without(whole, bodies, texts)


def _without(whole: str, bodies: Mapping[str, _Body], texts: Mapping[str, str]) -> str:
    """Return the text with the bodies of modules that are reached, and the others empty."""
    between, at = [], 0
    for body in bodies.values():
        between.append(whole[at : body.start])
        at = body.end
    rest = whole[at:]
    reached: set[str] = set()
    found = {name for piece in (*between, rest) for name in _CALL.findall(piece)}
    while found:
        reached |= found
        called = {name for module in found & texts.keys() for name in _CALL.findall(texts[module])}
        found = called - reached
    kept = (texts[name] if name in reached else "" for name in bodies)
    return "".join(part for pair in zip(between, kept, strict=True) for part in pair) + rest


def _bodies(text: str) -> dict[str, _Body]:
    """Return the modules in order; none where they do not stand alike or end as modules do."""
    wrappers = [wrapper[1] for wrapper in _WRAPPER.finditer(text)]
    names = "|".join(map(re.escape, wrappers))
    header = re.compile(rf"(?<![\w$.])([\w$]+)=(?:{names})\((?:\([\w$,]*\)|[\w$]+)=>\{{")
    opened = {m.end(): m[1] for m in header.finditer(text)} if wrappers else {}
    found = [(depth, body) for depth, body in _braces(text) if body.start in opened]
    alike = {(depth, text[body.end : body.end + 3]) for depth, body in found}
    if len(found) != len(opened) or len(alike) != 1 or alike.pop()[1] != "});":
        return {}
    return {opened[body.start]: body for _, body in found}


def _braces(text: str) -> Iterator[tuple[int, _Body]]:
    """Yield each pair of braces as it closes, and how many are around it."""
    at, stack = 0, []
    while token := _TOKEN.search(text, at):
        at, sign = token.end(), token[0]
        if sign == "{":
            stack.append(at)
        elif sign == "}" and stack:
            start = stack.pop()
            if start:
                yield len(stack), _Body(start, token.start())
            else:
                sign = "`"
        if sign == "`":
            template = _TEMPLATE.match(text, at)
            if template is None:
                return
            at = template.end()
            if template[1] == "${":
                stack.append(0)


def _kind(text: str, bodies: Mapping[str, _Body], name: str, steps: int = 4) -> str:
    """Return the kind of trace that a module offers, looking into those it is made of."""
    if name not in bodies or steps == 0:
        return ""
    body = text[slice(*bodies[name])]
    if found := _TRACE.search(body):
        return found[1]
    kinds = (_kind(text, bodies, other, steps - 1) for other in _CALL.findall(body))
    return next(filter(None, kinds), "") if len(body) < 200 else ""


def _installed() -> Path:
    import plotly

    return Path(plotly.__file__).parent / "package_data" / "plotly.min.js"


def _key(traces: frozenset[str]) -> str:
    """Return a digest of the installed file's state, this code's and what is drawn."""
    states = [
        (str(p), p.stat().st_mtime_ns, p.stat().st_size) for p in (_installed(), Path(__file__))
    ]
    return hashlib.sha256(repr((states, sorted(traces))).encode()).hexdigest()

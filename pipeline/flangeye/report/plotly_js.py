"""plotly.js for a page, with no more than the page draws: less than half of what is installed.

The installed file is a row of modules, ``name=wrapper((exports,module)=>{…});``, each run by
calling its name, and one of them registers the kinds of traces. What is asked for stays in that
list; then the modules that nothing reaches any more lose their bodies. A file that does not look
like this is used whole. Where the pieces are is remembered, for finding them takes a second.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

from flangeye.files.memory import keep, recall

SORT = "plotly"
MOST = 4
"""Results that are remembered."""
LEVEL = 4
"""Of gzip: the page is 2 % larger than with its best, which takes twice as long."""

Piece = tuple[int, int]
"""From where to where in the text."""

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
    """Return plotly.js that draws some kinds of traces, gzip in base64: the page unpacks it.

    Which pieces of the installed file these are is remembered, and no code: what is read from a
    cache must not run.
    """
    whole, key = plotly_js(), _key(traces)
    pieces = _recalled(key, len(whole))
    if pieces is None:
        pieces = pieces_for(whole, traces) or [(0, len(whole))]
        keep(SORT, key, json.dumps(pieces), MOST)
    return base64.b64encode(gzip.compress(_joined(whole, pieces).encode(), LEVEL, mtime=0)).decode()


def _recalled(key: str, length: int) -> list[Piece] | None:
    """Return the pieces that are remembered, None unless they lie in a text in order."""
    with suppress(ValueError, TypeError, RecursionError):
        pieces = [(int(start), int(end)) for start, end in json.loads(recall(SORT, key) or "")]
        ends = [0, *(end for piece in pieces for end in piece), length]
        return pieces if ends == sorted(ends) else None
    return None


def plotly_js() -> str:
    """Return plotly.js as it is installed."""
    return _installed().read_text(encoding="utf-8")


def partial_plotly(whole: str, traces: Iterable[str]) -> str | None:
    """Return plotly.js that draws some kinds of traces; see :func:`pieces_for`."""
    pieces = pieces_for(whole, traces)
    return None if pieces is None else _joined(whole, pieces)


def pieces_for(whole: str, traces: Iterable[str]) -> list[Piece] | None:
    """Return what of plotly.js draws some kinds of traces, None where its structure is another.

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
    calls = list(_CALL.finditer(whole, *register.span(1)))
    kinds = [_kind(whole, bodies, call[1]) for call in calls]
    if owner is None or not {*traces, "scatter"} <= {*kinds, "scatter"}:
        return None
    wanted = [call for call, kind in zip(calls, kinds, strict=True) if kind in set(traces)]
    pieces: dict[str, Sequence[Piece]] = {
        name: [(body.start, body.end)] for name, body in bodies.items()
    }
    pieces[owner] = [
        (bodies[owner].start, register.start(1)),
        *((call.start() - (call is not wanted[0]), call.end()) for call in wanted),  # and comma
        (register.end(1), bodies[owner].end),
    ]
    return _without(whole, bodies, pieces)


def _without(
    whole: str, bodies: Mapping[str, _Body], pieces: Mapping[str, Sequence[Piece]]
) -> list[Piece]:
    """Return the text in pieces: the bodies of modules that are reached, and the others empty."""
    ends = [0, *(end for body in bodies.values() for end in body), len(whole)]
    between = list(zip(ends[::2], ends[1::2], strict=True))
    reached: set[str] = set()
    found = {name for start, end in between for name in _CALL.findall(whole[start:end])}
    while found:
        reached |= found
        texts = [_joined(whole, pieces[name]) for name in found & pieces.keys()]
        found = {name for text in texts for name in _CALL.findall(text)} - reached
    kept = [between[0]]
    for name, after in zip(bodies, between[1:], strict=True):
        kept += [*(pieces[name] if name in reached else ()), after]
    return kept


def _joined(whole: str, pieces: Iterable[Piece]) -> str:
    return "".join(whole[start:end] for start, end in pieces)


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

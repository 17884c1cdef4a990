"""How sound input is spoilt: bytes, texts and numbers that once broke something, and chance."""

from __future__ import annotations

import copy
import json
import random
from xml.etree import ElementTree

NASTY = [
    b"\x00", b"\xff\xfe", b"\x1b[2J", b"9" * 5000, b"1e99999999999999999999 mm", b"NaN", b"-1",
    b"[" * 3000, b"{" * 200, b"&a *a", b"!!python/object/apply:os.system", b"\xc2\xb2", b"1e400",
    b"/dev/zero", b"../../../etc/passwd", b"./evil.sh", b"[/red]", b"\xed\xa0\x80", b"\r\n\t",
    b"true", b"null", b"-0", b"0x7f", b"1_000", b"\xe2\x80\xae", b"%s%n", b"''", b'"', b": ", b"- ",
]  # fmt: skip
"""Texts that broke something once, or might."""


def spoilt(raw: bytes, chance: random.Random) -> bytes:
    """Return sound bytes with one to four things wrong with them."""
    data = bytearray(raw)
    for _ in range(chance.randint(1, 4)):
        _once(data, chance)
    return bytes(data)


def _once(data: bytearray, chance: random.Random) -> None:
    at = chance.randrange(len(data) + 1)
    span = chance.choice((1, 1, 4, 16, 200))
    kind = chance.randrange(7)
    if kind == 0 and data:
        data[at % len(data)] ^= 1 << chance.randrange(8)
    elif kind == 1:
        del data[at : at + span]
    elif kind == 2:
        data[at:at] = chance.choice(NASTY)
    elif kind == 3:
        data[at : at + span] = chance.choice(NASTY)
    elif kind == 4:
        data[at:at] = data[at : at + span] * chance.choice((1, 2, 20))
    elif kind == 5:
        del data[at:]
    else:
        data[at : at + span] = chance.randbytes(span)


VALUES: list[object] = [
    None, True, -1, 0, 10**400, 1e308, -0.0, float("nan"), float("inf"), "", "x" * 3000, "\x1b[2J",
    "../../etc/passwd", "NaN", "1e400", "[/red]", "{{7*7}}", "\ud800", [], {}, [[]], [None] * 9,
    {"": {}}, [[1.0, 2.0], [3.0]], "2026-01-01", 10**18, [0.0] * 16,
]  # fmt: skip
"""What stands where a document had something else."""


def altered(raw: bytes, suffix: str, chance: random.Random) -> bytes:
    """Return a sound document, still well-formed, with one to three other things in it.

    Raises:
        ValueError: It is of no grammar that is known here, or not well-formed.
    """
    if suffix in (".urdf", ".dae", ".xml"):
        return _altered_xml(raw, chance)
    if suffix == ".jsonl":
        lines = raw.splitlines()
        at = chance.randrange(len(lines))
        return b"\n".join([*lines[:at], _altered_json(lines[at], chance), *lines[at + 1 :], b""])
    return _altered_json(raw, chance)


def _altered_json(raw: bytes, chance: random.Random) -> bytes:
    root = [json.loads(raw)]
    for _ in range(chance.randint(1, 3)):
        places = list(_places(root))
        holder, key = chance.choice(places)
        kind = chance.randrange(5)
        if kind == 0 and holder is not root:
            del holder[key]
        elif kind == 1:
            other, at = chance.choice(places)
            holder[key] = copy.deepcopy(other[at])
        elif kind == 2 and isinstance(holder, dict):
            holder[chance.choice(("", "x" * 200, "__class__", "\x00"))] = holder.pop(key)
        else:
            holder[key] = copy.deepcopy(chance.choice(VALUES))
    return json.dumps(root[0]).encode()


def _places(holder):
    """Yield every container in a tree with each of its keys."""
    for key in list(holder) if isinstance(holder, dict) else range(len(holder)):
        yield holder, key
        if isinstance(holder[key], (dict, list)):
            yield from _places(holder[key])


def _altered_xml(raw: bytes, chance: random.Random) -> bytes:
    root = ElementTree.fromstring(raw)
    for _ in range(chance.randint(1, 3)):
        parents = list(root.iter())
        one, other = chance.choice(parents), chance.choice(parents)
        kind = chance.randrange(5)
        if kind == 0 and len(one):
            one.remove(chance.choice(list(one)))
        elif kind == 1 and one is not other:
            one.append(copy.deepcopy(other))
        elif kind == 2:
            one.text = str(chance.choice(VALUES)).replace("\ud800", "")
        elif kind == 3:
            one.tag = other.tag
        elif one.attrib:
            name = chance.choice(list(one.attrib))
            values = [*VALUES, *other.attrib.values()]
            one.set(name, str(chance.choice(values)).replace("\ud800", ""))
    return ElementTree.tostring(root)


def damaged(raw: bytes, suffix: str, chance: random.Random) -> bytes:
    """Return sound bytes spoilt: every other time by their grammar, where it is known."""
    if chance.random() < 0.5:
        try:
            return altered(raw, suffix, chance)
        except (ValueError, ElementTree.ParseError):  # it has no grammar that is known here
            pass
    return spoilt(raw, chance)

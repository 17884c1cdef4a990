"""How sound input is spoilt: bytes, texts and numbers that once broke something, and chance."""

from __future__ import annotations

import random

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

"""Decompress LZF, the coding of PCL's ``binary_compressed`` files.

The stream is a row of tokens. A control byte below 32 says that ``control + 1`` literal bytes
follow. Otherwise its upper three bits and lower five bits are a length and the high part of a
distance into what was written so far; length 7 is continued in the next byte, and the distance's
low byte comes last. Copies are two bytes longer and reach one byte further back than written.
"""

from __future__ import annotations

MAX_EXPANSION = 88
"""A token of three bytes writes 264 at most: more than that is no LZF stream."""


class LzfError(ValueError):
    """The stream is damaged."""


def decompress(data: bytes, wanted: int) -> bytearray:
    """Return the first ``wanted`` bytes that ``data`` stands for; the rest is not decoded.

    Raises:
        LzfError: The stream ends early, or refers to what was never written.
    """
    out = bytearray()
    at = 0
    try:
        while len(out) < wanted:
            control = data[at]
            at += 1
            if control < 32:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            start = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            _repeat(out, start, length + 2)
    except IndexError:
        raise LzfError("it ends early") from None
    del out[wanted:]
    return out


def _repeat(out: bytearray, start: int, length: int) -> None:
    """Append ``length`` bytes from ``start`` on; the source may reach into what is appended."""
    if start < 0:
        raise LzfError("it refers to bytes before its beginning")
    period = len(out) - start
    if period >= length:
        out += out[start : start + length]
    else:
        out += (out[start:] * (length // period + 1))[:length]

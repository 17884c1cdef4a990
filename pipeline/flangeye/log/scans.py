"""A whole scan in few bytes, and quickly: the bytes of its numbers in planes, then a fast codec.

Neighbours in a scan share sign, exponent and leading bits; their last bits are noise. With the
bytes of equal weight side by side the codec packs the first and passes over the last: seven tenths
of the size that it reaches on the points as they are, in a third of the time (the shuffle filter
of HDF5 and Blosc).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flangeye.log.records import MAX_CHUNK
from flangeye.types import Singles

Bytes = NDArray[np.uint8]


BLOCK = 2048
"""Points turned over at once: they fit the processor's nearest memory."""

WIDTH = 12
"""Bytes of a point."""


def pack(xyz: Singles) -> bytes:
    """Return points (..., 3) in few bytes, bit for bit."""
    import zstandard

    points = np.ascontiguousarray(xyz, dtype="<f4").reshape(-1, 3).view(np.uint8)
    # of zstandard: the fast levels lose three hundredths of the size
    return zstandard.compress(_turned(points, (BLOCK, WIDTH)).data, level=-8)


def unpack(packed: bytes, shape: Sequence[int]) -> Singles | None:
    """Return the points of :func:`pack` in their shape (..., 3), None if they are damaged."""
    import zstandard

    size = 4 * math.prod(shape)
    if size > MAX_CHUNK:
        return None
    try:
        # The size is known, so no more than that is ever expanded.
        planes = zstandard.ZstdDecompressor().stream_reader(packed).read(size + 1)
    except zstandard.ZstdError:
        return None
    if len(planes) != size or size % WIDTH:
        return None
    return _turned(np.frombuffer(planes, np.uint8), (WIDTH, BLOCK)).view("<f4").reshape(shape)


def _turned(flat: Bytes, block: tuple[int, int]) -> Bytes:
    """Return each block of bytes, and the shorter rest, with rows and columns exchanged."""
    flat, out = flat.reshape(-1), np.empty(flat.size, dtype=np.uint8)
    whole = len(flat) // (BLOCK * WIDTH) * BLOCK * WIDTH
    rows, columns = block
    out[:whole].reshape(-1, columns, rows)[:] = (
        flat[:whole].reshape(-1, rows, columns).transpose(0, 2, 1)
    )
    rest = (len(flat) - whole) // WIDTH
    rows, columns = (rest if side == BLOCK else side for side in block)
    out[whole:].reshape(columns, rows)[:] = flat[whole:].reshape(rows, columns).T
    return out

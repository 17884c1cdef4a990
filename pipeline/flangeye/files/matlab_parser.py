"""Program that converts a .mat file to .npz, from standard input to standard output.

A damaged file can crash scipy's parser, or let it ask for any memory. Nothing of flangeye is
imported here.
"""

from __future__ import annotations

import io
import resource
import sys
from typing import Any


def main() -> None:
    """Parse, and write the arrays of numbers."""
    memory = 4 << 30  # libraries reserve much that they never use [bytes]
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    import numpy as np
    from scipy.io import loadmat

    values = loadmat(io.BytesIO(sys.stdin.buffer.read())).items()
    numbers = ((n, v) for n, v in values if isinstance(v, np.ndarray) and v.dtype.kind in "iuf")
    # The prefix keeps arrays apart from arguments of savez
    arrays: dict[str, Any] = {"of_" + name: array for name, array in numbers}
    largest = 1 << 28  # [bytes]
    if sum(array.nbytes for array in arrays.values()) > largest:
        raise ValueError(f"its arrays come to more than {largest} bytes")
    out = io.BytesIO()
    np.savez(out, **arrays)
    sys.stdout.buffer.write(out.getvalue())


if __name__ == "__main__":
    try:
        main()
    except Exception as error:  # damaged bytes can break the parser in any way
        sys.exit(str(error) or type(error).__name__)

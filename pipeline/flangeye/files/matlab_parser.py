"""Program that converts a .mat file to .npz, from standard input to standard output.

A damaged file can crash scipy's parser, or let it ask for any memory. Nothing of flangeye is
imported here.
"""

import io
import resource
import sys
from collections.abc import Iterator
from typing import Any


def main() -> None:
    """Convert a .mat file: write its arrays of numbers, those in structures too."""
    memory = 4 << 30  # libraries reserve much that they never use [bytes]
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    import numpy as np
    from scipy.io import loadmat

    values = loadmat(io.BytesIO(sys.stdin.buffer.read())).items()
    numbers = (each for name, value in values for each in _numbers(name, value))
    # The prefix keeps arrays apart from arguments of savez
    arrays: dict[str, Any] = {"of_" + name: array for name, array in numbers}
    largest = 1 << 28  # [bytes]
    if sum(array.nbytes for array in arrays.values()) > largest:
        raise ValueError(f"its arrays come to more than {largest} bytes")
    out = io.BytesIO()
    np.savez(out, **arrays)
    sys.stdout.buffer.write(out.getvalue())


def _numbers(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield each array of numbers with its name; in a structure as ``name.field``."""
    import numpy as np

    kind = getattr(getattr(value, "dtype", None), "kind", "")
    if kind in ("i", "u", "f"):
        yield name, value
    elif kind == "O" and value.size and len({np.shape(each) for each in value.flat}) == 1:
        yield from _numbers(name, np.stack(list(value.flat)))  # a cell array of matrices
    elif kind == "V" and value.dtype.names:
        for field in value.dtype.names:  # of an array of structures, each has one row
            of = value[field]
            yield from _numbers(f"{name}.{field}", of.item() if of.size == 1 else of)


if __name__ == "__main__":
    try:
        main()
    except Exception as error:  # damaged bytes can break the parser in any way
        sys.exit(str(error) or type(error).__name__)

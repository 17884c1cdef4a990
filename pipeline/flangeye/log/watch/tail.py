"""Read a log that is still being written: wait at its end for more."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from typing_extensions import Buffer

from flangeye.errors import StageError
from flangeye.files.regular import open_regular
from flangeye.log.records import Channel, LogFile, Message, NotMcapError

__all__ = ["Channel", "Message", "follow"]


class WaitingFile(io.RawIOBase):
    """A file whose end is not its end: reading waits until there is more."""

    def __init__(self, file: BinaryIO, wait: Callable[[], None]) -> None:
        """Take a file; ``wait`` is called while there is nothing new, and may raise to give up."""
        self._file, self._wait = file, wait

    def readinto(self, buffer: Buffer) -> int:
        """Fill as much of the buffer as there is, and at least a byte."""
        while not (new := self._file.read(len(memoryview(buffer)))):
            self._wait()
        memoryview(buffer)[: len(new)] = new
        return len(new)

    def readable(self) -> bool:
        """Say that it can be read."""
        return True

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


def follow(
    path: Path, wait: Callable[[], None], note: Callable[[str], None] = lambda what: None
) -> Iterator[Message]:
    """Yield the messages of a log from its beginning until the run ends.

    Args:
        path: The log.
        wait: Called while there is nothing new; whatever it raises ends the reading.
        note: Is told of what is damaged.

    Raises:
        StageError: The file cannot be read, or is no MCAP file.
    """

    def damaged(what: str) -> None:
        note(f"damaged: {what}")

    with WaitingFile(open_regular(path), wait) as file:
        try:
            yield from LogFile(damaged).messages(io.BufferedReader(file))
        except NotMcapError:
            raise StageError(f"{path}: is not an MCAP file") from None

"""Read a log that is still being written: wait at its end for more."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from typing_extensions import Buffer

from flangeye.errors import StageError

LARGEST = 1 << 32
"""Largest record that is read [bytes]: a whole scan and room to spare."""


class Channel(NamedTuple):
    """Where messages come from.

    Attributes:
        topic: Its name.
        schema: Name of the messages' schema.
        schema_encoding: ``jsonschema`` or ``protobuf``.
        schema_data: The schema itself.
        encoding: Of the messages: ``json`` or ``protobuf``.
    """

    topic: str
    schema: str
    schema_encoding: str
    schema_data: bytes
    encoding: str


class Message(NamedTuple):
    """One message of a log.

    Attributes:
        channel: Where it comes from.
        time_ns: When it was logged.
        data: Its bytes.
    """

    channel: Channel
    time_ns: int
    data: bytes


class WaitingFile(io.RawIOBase):
    """A file whose end is not its end: reading waits until there is more."""

    def __init__(self, path: Path, wait: Callable[[], None]) -> None:
        """Open it; ``wait`` is called while there is nothing new, and may raise to give up."""
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise StageError(f"{path}: cannot be read: {error.strerror or error}") from None
        self._wait = wait

    def readinto(self, buffer: Buffer) -> int:
        """Fill as much of the buffer as there is, and at least a byte."""
        while not (count := self._file.readinto(buffer)):
            self._wait()
        return count

    def readable(self) -> bool:
        """Say that it can be read."""
        return True

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


def follow(path: Path, wait: Callable[[], None]) -> Iterator[Message]:
    """Yield the messages of a log from its beginning until the run ends.

    Args:
        path: The log.
        wait: Called while there is nothing new; whatever it raises ends the reading.

    Raises:
        StageError: The file cannot be read, or is no MCAP file.
    """
    from mcap.exceptions import McapError
    from mcap.records import Channel as ChannelRecord
    from mcap.records import DataEnd, Schema
    from mcap.records import Message as MessageRecord
    from mcap.stream_reader import StreamReader

    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with WaitingFile(path, wait) as file:
        try:
            for record in StreamReader(file, record_size_limit=LARGEST).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, ChannelRecord):
                    schema = schemas[record.schema_id]
                    channels[record.id] = Channel(
                        record.topic, schema.name, schema.encoding, schema.data,
                        record.message_encoding,
                    )  # fmt: skip
                elif isinstance(record, MessageRecord):
                    yield Message(channels[record.channel_id], record.log_time, record.data)
                elif isinstance(record, DataEnd):
                    return
        except McapError as error:
            raise StageError(f"{path}: is not an MCAP file, or damaged: {error}") from None

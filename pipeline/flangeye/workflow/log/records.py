"""The only reader of log files: checks sizes and CRCs, and skips damaged parts.

A log may be truncated, changed, or from an untrusted source. Checksums of chunks and attachments
and hashes of recipe and result are compared, and a chunk's uncompressed size is limited before it
is decompressed. A damaged part is named and skipped, and reading continues after it.

MCAP's records: https://mcap.dev/spec. The library's own stream reader does not check attachments,
and stops at the first damaged chunk; its parsers of single records are used here.

Whole scans are compressed by a byte shuffle (as in HDF5 and Blosc) and a fast codec. Neighbouring
points share sign, exponent and leading bits, while their last bits are noise. With bytes of equal
significance side by side, the codec compresses the first and skips the last: 70 % of the size
without shuffling, in a third of the time.
"""

from __future__ import annotations

import hashlib
import io
import math
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import IO, TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from flangeye.types import Singles

if TYPE_CHECKING:
    from mcap.records import Chunk

MAX_RECORD = 1 << 30
"""Largest record that is read [bytes]."""
MAX_CHUNK = 1 << 28
"""Largest expanded size of one chunk [bytes], eight times the largest scanner's whole scan."""
SLACK, MAX_RATIO = 1 << 30, 100
"""Limit on the expanded size of all chunks: [bytes], and a multiple of their stored size."""
HASHES = "flangeye.sha256"
"""Name of the metadata record that says an attachment's hash."""


POINTS_AT_ONCE = 2048
"""Number of points shuffled at once: a block fits the processor's first-level cache."""

POINT_BYTES = 12
"""Bytes of a point."""


class Channel(NamedTuple):
    """A message channel: its topic and schema.

    Attributes:
        topic: Name of the topic.
        schema: Name of the messages' schema.
        schema_encoding: ``jsonschema`` or ``protobuf``.
        schema_data: The schema itself.
        encoding: Encoding of the messages: ``json`` or ``protobuf``.
    """

    topic: str
    schema: str
    schema_encoding: str
    schema_data: bytes
    encoding: str


class LogMessage(NamedTuple):
    """One message of a log.

    Attributes:
        channel: Channel of the message.
        time_ns: Time of logging [ns].
        data: Content as bytes.
        number: Index of the message in the log.
    """

    channel: Channel
    time_ns: int
    data: bytes
    number: int


class NotMcapError(ValueError):
    """The file does not begin with the MCAP magic bytes."""


class DamageError(ValueError):
    """A part of a log is damaged; the message says how."""


@dataclass
class LogFile:
    """One pass through a log.

    Attributes:
        damaged: Called with one sentence about each damaged part.
        library: Name of the program that wrote the log.
        attachments: Name -> bytes, of those that are sound.
        ended: Whether the log has its end.
    """

    damaged: Callable[[str], None]
    library: str = ""
    attachments: dict[str, bytes] = field(default_factory=dict)
    ended: bool = False
    _schemas: dict[int, Any] = field(default_factory=dict)
    _channels: dict[int, Channel] = field(default_factory=dict)
    _hashes: dict[str, str] = field(default_factory=dict)
    _messages: int = 0
    _read: int = 0
    _expanded: int = 0
    _crc: int = 0
    _sound: bool = True

    @property
    def may_be_ours(self) -> bool:
        """Return whether the log was written by flangeye, or ends before its header."""
        return self.library.startswith("flangeye") or not self._read

    def messages(self, file: IO[bytes], size: int = MAX_RECORD) -> Iterator[LogMessage]:
        """Yield the messages up to the log's end or its first unreadable part.

        Args:
            file: The log, open at its first byte; a read may wait for more.
            size: Size of the file [bytes], the limit of a record's length; None if unknown.

        Raises:
            NotMcapError: It is not an MCAP file.
        """
        for number, (opcode, body) in enumerate(self._records(file, size)):
            try:
                yield from self._taken(opcode, body)
            except Exception as error:  # damaged bytes can break a parser in any way
                self._sound = False
                self.damaged(f"record {number}: {reason_of(error)}")
            if self.ended:
                break
        self._check_hashes()

    def _records(self, file: IO[bytes], size: int) -> Iterator[tuple[int, bytes]]:
        """Yield (opcode, content); a truncated last record is not damage."""
        magic = b"\x89MCAP0\r\n"
        begin = file.read(len(magic))
        # A shorter file may have been begun just now
        if not magic.startswith(begin):
            raise NotMcapError
        self._crc = zlib.crc32(begin)
        # A record is an opcode (1 byte), the length of its content (8 bytes, little-endian), and
        # the content
        while len(head := file.read(9)) == 9:
            opcode, length = struct.unpack("<BQ", head)
            # A length beyond MAX_RECORD is damage: the magic bytes in its place are reported as
            # such below
            body = file.read(min(length, size)) if length <= MAX_RECORD else magic
            if len(body) < length:
                if body.endswith(magic):  # the end is there, so nothing was being written
                    self._sound = False
                    self.damaged(f"a record says that it has {length} bytes; the rest is not read")
                return
            self._read += 9 + length
            yield opcode, body
            # After the yield, since the record DATA_END is not part of the checksum that it states
            self._crc = zlib.crc32(body, zlib.crc32(head, self._crc))

    def _taken(self, opcode: int, body: bytes) -> Iterator[LogMessage]:
        from mcap import records
        from mcap.data_stream import ReadDataStream
        from mcap.opcode import Opcode

        stream = ReadDataStream(io.BytesIO(body))
        if opcode == Opcode.HEADER:
            self.library = records.Header.read(stream).library
        elif opcode == Opcode.CHUNK:
            yield from self._of_chunk(records.Chunk.read(stream))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            yield from self._flat(opcode, body)
        elif opcode == Opcode.ATTACHMENT:
            self._attach(records.Attachment.read(stream), body)
        elif opcode == Opcode.METADATA:
            metadata = records.Metadata.read(stream)
            if metadata.name == HASHES:
                self._hashes.update(metadata.metadata)
        elif opcode == Opcode.DATA_END:
            # 0 means that the writer computed no checksum (MCAP specification)
            if self._sound and records.DataEnd.read(stream).data_section_crc not in (0, self._crc):
                raise DamageError("the log's checksum does not match: it was changed or damaged")
        elif opcode == Opcode.FOOTER:
            self.ended = True

    def _flat(self, opcode: int, body: bytes) -> Iterator[LogMessage]:
        """Process a record that may be inside a chunk."""
        from mcap import records
        from mcap.data_stream import ReadDataStream
        from mcap.opcode import Opcode

        stream = ReadDataStream(io.BytesIO(body))
        if opcode == Opcode.SCHEMA:
            schema = records.Schema.read(stream)
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = records.Channel.read(stream)
            schema = self._schemas.get(channel.schema_id)
            name, encoding, described = (
                (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
            )
            self._channels[channel.id] = Channel(
                channel.topic, name, encoding, described, channel.message_encoding
            )
        elif opcode == Opcode.MESSAGE:
            message = records.Message.read(stream, len(body))
            self._messages += 1
            if message.channel_id not in self._channels:
                raise DamageError(f"message {self._messages - 1} is of no channel")
            yield LogMessage(
                self._channels[message.channel_id],
                message.log_time,
                message.data,
                self._messages - 1,
            )

    def _of_chunk(self, chunk: Chunk) -> Iterator[LogMessage]:
        content = memoryview(self._expand(chunk))
        at = 0
        while at < len(content):
            if at + 9 > len(content):
                raise DamageError("a chunk ends in the middle of a record")
            opcode, length = struct.unpack_from("<BQ", content, at)
            if at + 9 + length > len(content):
                raise DamageError("a chunk ends in the middle of a record")
            yield from self._flat(opcode, bytes(content[at + 9 : at + 9 + length]))
            at += 9 + length

    def _expand(self, chunk: Chunk) -> bytes:
        # Both limits are checked before anything expands: a few bytes may stand for terabytes
        if chunk.uncompressed_size > MAX_CHUNK:
            raise DamageError(
                f"a chunk says that it expands to {chunk.uncompressed_size} bytes; at most "
                f"{MAX_CHUNK} are read"
            )
        self._expanded += chunk.uncompressed_size
        if self._expanded > SLACK + MAX_RATIO * self._read:
            raise DamageError(f"the log expands to more than {MAX_RATIO} times its size")
        content = _decompressed(chunk)
        if len(content) != chunk.uncompressed_size:
            raise DamageError("a chunk does not expand to the size that it states")
        if chunk.uncompressed_crc not in (0, zlib.crc32(content)):
            raise DamageError("a chunk's checksum does not match: it was changed or damaged")
        return content

    def _attach(self, attachment: Any, body: bytes) -> None:
        # The last four bytes of the record are its CRC-32; 0 if there is none
        stated = int.from_bytes(body[-4:], "little")
        if stated not in (0, zlib.crc32(body[:-4])):
            raise DamageError(
                f"the checksum of the attached {attachment.name} does not match: it was changed "
                "or damaged"
            )
        self.attachments[attachment.name] = attachment.data

    def _check_hashes(self) -> None:
        for name, stated in self._hashes.items():
            data = self.attachments.get(name)
            if data is not None and hashlib.sha256(data).hexdigest() != stated:
                del self.attachments[name]
                self.damaged(f"the hash of the attached {name} does not match: it was changed")


def _decompressed(chunk: Chunk) -> bytes:
    """Return at most one byte more than the chunk states."""
    limit = chunk.uncompressed_size + 1
    if chunk.compression == "zstd":
        import zstandard

        # A frame states the window that its decoder has to allocate, up to gigabytes
        with zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK).stream_reader(
            chunk.data
        ) as reader:
            return reader.read(limit)
    if chunk.compression == "lz4":
        import lz4.frame

        data: bytes = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=limit)
        return data
    if chunk.compression:
        raise DamageError(f"a chunk is compressed with '{chunk.compression}'; zstd or lz4 are read")
    return chunk.data


def reason_of(error: Exception) -> str:
    """Return the fault of foreign content as one short line, without quoting it."""
    if isinstance(error, KeyError):
        return f"it lacks {error}"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, UnicodeDecodeError):
        return "it is not UTF-8 text"
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        return ": ".join(filter(None, (where, first["msg"].removeprefix("Value error, "))))[:200]
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[0] if lines else type(error).__name__)[:200]


Bytes = NDArray[np.uint8]


def pack(xyz: Singles) -> bytes:
    """Return points (..., 3) in few bytes, bit for bit."""
    import zstandard

    flat = np.ascontiguousarray(xyz, dtype="<f4").reshape(-1).view(np.uint8)
    planes = b"".join(block.reshape(-1, POINT_BYTES).T.tobytes() for block in _blocks(flat))
    # of zstandard: the fast levels lose three hundredths of the size
    return zstandard.compress(planes, level=-8)


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
    if len(planes) != size or size % POINT_BYTES:
        return None
    blocks = _blocks(np.frombuffer(planes, np.uint8))
    points = np.concatenate([block.reshape(POINT_BYTES, -1).T.ravel() for block in blocks])
    return points.view("<f4").reshape(shape)


def _blocks(flat: Bytes) -> list[Bytes]:
    """Return the bytes of so many points at once, the last block the rest."""
    block = POINTS_AT_ONCE * POINT_BYTES
    return np.split(flat, range(block, len(flat), block))

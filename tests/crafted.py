"""Damaged and hostile logs, made out of a sound one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

Change = Callable[[str, bytes], tuple[str, bytes]]
"""Takes a topic, or an attachment's name, and its bytes; gives both as they shall be."""


def rewritten(
    source: Path, target: Path, change: Change, library: str = "flangeye", codec: str = "zstd"
) -> Path:
    """Copy a log with every CRC valid again, each message and attachment as `change` has it."""
    with source.open("rb") as stream, target.open("wb") as out:
        reader = make_reader(stream)
        writer = Writer(out, compression=CompressionType[codec.upper()])
        known: dict[str, int] = {}
        writer.start(library=library)
        for schema, channel, message in reader.iter_messages():
            topic, data = change(channel.topic, message.data)
            if topic not in known:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[topic] = writer.register_channel(topic, channel.message_encoding, number)
            writer.add_message(known[topic], message.log_time, data, message.publish_time)
        for item in reader.iter_attachments():
            name, data = change(item.name, item.data)
            writer.add_attachment(item.create_time, item.log_time, name, item.media_type, data)
        writer.finish()
    return target


def only(which: str, data: bytes | None = None, name: str | None = None) -> Change:
    """Change the one topic or attachment of that name."""
    return lambda n, d: (name or n, d if data is None else data) if n == which else (n, d)


def bomb(target: Path, size: int) -> Path:
    """Write a log of one message of so many zeros, in one chunk."""
    with target.open("wb") as out:
        writer = Writer(out, chunk_size=1, compression=CompressionType.ZSTD)
        writer.start(library="flangeye")
        schema = writer.register_schema("flangeye.Source", "jsonschema", b"{}")
        channel = writer.register_channel("/source", "json", schema)
        writer.add_message(channel, 0, bytes(size), 0)
        writer.finish()
    return target

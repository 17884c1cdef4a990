"""What of a log is read and what is refused, by files made byte by byte.

The bounds stand here as numbers: a test that took them from the code would follow any change of it.
"""

from __future__ import annotations

import hashlib
import io
import struct
import zlib
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel, ValidationError, create_model

from flangeye.errors import StageError
from flangeye.workflow.log.read import decode_json, is_log, read_run
from flangeye.workflow.log.records import LogFile, NotMcapError, reason_of

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 1, 2, 3, 4, 5, 6
ATTACHMENT, METADATA, DATA_END = 9, 12, 15


def record(opcode: int, body: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(body) if length is None else length) + body


def text(words: str) -> bytes:
    return struct.pack("<I", len(words)) + words.encode()


def header(library: str = "flangeye 1") -> bytes:
    return record(HEADER, text("") + text(library))


def channel(number: int = 1, schema: int = 0) -> bytes:
    nothing = struct.pack("<I", 0)
    return record(
        CHANNEL, struct.pack("<HH", number, schema) + text("/note") + text("json") + nothing
    )


def message(data: bytes, of: int = 1, time_ns: int = 5) -> bytes:
    return record(MESSAGE, struct.pack("<HIQQ", of, 0, time_ns, time_ns) + data)


def chunk(
    content: bytes, size: int | None = None, crc: int | None = None, codec: str = ""
) -> bytes:
    """Return a chunk of records that states so a size and such a checksum."""
    size = len(content) if size is None else size
    crc = zlib.crc32(content) if crc is None else crc
    begins = struct.pack("<QQQI", 0, 0, size, crc)
    return record(CHUNK, begins + text(codec) + struct.pack("<Q", len(content)) + content)


def attachment(name: str, data: bytes, crc: int | None = None) -> bytes:
    body = struct.pack("<QQ", 0, 0) + text(name) + text("text/plain")
    body += struct.pack("<Q", len(data)) + data
    return record(ATTACHMENT, body + struct.pack("<I", zlib.crc32(body) if crc is None else crc))


def hashes(**of: str) -> bytes:
    pairs = b"".join(text(name) + text(digest) for name, digest in of.items())
    return record(METADATA, text("flangeye.sha256") + struct.pack("<I", len(pairs)) + pairs)


def end(crc: int = 0) -> bytes:
    return record(DATA_END, struct.pack("<I", crc)) + record(FOOTER, bytes(20)) + MAGIC


def read(*parts: bytes, size: int | None = None) -> tuple[LogFile, list[bytes], list[str]]:
    """Return what a log's reader knows in the end, the messages' data, and what it says."""
    damage: list[str] = []
    log, raw = LogFile(damage.append), MAGIC + b"".join(parts)
    given = {} if size is None else {"size": size}
    return log, [each.data for each in log.messages(io.BytesIO(raw), **given)], damage


def test_a_log_is_read_with_its_numbers_times_and_channel() -> None:
    log = LogFile(pytest.fail)
    raw = MAGIC + header() + channel() + message(b"a", time_ns=3) + chunk(message(b"b", time_ns=4))
    found = list(log.messages(io.BytesIO(raw + end())))
    assert [(each.number, each.time_ns, each.data) for each in found] == [
        (0, 3, b"a"),
        (1, 4, b"b"),
    ]
    assert (found[0].channel.topic, found[0].channel.encoding) == ("/note", "json")
    assert (log.library, log.ended, log.may_be_ours) == ("flangeye 1", True, True)


def test_what_is_no_log_is_refused_and_one_that_just_begins_is_not() -> None:
    for begins in (b"", MAGIC[:3], MAGIC):
        log = LogFile(pytest.fail)
        assert list(log.messages(io.BytesIO(begins))) == []
        assert log.may_be_ours and not log.ended
    for other in (b"PK\x03\x04....", b"\x89MCAP1\r\n", MAGIC[1:]):
        with pytest.raises(NotMcapError):
            list(LogFile(pytest.fail).messages(io.BytesIO(other)))
    log, _, _ = read(header("libmcap 1"))
    assert not log.may_be_ours


def test_nothing_is_read_behind_the_end() -> None:
    _, found, damage = read(header(), channel(), end(), message(b"behind"))
    assert found == [] and damage == []


@pytest.mark.parametrize("cut", range(1, 32))
def test_a_message_that_was_being_written_is_no_damage(cut: int) -> None:
    last = message(b"last")
    _, found, damage = read(header(), channel(), message(b"first"), last[:-cut])
    assert found == [b"first"] and damage == []


def test_a_record_longer_than_its_log_is_damage_where_the_log_has_its_end() -> None:
    _, found, damage = read(
        header(), channel(), message(b"first"), record(MESSAGE, b"", 999), end(), size=500
    )
    assert found == [b"first"]
    assert damage == ["a record says that it has 999 bytes; the rest is not read"]


@pytest.mark.parametrize(("length", "told"), [(1 << 30, 0), ((1 << 30) + 1, 1), (1 << 60, 1)])
def test_a_record_of_more_than_a_gigabyte_is_not_waited_for(length: int, told: int) -> None:
    _, found, damage = read(
        header(), channel(), message(b"first"), record(MESSAGE, b"more", length), size=100
    )
    assert found == [b"first"]
    assert damage == told * [f"a record says that it has {length} bytes; the rest is not read"]


@pytest.mark.parametrize(("by", "told"), [(0, []), (1, ["the log's checksum does not match"])])
def test_the_checksum_of_a_log_is_compared(by: int, told: list[str]) -> None:
    body = header() + channel() + message(b"a")
    _, found, damage = read(body, end(zlib.crc32(MAGIC + body) ^ by))
    assert found == [b"a"]
    assert [said.partition(": ")[2].partition(":")[0] for said in damage] == told
    _, _, damage = read(header(), channel(), message(b"a"), end(0))  # none is stated
    assert damage == []


def test_a_log_of_which_a_part_is_known_to_be_damaged_is_not_blamed_twice() -> None:
    _, found, damage = read(header(), channel(), message(b"a", of=7), message(b"b"), end(123))
    assert found == [b"b"]
    assert damage == ["record 2: message 0 is of no channel"]


def test_a_damaged_chunk_is_named_by_its_number_and_the_next_is_read() -> None:
    for bad, why in (
        (
            chunk(message(b"x"), crc=1),
            "a chunk's checksum does not match: it was changed or damaged",
        ),
        (chunk(message(b"x"), size=99), "a chunk does not expand to the size that it states"),
        (chunk(message(b"x")[:-1]), "a chunk ends in the middle of a record"),
        (chunk(message(b"x")[:8]), "a chunk ends in the middle of a record"),
        (
            chunk(message(b"x"), codec="rar"),
            "a chunk is compressed with 'rar'; zstd or lz4 are read",
        ),
    ):
        log, found, damage = read(header(), channel(), bad, chunk(message(b"y")), end())
        assert found == [b"y"] and log.ended
        assert damage == [f"record 2: {why}"]
    _, found, damage = read(header(), channel(), chunk(message(b"x"), crc=0), end())
    assert found == [b"x"] and damage == []  # without a checksum there is nothing to compare
    _, found, damage = read(header(), channel(), chunk(message(b"x") + record(200, b"")))
    assert found == [b"x"] and damage == []  # an empty record, of a kind to come, ends the chunk


@pytest.mark.parametrize(
    ("size", "why"),
    [
        (1 << 28, "a chunk does not expand to the size that it states"),
        ((1 << 28) + 1, "a chunk says that it expands to 268435457 bytes; at most 268435456 are"),
    ],
)
def test_a_chunk_that_would_expand_to_more_is_not_expanded(size: int, why: str) -> None:
    _, _, (damage,) = read(header(), channel(), chunk(b"", size=size))
    assert damage.startswith(f"record 2: {why}")


@pytest.mark.parametrize(
    ("by", "why"),
    [
        (0, "a chunk does not expand to the size that it states"),
        (1, "the log expands to more than 100 times its size"),
    ],
)
def test_all_chunks_together_expand_to_a_hundred_times_the_log_and_a_gigabyte(
    by: int, why: str
) -> None:
    begins = [header(), channel(), *(4 * [chunk(b"", size=1 << 28)])]
    last = chunk(b"", size=0)
    size = 100 * (len(b"".join(begins)) + len(last)) + by
    _, _, damage = read(*begins, chunk(b"", size=size))
    assert len(damage) == 5
    assert damage[-1] == f"record 6: {why}"


def test_attachments_are_compared_with_their_checksums_and_hashes() -> None:
    good, changed = b"title: T", b"title: U"
    digest = hashlib.sha256(good).hexdigest()
    stated = {"a": digest, "b": digest, "missing": digest}
    log, _, damage = read(
        header(), attachment("a", good), attachment("b", changed), attachment("c", good, crc=0),
        attachment("d", good, crc=5), hashes(**stated), end(),
    )  # fmt: skip
    assert log.attachments == {"a": good, "c": good}
    assert damage == [
        "record 4: the checksum of the attached d does not match: it was changed or damaged",
        "the hash of the attached b does not match: it was changed",
    ]


def test_a_channel_knows_its_schema_if_there_is_one() -> None:
    schema = struct.pack("<H", 3) + text("flangeye.Note") + text("jsonschema") + text("{}")
    log = LogFile(pytest.fail)
    raw = MAGIC + header() + record(SCHEMA, schema) + channel(1, 3) + channel(2, 4)
    found = list(log.messages(io.BytesIO(raw + message(b"x", 1) + message(b"y", 2))))
    told: Any = [each.channel[1:4] for each in found]
    assert told == [("flangeye.Note", "jsonschema", b"{}"), ("", "", b"")]


def test_a_message_that_is_cut_inside_is_named_and_the_others_are_read() -> None:
    _, found, damage = read(header(), channel(), record(MESSAGE, b"\1"), message(b"b"))
    assert found == [b"b"]
    assert len(damage) == 1 and damage[0].startswith("record 2: ")
    assert len(damage[0]) < 250


def test_a_log_of_another_program_is_told_from_one_of_ours_that_just_begins(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(MAGIC + header("libmcap 1") + channel() + message(b"a") + end())
    with pytest.raises(StageError, match="run.mcap: is an MCAP file, but not a log of flangeye$"):
        read_run(path)
    path.write_bytes(MAGIC + header("flangeye 1") + channel() + message(b"a"))
    assert read_run(path).source is None
    path.write_bytes(MAGIC + header("libmcap 1") + attachment("recipe.yaml", b"title: T") + end())
    assert read_run(path).text("recipe.yaml") == "title: T"


@pytest.mark.parametrize(
    ("name", "begins", "may_be"),
    [
        ("run.mcap", MAGIC + header(), True),
        ("run.mcap", b"damaged", True),
        ("run.mcap", MAGIC + header("libmcap 1"), False),
        ("run.mcap", MAGIC + header("libmcap 1") + 55 * b" " + b"flangeye", False),
        ("run.bag", MAGIC + header(), False),
    ],
)
def test_a_file_may_be_a_log_of_ours_by_its_name_and_first_bytes(
    tmp_path: Path, name: str, begins: bytes, may_be: bool
) -> None:
    assert not is_log(tmp_path / name)
    (tmp_path / name).write_bytes(begins)
    assert is_log(tmp_path / name) is may_be


def test_a_message_of_more_than_16_mb_is_not_decoded() -> None:
    most = b"{}".ljust(1 << 24)
    assert decode_json(most) == {}
    with pytest.raises(ValueError, match="^it has 16777217 bytes; at most 16777216 are read$"):
        decode_json(most + b" ")


def test_what_is_wrong_is_one_short_line() -> None:
    class Strict(BaseModel):
        value: int

    assert reason_of(ValueError("a" * 300)) == "a" * 200
    assert reason_of(ValueError("\n  first \n second")) == "first"
    assert reason_of(ValueError()) == "ValueError"
    assert reason_of(KeyError("name")) == "it lacks 'name'"
    assert reason_of(RecursionError()) == "it is nested too deeply"
    assert reason_of(UnicodeDecodeError("utf-8", b"x", 0, 1, "why")) == "it is not UTF-8 text"
    with pytest.raises(ValidationError) as error:
        Strict.model_validate({"value": "x"})
    assert reason_of(error.value).startswith("value: Input should be a valid integer")
    fields: dict[str, Any] = {"n" * 300: (int, ...)}
    with pytest.raises(ValidationError) as error:
        create_model("Long", **fields).model_validate({})
    assert len(reason_of(error.value)) == 200

"""A folder, here or by URL, to which many processes write."""

from pathlib import Path
from typing import Any

import pytest

from flangeye.errors import StageError
from flangeye.files.paths import storage_at


@pytest.mark.parametrize("elsewhere", [False, True], ids=["here", "elsewhere"])
def test_files_are_written_whole_read_listed_and_removed(
    tmp_path: Path, request: pytest.FixtureRequest, elsewhere: bool
) -> None:
    if elsewhere:
        request.getfixturevalue("bucket")
    place = storage_at("s3://cell/monday/" if elsewhere else str(tmp_path))
    assert place.read("a/b") is None and place.names("a") == []
    place.write("a/b", b"1")
    place.write("a/b", b"2")
    with place.draft("a/c") as path:
        path.write_bytes(b"3")
        assert place.read("a/c") is None and place.names("a") == ["a/b"]
    assert (place.read("a/b"), place.read("a/c")) == (b"2", b"3")
    assert place.names("a") == ["a/b", "a/c"]
    place.remove("a/b")
    place.remove("a/b")
    assert place.names("a") == ["a/c"]
    place.remove("a")
    assert place.names("a") == [] and list(tmp_path.iterdir()) == []


def test_what_cannot_be_written_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StageError) as caught:
        storage_at(str(tmp_path)).write("file/b/a", b"")
    assert str(caught.value) == f"{tmp_path}/file/b/a: cannot be written: Not a directory"
    (tmp_path / "folder").mkdir()
    with pytest.raises(StageError, match="folder: cannot be written: Is a directory"):
        storage_at(str(tmp_path)).write("folder", b"")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


def test_a_store_that_cannot_be_reached_is_one_line(
    monkeypatch: pytest.MonkeyPatch, bucket: Any
) -> None:
    with pytest.raises(StageError, match=r"^s3://nobody-s/a: cannot be reached: .*$"):
        storage_at("s3://nobody-s").write("a", b"")
    with pytest.raises(StageError, match=r"ftp:// is not supported; known: s3://, "):
        storage_at("ftp://host/a")

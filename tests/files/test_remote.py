"""Archives and results by URL: a real client and a real server, on loopback."""

import json
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from flangeye.cli import commands
from flangeye.errors import StageError
from flangeye.files.clouds import read_cloud, write_cloud
from flangeye.files.remote import (
    archive_at,
    at_hand,
    is_remote,
    is_url,
    remote_digest,
    remote_fingerprint,
    results_at,
    with_urls,
)
from flangeye.types import CAMERA, PointCloud

s3fs = pytest.importorskip("s3fs")
pytest.importorskip("moto.server")


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """A folder with two scans beyond what is fetched at once, and a file of poses."""
    folder = tmp_path / "archive"
    (folder / "scans").mkdir(parents=True)
    for i in range(2):
        xyz = np.full((300, 400, 3), 0.5 + i, dtype=np.float32)
        write_cloud(folder / "scans" / f"{i}.pcd", PointCloud(CAMERA, xyz))
    (folder / "poses.csv").write_text("cloud\n")
    return folder


@contextmanager
def folder_at(where: str) -> Iterator[Path]:
    """The archive's path, which only an archive that nobody named has not."""
    with archive_at(where) as root:
        assert root is not None
        yield root


def test_scans_are_fetched_one_at_a_time_and_let_go(bucket: Any, archive: Path) -> None:
    bucket.put(f"{archive}/", "cell/monday/", recursive=True)
    with folder_at("s3://cell/monday") as root:
        assert (root / "poses.csv").read_text() == "cloud\n"
        for i in range(2):
            scan = root / "scans" / f"{i}.pcd"
            assert is_remote(scan) and scan.stat().st_size == 0
            assert read_cloud(scan).xyz[0, 0, 0] == 0.5 + i
            assert scan.stat().st_size == 0
        assert with_urls(f"{root}/scans") == "s3://cell/monday/scans"
    assert not root.exists()


def test_two_equal_scans_have_one_digest_and_a_changed_one_another_print(
    bucket: Any, archive: Path
) -> None:
    shutil.copy(archive / "scans" / "0.pcd", archive / "scans" / "2.pcd")
    bucket.put(f"{archive}/", "cell/monday/", recursive=True)
    with folder_at("s3://cell/monday") as root:
        digests = [remote_digest(root / "scans" / f"{i}.pcd") for i in range(3)]
    assert digests[0] == digests[2] != digests[1]
    before = remote_fingerprint("s3://cell/monday")
    assert remote_fingerprint("s3://cell/monday") == before
    bucket.pipe("cell/monday/poses.csv", b"other\n")
    assert remote_fingerprint("s3://cell/monday") != before


def test_an_archive_in_a_zip_file(archive: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "monday.zip", "w") as packed:
        for file in archive.rglob("*.*"):
            packed.write(file, file.relative_to(archive))
    with folder_at(f"zip://::{tmp_path}/monday.zip") as root:
        assert read_cloud(root / "scans" / "1.pcd").xyz[0, 0, 0] == 1.5


def test_an_archive_that_is_one_file(bucket: Any, tmp_path: Path) -> None:
    bucket.pipe("cell/run.mcap", b"a log")
    with archive_at("s3://cell/run.mcap") as path:
        assert path.name == "run.mcap" and path.read_bytes() == b"a log"


def test_results_are_sent_at_the_end_whatever_ended_the_run(bucket: Any) -> None:
    with (
        pytest.raises(StageError, match="s3://cell/out/run.mcap"),
        results_at("s3://cell/out") as out,
    ):
        assert out is not None
        out.mkdir()
        (out / "run.mcap").write_bytes(b"log")
        raise StageError(f"{out / 'run.mcap'}: torn")
    assert bucket.cat("cell/out/run.mcap") == b"log"
    with pytest.raises(StageError) as caught, results_at("s3://cell/out"):
        pass
    assert str(caught.value) == "s3://cell/out: already holds files; name a new or empty folder"


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("github://a:b@c/", "github://a:b@c/: github:// is not supported; known: s3://, gs://, az://, "
         "https://, zip://"),
        ("zip://x::reference://y", "zip://x::reference://y: reference:// is not supported; known: s3://, "
         "gs://, az://, https://, zip://"),
        ("s3://cell/nothing", "s3://cell/nothing: holds nothing"),
    ],
)  # fmt: skip
def test_what_cannot_be_opened_is_one_line(bucket: Any, url: str, message: str) -> None:
    with pytest.raises(StageError) as caught, archive_at(url):
        pass
    assert str(caught.value) == message


def test_a_store_that_does_not_answer_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "nobody")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "nothing")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    s3fs.S3FileSystem.clear_instance_cache()
    with pytest.raises(StageError) as caught, archive_at("s3://cell/x"):
        pass
    assert str(caught.value).startswith("s3://cell/x: cannot be reached: ")
    assert "\n" not in str(caught.value)


def test_a_name_that_leads_out_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "bad.zip", "w") as packed:
        packed.writestr("../../escaped.csv", "x")
    url = f"zip://::{tmp_path}/bad.zip"
    with pytest.raises(StageError, match="leads out of it"), archive_at(url):
        pass
    assert not list(Path(tmp_path).rglob("escaped.csv"))


def test_a_path_is_a_path(tmp_path: Path) -> None:
    assert not is_url("C:\\data") and not is_url("a/b") and is_url("s3://a")
    with folder_at(str(tmp_path)) as path, at_hand(path):
        assert path == tmp_path
    with archive_at(None) as nothing, results_at(None) as none:
        assert nothing is None and none is None


def test_a_run_from_a_bucket_into_a_bucket_has_the_result_of_one_on_disk(
    bucket: Any, tmp_path: Path
) -> None:
    sample = Path(__file__).parents[2] / "data" / "samples" / "ur5_phoxi-m"
    bucket.put(f"{sample}/", "cell/sample/", recursive=True)
    words = ["run", "ur5_phoxi-m_sample", "--archive"]
    for archive, out in (
        (str(sample), str(tmp_path / "run")),
        ("s3://cell/sample", "s3://cell/out"),
    ):
        done = CliRunner().invoke(commands(), [*words, archive, "--out", out])
        assert done.exit_code == 0, done.output
    assert "flangeye show s3://cell/out" in done.output
    here = json.loads((tmp_path / "run" / "result.json").read_text())
    there = json.loads(bucket.cat("cell/out/result.json"))
    assert here["transforms"] == there["transforms"]
    assert b"s3://cell/sample" in bucket.cat("cell/out/report.html")
    assert b"/flangeye-" not in bucket.cat("cell/out/report.html")

"""A batch whose folder is a bucket: workers write to it, and a second start goes on from it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("s3fs")


def test_a_batch_in_a_bucket_and_its_second_start(
    flangeye: Callable[..., Any], recipe: Path, bucket: Any, tmp_path: Path
) -> None:
    words = ("batch", recipe, "--workers", "1", "--out", "s3://cell/out/", "--no-report")
    code, out, err = flangeye(*words, "--set-grid", "steps.3.what=work,refuse,fail")
    assert code == 1, err
    assert out.startswith("3 sessions: 1 verified, 1 refused, 1 failed\n")
    assert out.endswith("s3://cell/out/: summary.html  sessions.csv  sessions.parquet\n")
    found = {path.removeprefix("cell/out/") for path in bucket.find("cell/out")}
    assert {name for name in found if name.count("/") == 0} == {"sessions.csv", "summary.html"}
    assert "sessions.parquet/000000.parquet" in found
    markers = [name for name in found if name.endswith("/session.json")]
    assert len(markers) == 2 and not any(name.startswith(".starts") for name in found)
    assert f"{markers[0].partition('/')[0]}/result.json" in found
    assert [path.name for path in tmp_path.iterdir()] == ["toy.yaml"]

    grid = ("--set-grid", "steps.3.what=work,refuse")
    code, out, _ = flangeye(*words, *grid)
    assert out.startswith("2 sessions: 1 verified, 1 refused (2 of them finished earlier)\n")

    bucket.rm("cell/out/sessions.parquet", recursive=True)  # each session's folder knows it too
    code, out, _ = flangeye(*words, *grid)
    assert out.startswith("2 sessions: 1 verified, 1 refused\n")
    assert bucket.exists("cell/out/sessions.parquet/000000.parquet")

"""A run is gone on with from a bucket: a real client and a real server, on loopback."""

from typing import Any

from tests.conftest import Call


def test_a_run_in_a_bucket_is_gone_on_with(done: Call, bucket: Any) -> None:
    bucket.put("done/", "cell/done/", recursive=True)
    words = ("--resume", "s3://cell/done", "--retake", "003", "--out", "s3://cell/again")
    code, _, err = done("run", *words)
    assert code == 0, err
    assert bucket.exists("cell/again/run.mcap") and bucket.exists("cell/again/result.json")

    code, _, err = done("run", "--resume", "s3://cell/done/run.mcap")
    line = "s3://cell/done/run.mcap: this run is complete; there is nothing to resume "
    assert code == 2
    assert err.splitlines()[-1] == f"error: {line}(--retake ID takes a capture again)"

    code, _, err = done("run", "--resume", "s3://cell/none")
    assert code == 2
    assert err.splitlines()[-1].startswith("error: s3://cell/none: ")

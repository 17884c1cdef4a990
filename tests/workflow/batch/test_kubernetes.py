"""The Kubernetes manifests: sound by the API's own schema, and their commands run on loopback."""

import csv
import os
import shutil
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.workflow.batch.test_batch import PATIENCE, running

MANIFESTS = Path(__file__).parents[3] / "docs/examples/kubernetes.yaml"
DOCUMENTS: list[dict[str, Any]] = list(yaml.safe_load_all(MANIFESTS.read_text()))
PROGRAMS = {
    "dask": [sys.executable, "-m", "dask"],
    "flangeye": [sys.executable, "-m", "flangeye.cli"],
}


def named(document: dict[str, Any]) -> str:
    return f"{document['kind']} {document['metadata']['name']}"


def pods() -> dict[str, dict[str, Any]]:
    """Return each container by its name."""
    specs = [d["spec"]["template"]["spec"] for d in DOCUMENTS if "template" in d["spec"]]
    return {container["name"]: container for spec in specs for container in spec["containers"]}


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_the_manifests_are_what_kubernetes_takes(document: dict[str, Any]) -> None:
    validate = pytest.importorskip("kubernetes_validate").validate
    validate(document, "1.30", strict=True)


def test_a_misspelt_key_would_be_found() -> None:
    kubernetes_validate = pytest.importorskip("kubernetes_validate")
    wrong = DOCUMENTS[1] | {"spec": DOCUMENTS[1]["spec"] | {"port": []}}
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(wrong, "1.30", strict=True)


def test_the_containers_commands_run_a_batch_over_tls(recipe: Path, tmp_path: Path) -> None:
    """Two processes and the batch, as the pods would run them: their commands, and their settings."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    made = next(line for line in MANIFESTS.read_text().splitlines() if "openssl req" in line)
    subprocess.run(made.lstrip("# ").split(), check=True, cwd=tmp_path, capture_output=True)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    whole = {"8786": str(port), "ur5_phoxi-m_simulated": str(recipe), "1000": "3"}
    parts = {"flangeye-scheduler:8786": f"127.0.0.1:{port}", "/tls/": f"{tmp_path}/",
             "/data/": f"{tmp_path}/"}  # fmt: skip

    def here(word: str) -> str:
        for there, at in parts.items():
            word = word.replace(there, at)
        return whole.get(word, word)

    def command(name: str) -> list[str]:
        program, *words = pods()[name]["command"]
        return [*PROGRAMS[program], *map(here, words)]

    def settings(name: str) -> dict[str, str]:
        return os.environ | {e["name"]: e["value"] for e in pods()[name].get("env", [])}

    def batch(words: list[str]) -> subprocess.CompletedProcess[str]:
        return subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE, check=False)

    with ExitStack() as stack:
        for name in ("scheduler", "worker"):
            stack.enter_context(running(command(name), env=settings(name)))
        wait_for(port)
        refused = batch(command("batch")[:-6])  # without the certificates
        told = batch(command("batch"))
    assert told.returncode == 0, told.stderr
    with (tmp_path / "batch" / "sessions.csv").open(newline="") as file:
        assert [row["status"] for row in csv.DictReader(file)] == ["verified"] * 3
    assert refused.returncode == 2
    assert "no dask scheduler answers there" in refused.stderr


def wait_for(port: int) -> None:
    """Wait until something listens there."""
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
            return
        except OSError:
            assert time.monotonic() < deadline
            time.sleep(0.1)

"""A server of the pages in a folder of its own, and a browser without a network."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.chromium import chromium


@dataclass
class Served:
    """A running ``flangeye ui``."""

    folder: Path
    address: str
    port: int
    process: subprocess.Popen


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def serve(folder: Path) -> Served:
    port = free_port()
    words = ["ui", str(folder), "--port", str(port), "--no-browser"]
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTEST", "NICEGUI"))}
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "flangeye.cli", *words],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment,
    )  # fmt: skip
    assert process.stdout is not None
    for line in process.stdout:
        if found := re.match(r"open (\S+)", line):
            wait_for(port)
            return Served(folder, found[1], port, process)
    raise AssertionError("the server did not start")


def wait_for(port: int) -> None:
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.1)
    raise AssertionError(f"nothing listens on {port}")


def ended(served: Served) -> None:
    served.process.send_signal(signal.SIGINT)
    try:
        served.process.wait(10)
    except subprocess.TimeoutExpired:
        served.process.kill()
        served.process.wait(10)
    if served.process.stdout:
        served.process.stdout.close()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """One server for the module, in a folder that is empty at first."""
    pytest.importorskip("nicegui", reason="nicegui is not installed")
    running = serve(tmp_path_factory.mktemp("cell"))
    yield running
    ended(running)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium("127.0.0.1") as launched:
        yield launched

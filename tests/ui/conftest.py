"""A server of the pages in a folder of its own, and a browser without a network."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.chromium import chromium


@dataclass
class Served:
    """A running ``flangeye ui``, and what its terminal says."""

    folder: Path
    port: int
    process: subprocess.Popen
    said: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as lines:
            for line in lines:
                self.said.append(line.rstrip())

    def last(self, pattern: str) -> str:
        """Return what a pattern finds in the newest line of the terminal that has it."""
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and self.process.poll() is None:
            for line in reversed(self.said):
                if found := re.search(pattern, line):
                    return found[1]
            time.sleep(0.05)
        raise AssertionError(f"the terminal does not show {pattern}: {self.said}")

    @property
    def address(self) -> str:
        """The address that lets the next browser in."""
        return self.last(r"(http://\S+\?token=\S+)")

    def code(self) -> str:
        """Return the code of the move that was asked for last."""
        return self.last(r"^code (\d{6}) moves the arm: ")


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
    served = Served(folder, port, process)
    assert served.address
    wait_for(port)
    return served


def wait_for(port: int) -> None:
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.1)
    raise AssertionError(f"nothing listens on {port}")


def ended(served: Served) -> None:
    served.process.terminate()  # nothing is left behind then either
    try:
        served.process.wait(10)
    except subprocess.TimeoutExpired:
        served.process.kill()
        served.process.wait(10)
    else:
        assert not list(served.folder.glob("open_*.html"))


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


@pytest.fixture(autouse=True)
def closed(request: pytest.FixtureRequest) -> Iterator[None]:
    """Close a test's pages when it ends: each draws its scene as long as it stands open."""
    yield
    if "browser" in request.fixturenames:
        for context in request.getfixturevalue("browser").contexts:
            context.close()

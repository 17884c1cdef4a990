"""Chromium as the tests start it: without a screen, without a network."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--no-first-run",
)  # fmt: skip


@contextmanager
def chromium(reachable: str = "") -> Iterator[Any]:
    """Start a browser that finds no host but ``reachable``; skip where there is none."""
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("no chromium on this machine: apt-get install chromium")
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    rules = "MAP * ~NOTFOUND" + (f", EXCLUDE {reachable}" if reachable else "")
    with api.sync_playwright() as playwright:
        flags = [*FLAGS, f"--host-resolver-rules={rules}"]
        launched = playwright.chromium.launch(executable_path=program, args=flags)
        yield launched
        launched.close()

"""The command line, called as a person calls it."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from flangeye import cli
from flangeye.plugin import registry
from flangeye.plugin.registry import Registry


@pytest.fixture
def flangeye(
    monkeypatch: pytest.MonkeyPatch,
    toy_registry: Registry,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> Callable[..., Any]:
    """Call the command line in an empty folder with the toy stages; return code, out, err."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "load_registry", lambda: toy_registry)

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["flangeye", *map(str, words)])
        code: str | int | None = 0
        try:
            cli.main()
        except SystemExit as exit_:
            code = exit_.code
        for plugin in list(toy_registry.hooks.get_plugins()):
            if toy_registry.hooks.get_name(plugin) != "toy":
                toy_registry.hooks.unregister(plugin)
        said = capsys.readouterr()
        return code, said.out, said.err

    return call

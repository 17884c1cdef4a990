"""What `flangeye stages` remembers, and when it looks again."""

import os
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest
from platformdirs import user_cache_path

from flangeye.plugin import installed as installing
from flangeye.plugin import registry
from flangeye.plugin import stage_list as listing
from flangeye.plugin.registry import Registry

PLUGIN = """
from flangeye import part

@part("cost.mine")
def mine(error) -> float:
    \"\"\"{summary}\"\"\"
    return 0.0
"""


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, toy_registry: Registry) -> Any:
    """One plugin `mine` in a folder of its own; count how often the plugins are loaded."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "mine.py").write_text(PLUGIN.format(summary="First."))
    plugins = [EntryPoint("mine", "mine", "flangeye")]
    monkeypatch.setattr(installing, "installed_plugins", lambda: plugins)
    loads = []

    def load():
        loads.append(1)
        return toy_registry

    monkeypatch.setattr(registry, "load_registry", load)
    return plugins, loads, toy_registry


def test_a_second_list_loads_no_plugin(installed: Any) -> None:
    _, loads, _ = installed
    first = listing.list_stages()
    assert "fit.toy" in first
    assert listing.list_stages() == first
    assert len(loads) == 1


def test_a_changed_file_a_new_plugin_or_another_version_is_seen(
    installed: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugins, loads, _ = installed
    listing.list_stages()
    file = tmp_path / "mine.py"
    file.write_text(PLUGIN.format(summary="Other."))
    os.utime(file, ns=(1, 1))
    listing.list_stages()
    assert len(loads) == 2
    package = tmp_path / "theirs"
    package.mkdir()
    (package / "__init__.py").touch()
    plugins.append(EntryPoint("theirs", "theirs.plugin", "flangeye"))
    listing.list_stages()
    assert len(loads) == 3
    (package / "plugin.py").touch()
    listing.list_stages()
    assert len(loads) == 4
    monkeypatch.setattr(sys, "version", "another")
    listing.list_stages()
    assert len(loads) == 5
    assert "theirs" not in sys.modules, "the files are looked at, not imported"


def test_a_plugin_that_could_not_be_loaded_is_tried_again(installed: Any) -> None:
    _, loads, toys = installed
    toys.broken["mine"] = ImportError("no module named theirs")
    listing.list_stages()
    listing.list_stages()
    assert len(loads) == 2


@pytest.mark.parametrize("content", ["", "{", "[]", "null", '{"installed": 3}', "\xff"])
def test_a_damaged_memory_is_made_anew(installed: Any, content: str) -> None:
    _, loads, _ = installed
    text = listing.list_stages()
    user_cache_path("flangeye").joinpath("stages.json").write_bytes(content.encode("latin-1"))
    assert listing.list_stages() == text
    assert len(loads) == 2
    listing.list_stages()
    assert len(loads) == 2


def test_where_nothing_can_be_written_the_list_is_made_each_time(installed: Any) -> None:
    _, loads, _ = installed
    user_cache_path("flangeye").write_text("a file where the folder should be")
    assert "fit.toy" in listing.list_stages()
    assert "fit.toy" in listing.list_stages()
    assert len(loads) == 2

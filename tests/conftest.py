"""Fixtures shared by all tests."""

import os
import signal
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pluggy
import pytest
from hypothesis import settings

from flangeye.plugin import hookspecs
from flangeye.plugin.registry import Registry
from tests import toy

# Installed and run as a vendor would: test_wheel.py.
collect_ignore = ["vendor_example"]

# What flangeye remembers for its user is not the tests' to change, nor to read.
_CACHE = tempfile.TemporaryDirectory(prefix="flangeye-tests-")
os.environ["XDG_CACHE_HOME"] = _CACHE.name

# The same examples each time, so that a red run is the change's doing; `make test-all` searches on.
settings.register_profile("same", derandomize=True)
settings.register_profile("search", derandomize=False)
settings.load_profile("same")

# A suite in the background of a script ignores Ctrl-C, and so would every process it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let what waits for a browser run with the real clients: after the others, one at a time."""
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.realtime)


RECORDINGS = Path(__file__).parents[1].parent / "shared" / "data" / "ancorasir"


@pytest.fixture(scope="session")
def ancorasir() -> Path:
    """The authors' published recordings, which are not part of the project."""
    if not RECORDINGS.is_dir():
        pytest.skip(f"the published recordings are not at {RECORDINGS}")
    return RECORDINGS


def _registry_with(*modules: tuple[str, object]) -> Registry:
    hooks = pluggy.PluginManager(hookspecs.NAME)
    hooks.add_hookspecs(hookspecs)
    registry = Registry(hooks)
    for name, module in modules:
        registry.register(name, module)
    return registry


@pytest.fixture
def toy_registry(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> Registry:
    """A registry that offers the toy stages alone; what is listed of it is not kept."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
    return toy_plugins()


def toy_plugins() -> Registry:
    """Return a registry that offers the toy stages alone."""
    return _registry_with(("toy", toy))


TOY_RECIPE = """\
title: Toy
seed: 3
steps:
  - acquire.toy: {count: 6, noise: 0.1 mm}
  - segment.toy
  - fit.toy
  - solve.toy
  - verify.toy: {max_rms: 2 mm}
"""


@pytest.fixture
def toy_recipe(tmp_path: Path) -> Path:
    """A recipe of the toy stages, on disk."""
    path = tmp_path / "toy.yaml"
    path.write_text(TOY_RECIPE)
    return path


@contextmanager
def replaced(stage, function):
    """Let a stage call another function for a while."""
    plain = stage.function
    object.__setattr__(stage, "function", function)
    try:
        yield
    finally:
        object.__setattr__(stage, "function", plain)

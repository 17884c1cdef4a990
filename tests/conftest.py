"""Fixtures shared by all tests."""

import gc
import os

# Two workers on two cores: a second thread of BLAS only spins, which doubles what the tests cost.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when numpy is imported

import re
import signal
import sys
import tempfile
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import pluggy
import pytest
import typer.main
import typer.testing
from hypothesis import settings

from flangeye import cli
from flangeye.plugin import hookspecs, registry
from flangeye.plugin.registry import Registry
from tests import toy

# Installed and run as a vendor would: test_wheel.py.
collect_ignore = ["vendor_example"]

# What flangeye remembers for its user is not the tests' to change, nor to read.
_CACHE = tempfile.TemporaryDirectory(prefix="flangeye-tests-")
os.environ["XDG_CACHE_HOME"] = _CACHE.name

# The same examples each time, so that a red run is the change's doing; `make test-all` searches on.
# How long an example takes is the machine's doing: a time that is promised has a test of its own.
settings.register_profile("same", derandomize=True, deadline=None, max_examples=40)
settings.register_profile("search", derandomize=False, deadline=None)
settings.load_profile("same")

# Typer builds all commands anew at each call, of signatures that do not change: a tenth of a second.
_built = cache(typer.main.get_command)
for _module, _name in ((typer.main, "get_command"), (typer.testing, "_get_command")):
    setattr(_module, _name, _built)

# A suite in the background of a script ignores Ctrl-C, and so would every process it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)


def _speaks_of_real_time(path: Path) -> bool:
    return re.search(r"\b(realtime|browser)\b", path.read_text(encoding="utf-8")) is not None


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Where only tests in real time are asked for, import no others: that takes 8 s."""
    asked = config.option.markexpr.replace("not realtime", "")
    named = "realtime" in asked and collection_path.match("test_*.py")
    return True if named and not _speaks_of_real_time(collection_path) else None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keep the garbage collector from what is imported and collected: nearly all of it stays.

    It would look half a million objects through again and again, and as often during the tests.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let what waits for a browser run with the real clients, after the others."""
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.realtime)
        if item.get_closest_marker("realtime") and not _speaks_of_real_time(item.path):
            raise pytest.UsageError(f"{item.path} must name realtime or browser: see conftest.py")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Let the programs that a test starts find the tests, whatever a command did before.

    A command that runs in the tests' own process keeps the current folder from its children.
    """
    os.environ.pop("PYTHONSAFEPATH", None)


RECORDINGS = Path(__file__).parents[1].parent / "shared" / "data" / "ancorasir"


@pytest.fixture(scope="session")
def ancorasir() -> Path:
    """The authors' published recordings, which are not part of the project."""
    if not RECORDINGS.is_dir():
        pytest.skip(f"the published recordings are not at {RECORDINGS}")
    return RECORDINGS


def _registry_with(*modules: tuple[str, object]) -> Registry:
    hooks = pluggy.PluginManager(hookspecs.PROJECT)
    hooks.add_hookspecs(hookspecs)
    made = Registry(hooks)
    for name, module in modules:
        made.register(name, module)
    return made


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


Call = Callable[..., tuple[str | int | None, str, str]]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """Call the command line in this process; return its exit code and what it wrote."""

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["flangeye", *map(str, words)])
        code: str | int | None = 0
        try:
            cli.main()
        except SystemExit as exit_:
            code = exit_.code
        said = capsys.readouterr()
        return code, said.out, said.err

    return call


@pytest.fixture
def flangeye(
    command: Call, monkeypatch: pytest.MonkeyPatch, toy_registry: Registry, tmp_path: Path
) -> Call:
    """Call the command line in an empty folder with the toy stages; return code, out, err."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "load_registry", lambda: toy_registry)

    def call(*words):
        told = command(*words)
        for plugin in list(toy_registry.hooks.get_plugins()):
            if toy_registry.hooks.get_name(plugin) != "toy":
                toy_registry.hooks.unregister(plugin)
        return told

    return call


@contextmanager
def replaced(stage, function):
    """Let a stage call another function for a while."""
    plain = stage.function
    object.__setattr__(stage, "function", function)
    try:
        yield
    finally:
        object.__setattr__(stage, "function", plain)


@pytest.fixture(scope="session")
def store_server() -> Iterator[str]:
    """A server that speaks as S3 does, on loopback; its URL."""
    moto_server = pytest.importorskip("moto.server")
    server = moto_server.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def bucket(store_server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The client of an empty bucket s3://cell; processes that are started reach it too."""
    s3fs = pytest.importorskip("s3fs")
    for name, value in {
        "AWS_ENDPOINT_URL": store_server, "AWS_ACCESS_KEY_ID": "nobody",
        "AWS_SECRET_ACCESS_KEY": "nothing", "AWS_DEFAULT_REGION": "us-east-1",
    }.items():  # fmt: skip
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    store = s3fs.S3FileSystem()
    store.mkdir("cell")
    yield store
    store.rm("cell", recursive=True)
    s3fs.S3FileSystem.clear_instance_cache()

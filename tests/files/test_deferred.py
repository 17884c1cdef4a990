"""A library that is loaded when something of it is first asked for."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from flangeye.files.deferred import defer

SEEN: list[str] = []


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Write a package that notes when it is loaded, and reads an attribute of its own."""
    (tmp_path / "toy_library").mkdir()
    (tmp_path / "toy_library" / "__init__.py").write_text(
        "import sys\n"
        "from tests.files.test_deferred import SEEN\n"
        "SEEN.append('loaded')\n"
        "from toy_library.part import half\n"
        "from toy_library import part\n"
        "answer = 42\n"
    )
    (tmp_path / "toy_library" / "part.py").write_text("def half(x): return x / 2\n")
    monkeypatch.syspath_prepend(tmp_path)
    SEEN.clear()
    yield "toy_library"
    for name in [n for n in sys.modules if n.partition(".")[0] == "toy_library"]:
        del sys.modules[name]


def test_it_is_loaded_once_and_not_before_it_is_used(toy: str) -> None:
    defer(toy)
    first, again = importlib.import_module(toy), importlib.import_module(toy)
    assert SEEN == [] and first is again
    assert first.answer == 42 and again.half(3) == 1.5
    assert SEEN == ["loaded"]


def test_a_module_inside_it_loads_it_first(toy: str) -> None:
    defer(toy)
    assert importlib.import_module(f"{toy}.part").half(1) == 0.5
    assert SEEN == ["loaded"]


def test_what_it_does_not_have_is_an_error_each_time(toy: str) -> None:
    defer(toy)
    for _ in range(2):
        with pytest.raises(AttributeError, match="nothing"):
            _ = importlib.import_module(toy).nothing
    assert SEEN == ["loaded"]


def test_what_is_loaded_or_not_installed_stays_as_it_is() -> None:
    defer("sys")
    defer("no_such_library_anywhere")
    assert sys.modules["sys"] is sys and "no_such_library_anywhere" not in sys.modules

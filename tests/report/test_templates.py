"""Templates compiled before are not compiled again, unless they or what is remembered changed."""

import os
from base64 import b64encode
from collections.abc import Iterator

import pytest
from jinja2 import DictLoader, Environment

from flangeye.files import memory
from flangeye.report.templates import SORT, Compiled


class Counted(Environment):
    """Templates that say how often they were compiled."""

    compiled = 0

    def _generate(self, *args: object, **named: object) -> str:
        self.compiled += 1
        return super()._generate(*args, **named)  # type: ignore[arg-type]


@pytest.fixture(autouse=True)
def own_memory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def compiled(text: str = "{{ 1 + 1 }}") -> int:
    """Render a text in a new environment; return how often it was compiled."""
    environment = Counted(loader=DictLoader({"a.j2": text}), bytecode_cache=Compiled())
    assert environment.get_template("a.j2").render() == "2"
    return environment.compiled


def test_a_template_is_compiled_once_and_again_when_its_text_changes() -> None:
    assert [compiled(), compiled(), compiled("{{ 2 }}"), compiled("{{ 2 }}")] == [1, 0, 1, 0]


@pytest.mark.parametrize("kept", ["", "no base64 !", b64encode(b"other bytes").decode()])
def test_a_damaged_memory_costs_a_second_look(kept: str) -> None:
    compiled()
    (key,) = memory._kept(SORT)
    memory.keep(SORT, key, kept)
    assert compiled() == 1


def test_where_nothing_can_be_kept_templates_are_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", os.devnull)
    assert [compiled(), compiled()] == [1, 1]

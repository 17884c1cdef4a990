import importlib
import subprocess
import sys
import types as python_types
from collections.abc import Callable
from typing import Protocol

import pytest
from typing_extensions import TypeAliasType

from flangeye import hookimpl, stage
from flangeye import types as t
from flangeye.plugin.registry import (
    DuplicatePluginError,
    PluginNotFoundError,
    Registry,
    load_registry,
)
from flangeye.plugin.stage import PARTS, part
from tests import toy


def module_offering(*stages):
    module = python_types.ModuleType("vendor")
    vars(module)["flangeye_stages"] = hookimpl(lambda: stages)
    return module


def test_two_plugins_with_one_name_are_an_error(toy_registry: Registry) -> None:
    with pytest.raises(DuplicatePluginError) as error:
        toy_registry.register("acme", module_offering(toy.solve))
    assert str(error.value) == (
        "plugins 'toy' and 'acme' both offer 'solve.toy'; uninstall one of them"
    )


def test_a_broken_plugin_is_named_only_when_something_is_missing(toy_registry: Registry) -> None:
    toy_registry.broken["acme"] = ModuleNotFoundError("No module named 'acme_sdk'")
    assert toy_registry.stage("solve.toy") is toy.solve
    with pytest.raises(PluginNotFoundError) as error:
        toy_registry.stage("solve.acme")
    assert str(error.value) == (
        "no stage 'solve.acme'; did you mean solve.toy?; plugin 'acme' could not be loaded "
        "(ModuleNotFoundError: No module named 'acme_sdk')"
    )


def test_a_misspelt_hook_is_a_broken_plugin(
    monkeypatch: pytest.MonkeyPatch, toy_registry: Registry
) -> None:
    module = python_types.ModuleType("vendor")
    vars(module)["flangeye_stagez"] = hookimpl(lambda: ())
    with pytest.raises(Exception, match="unknown hook 'flangeye_stagez'"):
        toy_registry.register("acme", module)


def test_the_built_ins_come_through_the_same_door() -> None:
    registry = load_registry()
    assert registry.broken == {}
    assert set(registry.owners.values()) >= {"builtin"}


def test_a_signature_is_checked_when_it_is_declared() -> None:
    def no_docstring(capture: t.Capture) -> t.FlangeCloud:
        raise NotImplementedError

    def wrong_result(capture: t.Capture) -> t.HandEye:
        """Give the wrong thing."""
        raise NotImplementedError

    def wrong_input(cloud: t.FlangeCloud) -> t.FlangeCloud:
        """Take the wrong thing."""
        raise NotImplementedError

    refused: list[tuple[str, Callable[..., object], str]] = [
        ("segment.a", no_docstring, "'segment.a' has no docstring; its first line is what people "
         "read"),
        ("segment.b", wrong_result, "stage 'segment.b' returns HandEye, but a 'segment' stage "
         "returns FlangeCloud or Rejected"),
        ("segment.c", wrong_input, "stage 'segment.c': a 'segment' stage takes a Capture"),
        ("paint.d", wrong_result, "stage 'paint.d': no kind 'paint'; kinds: acquire, segment, fit, "
         "solve, refine, verify, export, scan, seam, weld"),
    ]  # fmt: skip
    for name, function, message in refused:
        with pytest.raises(TypeError) as error:
            stage(name)(function)
        assert str(error.value) == message
    with pytest.raises(TypeError, match="part 'colour.red': no kind 'colour'; kinds: "):
        part("colour.red")(wrong_result)


@pytest.mark.parametrize(
    ("name", "declare", "message"),
    [
        ("cost.x", "def x(value: float) -> float: 'X.'",
         "part 'cost.x': a 'cost' part is called with error, and has value"),
        ("cost.x", "def x(error: float) -> float: 'X.'",
         "part 'cost.x': its error is a PoseError, not a float"),
        ("cost.x", "def x(error: PoseError) -> str: 'X.'",
         "part 'cost.x' returns str, but a 'cost' part returns float"),
        ("reader.x", "def x() -> float: 'X.'",
         "part 'reader.x': a 'reader' part is called with path, and has no arguments"),
    ],
)  # fmt: skip
def test_a_part_keeps_the_contract_of_its_kind(name: str, declare: str, message: str) -> None:
    given = {"PoseError": t.PoseError}
    exec(declare, given)
    with pytest.raises(TypeError) as caught:
        part(name)(given["x"])
    assert str(caught.value) == message


def test_an_alias_of_a_class_is_that_class() -> None:
    """As NumPy's NDArray is from 2.5 on."""
    alias = TypeAliasType("Kilograms", float)  # type: ignore[misc]

    def cost(error: t.PoseError) -> alias:  # type: ignore[valid-type]
        """Cost as much."""
        return 1.0

    cost.__annotations__ = {"error": t.PoseError, "return": alias}
    assert part("cost.alias")(cost)


def test_every_kind_of_part_has_a_protocol_in_the_engine() -> None:
    for kind, declared in PARTS.items():
        module, _, protocol = declared.contract.partition(":")
        contract = getattr(importlib.import_module(module), protocol)
        assert issubclass(contract, Protocol), kind
        assert contract.__call__.__doc__


def test_a_stage_says_which_configurations_it_serves() -> None:
    with pytest.raises(TypeError) as caught:
        stage("solve.x", serves=["eye-on-wall"])
    assert str(caught.value) == (
        "stage 'solve.x' serves 'eye-on-wall', which is not a configuration; known: eye-on-base, "
        "eye-in-hand, eye-on-arm, two-arms, cell"
    )


def offering(**places):
    module = python_types.ModuleType("acme")
    named = {f"solve.{n}": at for n, at in places.items()}
    vars(module)["flangeye_stages"] = hookimpl(lambda: named)
    return module


def test_a_stage_named_by_its_place_is_imported_when_it_is_asked_for(
    toy_registry: Registry,
) -> None:
    toy_registry.register("acme", offering(away="acme_away:solve", toy2="tests.toy:solve"))
    assert "solve.away" in toy_registry.stages
    with pytest.raises(
        PluginNotFoundError, match=r"'solve.away' cannot be imported from acme_away"
    ):
        toy_registry.stage("solve.away")
    with pytest.raises(
        PluginNotFoundError, match=r"tests.toy:solve does not define stage 'solve.toy2'"
    ):
        toy_registry.stage("solve.toy2")
    assert "solve.toy" in toy_registry.everything()
    assert isinstance(toy_registry.broken["acme"], PluginNotFoundError)


def test_every_name_of_ours_is_where_it_is_said_to_be() -> None:
    registry = load_registry()
    offered = registry.everything()
    assert registry.broken == {}
    assert set(offered) == set(registry.stages) | set(registry.parts)
    assert all(plugin.name == name for name, plugin in offered.items())


def test_finding_plugins_imports_none_of_their_modules() -> None:
    code = (
        "import sys; from flangeye.plugin.registry import load_registry; load_registry(); "
        "print([m for m in sys.modules if m.startswith('flangeye_plugins.')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_exports_are_found_without_the_other_stages() -> None:
    code = (
        "import sys; from flangeye.plugin.registry import load_registry; "
        "print(len(load_registry().exports()) > 10); "
        "print([m for m in sys.modules if m.startswith(('flangeye_plugins.weld', 'scipy.signal'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n") == ["True", "[]", ""]


def test_help_waits_for_no_arrays() -> None:
    code = "import sys; from flangeye.cli import commands; commands(); print({'numpy', 'pydantic'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"

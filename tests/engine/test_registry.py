import types as python_types

import pytest

from flangeye import stage
from flangeye import types as t
from flangeye.registry import DuplicatePluginError, PluginNotFoundError, load_registry
from flangeye.stage import part
from tests import toy


def module_offering(*stages):
    module = python_types.ModuleType("vendor")
    module.flangeye_stages = toy.hookimpl(lambda: stages)
    return module


def test_two_plugins_with_one_name_are_an_error(toy_registry):
    with pytest.raises(DuplicatePluginError) as error:
        toy_registry.register("acme", module_offering(toy.solve))
    assert str(error.value) == (
        "plugins 'toy' and 'acme' both offer 'solve.toy'; uninstall one of them"
    )


def test_a_broken_plugin_is_named_only_when_something_is_missing(toy_registry):
    toy_registry.broken["acme"] = ModuleNotFoundError("No module named 'acme_sdk'")
    assert toy_registry.stage("solve.toy") is toy.solve
    with pytest.raises(PluginNotFoundError) as error:
        toy_registry.stage("solve.acme")
    assert str(error.value) == (
        "no stage 'solve.acme'; did you mean solve.toy?; plugin 'acme' could not be loaded "
        "(ModuleNotFoundError: No module named 'acme_sdk')"
    )


def test_a_misspelt_hook_is_a_broken_plugin(monkeypatch, toy_registry):
    module = python_types.ModuleType("vendor")
    module.flangeye_stagez = toy.hookimpl(lambda: ())
    with pytest.raises(Exception, match="unknown hook 'flangeye_stagez'"):
        toy_registry.register("acme", module)


def test_the_built_ins_come_through_the_same_door():
    registry = load_registry()
    assert registry.broken == {}
    assert set(registry.owners.values()) >= {"builtin"}


def test_a_signature_is_checked_when_it_is_declared():
    def no_docstring(capture: t.Capture) -> t.FlangeCloud: ...

    def wrong_result(capture: t.Capture) -> t.HandEye:
        """Give the wrong thing."""

    def wrong_input(cloud: t.FlangeCloud) -> t.FlangeCloud:
        """Take the wrong thing."""

    for name, function, message in [
        ("segment.a", no_docstring, "'segment.a' has no docstring; its first line is what people "
         "read"),
        ("segment.b", wrong_result, "stage 'segment.b' returns HandEye, but a 'segment' stage "
         "returns FlangeCloud or Rejected"),
        ("segment.c", wrong_input, "stage 'segment.c': a 'segment' stage takes a Capture"),
        ("paint.d", wrong_result, "stage 'paint.d': no kind 'paint'; kinds: acquire, segment, fit, "
         "solve, refine, verify, scan, seam, weld"),
    ]:  # fmt: skip
        with pytest.raises(TypeError) as error:
            stage(name)(function)
        assert str(error.value) == message
    with pytest.raises(TypeError, match="part 'colour.red': no kind 'colour'; kinds: "):
        part("colour.red")(wrong_result)

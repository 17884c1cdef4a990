"""No stage can reach what a simulation knows: everything its arguments lead to is walked."""

from functools import partial
from types import MappingProxyType, MethodType
from typing import Any

import numpy as np
import pytest

from flangeye import types as t
from flangeye.plugin.registry import load_registry
from flangeye.plugin.stage import Plugin
from flangeye.workflow.recipe.find import find_recipe
from flangeye.workflow.recipe.load import load_recipe
from flangeye.workflow.run.runner import Runner


def reachable(value):
    """Yield every object of ours that attributes, items, partials and bound methods lead to.

    Closures are left out: a simulated scanner has to know where it stands in order to scan.
    """
    seen, left = {}, [value]
    while left:
        each = left.pop()
        if id(each) not in seen:
            seen[id(each)] = each
            yield each
            left.extend(_inside(each))


def _inside(value):
    if isinstance(value, dict | MappingProxyType):
        return [*value.keys(), *value.values()]
    if isinstance(value, list | tuple | set | frozenset):
        return list(value)
    if isinstance(value, partial):
        return [value.func, *value.args, *value.keywords.values()]
    if isinstance(value, MethodType):
        return [value.__self__]
    if not type(value).__module__.startswith("flangeye") or isinstance(value, Plugin):
        return []
    slots = [getattr(value, name, None) for name in getattr(type(value), "__slots__", ())]
    return [*getattr(value, "__dict__", {}).values(), *slots]


def truths_in(arguments):
    for found in reachable(arguments):
        if isinstance(found, t.Truth):
            yield found
        if isinstance(found, t.WorkpieceScan) and found.truth:
            yield found.truth


@pytest.fixture
def spied(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Walk the arguments of every step when it is called, and when it has been."""
    found, called = list[tuple[str, object]](), list[str]()
    arguments_of = Runner._arguments

    def spy(self, step, given):
        arguments = arguments_of(self, step, given)
        called.append(step.stage.kind)
        found.extend((step.label, truth) for truth in truths_in(arguments))
        return arguments

    monkeypatch.setattr(Runner, "_arguments", spy)
    return found, called


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("configurations/eye-on-base_marker_most-likely_simulated", ("steps.0.poses=8",)),
        ("ur5_phoxi-m_simulated", ("steps.0.resolution=0.3",)),
    ],
)
def test_no_argument_of_a_stage_leads_to_the_truth(
    name: str, overrides: tuple[Any, ...], spied: Any
) -> None:
    registry = load_registry()
    recipe = load_recipe(find_recipe(name), registry, overrides)
    result = Runner(recipe, registry, t.ArchivePath()).run()
    found, called = spied
    assert result.truth is not None, "there was a truth to find"
    assert {"acquire", "fit", "solve", "verify"} <= set(called)
    assert not found


def test_the_walk_finds_a_truth_that_is_there() -> None:
    truth = t.Truth(t.Transform(t.BASE, t.CAMERA, np.eye(4)))
    source = t.Source("x", truth=truth)
    assert list(truths_in({"observations": t.Observations([], source)})) == [truth]

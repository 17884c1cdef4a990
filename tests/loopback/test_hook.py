"""``flangeye loopback`` finds controllers that plugins offer, whoever wrote them."""

import sys
import types

import pytest

from flangeye import cli, registry
from flangeye.catalogue import load_model
from flangeye.errors import StageError
from flangeye.loopback import Loopback, LoopbackOptions, find_loopback
from flangeye.registry import load_registry
from tests import toy


def test_the_built_in_controllers_come_through_the_hook():
    offered = [one for some in load_registry().hooks.hook.flangeye_loopbacks() for one in some]
    for model in ("ur3e", "ur5", "ur5e", "ur10e"):
        assert find_loopback(offered, load_model("robots", model)).name == "ur"


def test_without_plugins_there_are_none():
    with pytest.raises(StageError) as error:
        find_loopback([], load_model("robots", "ur5e"))
    assert str(error.value) == (
        "no controller on loopback for a ur5e of Universal Robots; there is one for arms of: none"
    )


def test_a_vendors_controller_is_found(monkeypatch, toy_registry):
    served = []
    vendor = types.ModuleType("vendor")
    vendor.flangeye_loopbacks = toy.hookimpl(
        lambda: [Loopback("fr", "Franka Emika", served.append)]
    )
    toy_registry.register("vendor", vendor)
    monkeypatch.setattr(registry, "load_registry", lambda: toy_registry)
    arguments = [
        "--host",
        "127.0.0.9",
        "--joints",
        "0 10 deg",
        "--fault",
        "a",
        "--fault",
        "b@moving",
    ]
    monkeypatch.setattr(sys, "argv", ["flangeye", "loopback", "franka-panda", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 0
    assert served == [
        LoopbackOptions(
            robot=load_model("robots", "franka-panda"),
            host="127.0.0.9",
            joints=(0.0, pytest.approx(0.17453292519943295)),
            faults=("a", "b@moving"),
        )
    ]

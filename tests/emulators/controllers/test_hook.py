"""``flangeye emulator`` finds controllers that plugins offer, whoever wrote them."""

import sys
import types

import pytest

from flangeye import cli, hookimpl
from flangeye.errors import StageError
from flangeye.models.graph import Emulator, EmulatorOptions, find_emulator
from flangeye.models.loading import load_model
from flangeye.plugin import registry
from flangeye.plugin.registry import Registry, load_registry


def test_the_built_in_controllers_come_through_the_hook() -> None:
    offered = [one for some in load_registry().hooks.hook.flangeye_emulators() for one in some]
    for model in ("ur3e", "ur5", "ur5e", "ur10e"):
        assert find_emulator(offered, load_model("robots", model)).name == "ur"


def test_without_plugins_there_are_none() -> None:
    with pytest.raises(StageError) as error:
        find_emulator([], load_model("robots", "ur5e"))
    assert str(error.value) == (
        "no controller on loopback for a ur5e of Universal Robots; there is one for arms of: none"
    )


def test_a_vendors_controller_is_found(
    monkeypatch: pytest.MonkeyPatch, toy_registry: Registry
) -> None:
    served: list[EmulatorOptions] = []
    vendor = types.ModuleType("vendor")
    offered = [Emulator("fr", "Franka Emika", served.append)]
    vars(vendor)["flangeye_emulators"] = hookimpl(lambda: offered)
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
    monkeypatch.setattr(sys, "argv", ["flangeye", "emulator", "franka-panda", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 0
    (options,) = served
    assert options.joints == pytest.approx((0.0, 0.17453292519943295))
    assert options == EmulatorOptions(
        robot=load_model("robots", "franka-panda"),
        host="127.0.0.9",
        joints=options.joints,
        faults=("a", "b@moving"),
    )

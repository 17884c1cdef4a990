"""Power sources, and the arm that switches them."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from flangeye.devices import DeviceError, RobotDriver
from flangeye.models.arc import ArcTimes
from flangeye.motion.arc import BURN, GAS, OFF, ArcedArm, with_arc
from flangeye.plugin.stage import BoundPart
from flangeye.testing import ArcConformance
from flangeye_emulators.arc import SimulatedArc, SimulatedArcParams, arc_simulated
from flangeye_plugins.arc import (
    ManualArcParams,
    UrDigitalArc,
    UrDigitalParams,
    arc_manual,
    arc_ur_digital,
)
from tests.emulators.controllers.process import Process, free_address
from tests.motion.stand_in import StandIn
from tests.plugins.robot.cell import until

STILL = np.zeros(6)


@pytest.fixture(scope="class")
def running() -> Iterator[Process]:
    with Process() as controller:
        yield controller


@pytest.fixture
def controller(running: Process) -> Process:
    """A controller as after power-on."""
    running.control.reset()
    return running


class TestSimulated(ArcConformance):
    part = arc_simulated
    params = SimulatedArcParams()


class TestManual(ArcConformance):
    part = arc_manual
    params = ManualArcParams()


class TestUrDigital(ArcConformance):
    part = arc_ur_digital
    unreachable = UrDigitalParams(host=free_address(), output=3)

    @pytest.fixture(autouse=True)
    def of(self, controller: Process) -> None:
        self.host = controller.host

    def open(self) -> Any:
        params = UrDigitalParams(host=self.host, output=3, gas=1, established=3)
        return arc_ur_digital.function(params)


# --- the arm with a power source ------------------------------------------------------------------


def arced(arc: SimulatedArc, **times: str) -> ArcedArm:
    return ArcedArm(StandIn(), arc, ArcTimes.model_validate(times))


def lead(arm: ArcedArm, level: float, cycles: int = 1) -> None:
    for _ in range(cycles):
        arm.wait_cycle()
        arm.move_velocity(np.append(STILL, level), 0.5)


def test_gas_comes_before_the_arc_and_flows_on_after_it() -> None:
    arc = SimulatedArc()
    arm = arced(arc, gas_after="50 ms")
    lead(arm, GAS)
    lead(arm, BURN, 3)
    assert arc.history == [("gas", True), ("burn", False), ("gas", True), ("burn", True)]
    del arc.history[:]
    lead(arm, OFF, round(0.05 / arm.period))
    assert arc.history == [("burn", False)]
    lead(arm, OFF)
    assert arc.history == [("burn", False), ("gas", False)]
    lead(arm, OFF, 5)
    assert len(arc.history) == 2


def test_gas_that_no_arc_followed_flows_no_longer() -> None:
    arc = SimulatedArc()
    arm = arced(arc, gas_after="50 ms")
    lead(arm, GAS)
    del arc.history[:]
    lead(arm, OFF, 2)
    assert arc.history == [("burn", False), ("gas", False)]


@pytest.mark.parametrize(
    "stop",
    [
        lambda arm: arm.stop(),
        lambda arm: arm.close(),
        lambda arm: arm.move_velocity(STILL, 0.5),
        lambda arm: arm.move_joints(arm.state().joints, 0.1, 0.5),
        lambda arm: arm.move_linear(arm.state().base_T_flange, 0.1, 0.5),
    ],
)
def test_whatever_else_the_arm_is_told_ends_the_arc(stop: Any) -> None:
    arc = SimulatedArc()
    arm = arced(arc)
    lead(arm, BURN, 2)
    assert arc.burning()
    stop(arm)
    assert not arc.burning()


@pytest.mark.parametrize(
    ("ignition", "burns", "noticed"),
    [("0.3 s", 0.0, 0.3), ("0 s", 0.0, 0.2), ("0.3 s", 0.05, 0.3), ("0.3 s", 0.4, 0.6)],
)
def test_an_arc_that_goes_out_is_no_weld(ignition: str, burns: float, noticed: float) -> None:
    arc = SimulatedArc()
    arm = arced(arc, ignition=ignition)
    lead(arm, GAS, 200)
    lead(arm, BURN)
    lead(arm, BURN, round(burns / arm.period))
    arc.burn(False)
    lead(arm, BURN, round((noticed - burns) / arm.period))
    with pytest.raises(DeviceError, match="simulated power source: the arc does not burn"):
        lead(arm, BURN)
    assert arc.history[-1] == ("burn", False)
    lead(arm, OFF, 2000)
    assert arc.history[-1] == ("gas", False)


def test_an_arm_that_nobody_told_of_an_arc_leaves_the_gas_shut() -> None:
    arc = SimulatedArc()
    arm = arced(arc)
    for _ in range(3):
        arm.wait_cycle()
        arm.move_velocity(STILL, 0.5)
    arm.stop()
    assert arc.history == []


@pytest.mark.parametrize(("gas_after", "flows"), [("50 ms", 0.05), ("30 s", 1.5)])
def test_an_arm_that_is_let_go_of_shields_its_bead_as_long_as_a_guard_may_take(
    gas_after: str, flows: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    arc = SimulatedArc()
    arm = arced(arc, gas_after=gas_after)
    lead(arm, BURN)
    since = arm.cycles
    clock = SimpleNamespace(monotonic=lambda: 100.0 + arm.cycles * arm.period)
    monkeypatch.setattr("flangeye.motion.arc.time", clock)
    arm.close()
    assert (arm.cycles - since) * arm.period == pytest.approx(flows, abs=1.1 * arm.period)
    assert arc.history[-1] == ("gas", False)


def test_an_arm_that_cannot_be_told_to_stop_has_no_arc_all_the_same() -> None:
    class Lost(StandIn):
        def stop(self) -> None:
            raise DeviceError("lost")

    arc = SimulatedArc()
    arm = ArcedArm(Lost(), arc, ArcTimes())
    lead(arm, BURN)
    with pytest.raises(DeviceError, match="lost"):
        arm.stop()
    assert not arc.burning()


def test_an_arm_is_let_go_of_where_its_power_source_cannot_be_opened() -> None:
    robot = StandIn()

    def refuse() -> Any:
        raise DeviceError("no power source")

    driver = with_arc(RobotDriver("robot.stand_in", lambda: robot), refuse, ArcTimes())
    with pytest.raises(DeviceError, match="no power source"):
        driver.open()
    assert robot.closed


# --- on the outputs of a controller ---------------------------------------------------------------


def outputs(controller: Process) -> int:
    return int(controller.control.state()["digital_outputs"])


class TestOutputs:
    def test_outputs_go_high_and_low_and_the_input_says_whether_it_burns(
        self, controller: Process
    ) -> None:
        params = UrDigitalParams(host=controller.host, output=3, gas=1, established=3)
        with arc_ur_digital.function(params) as arc:
            arc.gas(True)
            until(lambda: outputs(controller) == 0b0010, 1.0)
            assert arc.burning() is False
            arc.burn(True)
            until(lambda: outputs(controller) == 0b1010, 1.0)
            until(arc.burning, 1.0)
            controller.control.fault("inputs-low")
            until(lambda: arc.burning() is False, 1.0)
        until(lambda: outputs(controller) == 0, 1.0)
        with pytest.raises(DeviceError, match="is closed"):
            arc.burn(True)

    def test_an_arc_that_nothing_watches_does_not_say_that_it_is_out(
        self, controller: Process
    ) -> None:
        params = UrDigitalParams(host=controller.host, output=3)
        arc: Any = arc_ur_digital.function(params)
        arc.gas(True)  # it has no valve of its own
        arc.burn(True)
        assert arc.burning() is None
        until(lambda: outputs(controller) == 0b1000, 1.0)
        arc.close()

    def test_outputs_that_another_client_has_are_refused(self, controller: Process) -> None:
        params = UrDigitalParams(host=controller.host, output=3)
        with (
            arc_ur_digital.function(params),
            pytest.raises(DeviceError, match="refuses RTDE's I; another"),
        ):
            arc_ur_digital.function(params)


@pytest.mark.parametrize("at", ["output", "gas", "established"])
def test_outputs_and_inputs_are_the_eight_that_a_controller_has(at: str) -> None:
    given = {"host": "a", "output": 3}
    for number in (0, 7):
        assert getattr(UrDigitalParams.model_validate({**given, at: number}), at) == number
    for number in (-1, 8):
        with pytest.raises(ValidationError, match=at):
            UrDigitalParams.model_validate({**given, at: number})


AGREED = {"V": b"\1", "O": b"\1UINT64", "I": b"\5UINT8,UINT8", "S": b"\1"}
"""RTDE's answers of a controller that agrees to everything; 5 is the number of the outputs."""


class Scripted(threading.Thread):
    """The RTDE of a controller that gives the answers that it is told to.

    Attributes:
        params: Of a power source on it.
        asked: Letter and body of what it was sent so far.
    """

    def __init__(self, said: Mapping[str, bytes]) -> None:
        super().__init__(daemon=True)
        self.params = UrDigitalParams(host=free_address(), output=3, gas=1, established=0)
        self.asked: list[tuple[str, bytes]] = []
        self._said, self._server = said, socket.create_server((self.params.host, 30004))
        self.start()

    def run(self) -> None:
        line, _ = self._server.accept()
        with self._server, line, line.makefile("rb") as sent:
            while head := sent.read(3):
                size, kind = int.from_bytes(head[:2], "big"), chr(head[2])
                self.asked.append((kind, sent.read(size - 3)))
                if kind in self._said:
                    answer = self._said[kind]
                    line.sendall((len(answer) + 3).to_bytes(2, "big") + head[2:] + answer)


def test_a_controller_is_asked_for_what_every_generation_has() -> None:
    controller = Scripted(AGREED)
    UrDigitalArc(controller.params).close()
    controller.join(1.0)
    rate = struct.pack(">d", 125.0)
    outputs = b"standard_digital_output_mask,standard_digital_output"
    off = [("U", bytes([5, 1 << 3, 0])), ("U", bytes([5, 1 << 1, 0]))]
    assert controller.asked == [
        ("V", b"\0\2"), ("O", rate + b"actual_digital_input_bits"), ("I", outputs), ("S", b""),
        *off, *off,
    ]  # fmt: skip


def test_a_controller_that_has_sent_no_inputs_has_no_arc() -> None:
    with UrDigitalArc(Scripted(AGREED).params) as arc:
        assert arc.burning() is False


@pytest.mark.parametrize("refused", [b"", b"\0"])
@pytest.mark.parametrize("kind", AGREED)
def test_whatever_a_controller_refuses_is_no_power_source(kind: str, refused: bytes) -> None:
    controller = Scripted({**AGREED, kind: refused})
    with pytest.raises(DeviceError, match=f"the controller refuses RTDE's {kind}"):
        UrDigitalArc(controller.params)
    controller.join(1.0)
    assert not controller.is_alive(), "its connection is still open"


def test_a_controller_that_says_nothing_is_given_up_on() -> None:
    host = free_address()
    with socket.create_server((host, 30004)):
        began = time.monotonic()
        with pytest.raises(DeviceError, match="does not answer RTDE's V"):
            UrDigitalArc(UrDigitalParams(host=host, output=0))
        assert time.monotonic() - began < 4.0


def test_a_controller_that_is_gone_is_an_arc_that_is_lost() -> None:
    with Process() as controller:
        arc = arc_ur_digital.function(
            UrDigitalParams(host=controller.host, output=3, established=3)
        )
        controller.end()
        with pytest.raises(DeviceError, match="arc on output 3 of"):
            for _ in range(100):
                arc.burn(True)
                arc.burning()
        arc.close()


def test_a_bound_power_source_opens_in_another_process() -> None:
    driver = RobotDriver("robot.stand_in", StandIn)
    arm: Any = with_arc(driver, BoundPart(arc_simulated, SimulatedArcParams()), ArcTimes()).open()
    assert arm.arc.name == "simulated power source" and arm.name and arm.period > 0.0


# --- by hand --------------------------------------------------------------------------------------


def test_a_person_is_told_each_change_once(capsys: pytest.CaptureFixture[str]) -> None:
    with arc_manual.function(ManualArcParams()) as arc:
        for _ in range(3):
            arc.gas(True)
            arc.burn(True)
        assert arc.burning() is None
    said = capsys.readouterr().err
    told = [line.replace("\a", "").strip("<> ") for line in said.splitlines()]
    assert told == ["GAS ON", "STRIKE THE ARC NOW", "END THE ARC NOW", "GAS OFF"]

"""How the loopback scanner is opened: what takes long comes first, another arm is refused."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye_emulators import scanner as scanners
from flangeye_emulators.scanner import (
    CellScene,
    LoopbackScannerParams,
    TrueStance,
    scanner_loopback,
)

PHOXI = load_model("scanners", "phoxi-m")
JOINTS = np.array([0.1, -1.2, 1.4, -1.7, -1.5, 0.3])


class Control:
    """A controller's control channel, and whether it was let go of."""

    def __init__(self, flange: np.ndarray) -> None:
        self.closed, self._flange = False, flange

    def truth(self) -> Any:
        return SimpleNamespace(joints=JOINTS, base_T_flange=self._flange)

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def prepared(monkeypatch: pytest.MonkeyPatch) -> list[TrueStance]:
    """What the scanner computed of the cell, in place of computing it."""
    stances: list[TrueStance] = []
    monkeypatch.setattr(CellScene, "_scene", lambda self, stance: stances.append(stance))
    return stances


def opened(monkeypatch: pytest.MonkeyPatch, control: Control) -> Any:
    monkeypatch.setattr(scanners, "EmulatorControl", lambda *_, **__: control)
    return scanner_loopback(PHOXI, LoopbackScannerParams(host="127.0.0.5", robot="ur5e"))


def test_the_cell_is_computed_with_the_arm_as_it_stands_before_the_scanner_is_given_out(
    monkeypatch: pytest.MonkeyPatch, prepared: list[TrueStance]
) -> None:
    control = Control(Arm(load_model("robots", "ur5e")).flange(JOINTS))
    with opened(monkeypatch, control):
        assert [stance.joints.tolist() for stance in prepared] == [JOINTS.tolist()]
        assert not control.closed
    assert control.closed


def test_a_controller_that_moves_another_arm_is_refused_and_let_go_of(
    monkeypatch: pytest.MonkeyPatch, prepared: list[TrueStance]
) -> None:
    control = Control(Arm(load_model("robots", "ur10e")).flange(JOINTS))
    with pytest.raises(DeviceError) as refused:
        opened(monkeypatch, control)
    assert str(refused.value) == (
        "scanner.emulator: the controller at 127.0.0.5 does not move the model ur5e: set robot to "
        "what it moves"
    )
    assert control.closed and not prepared


def test_a_controller_that_is_lost_meanwhile_is_said_and_let_go_of(
    monkeypatch: pytest.MonkeyPatch, prepared: list[TrueStance]
) -> None:
    control = Control(np.eye(4))
    monkeypatch.setattr(control, "truth", lambda: (_ for _ in ()).throw(OSError("gone")))
    with pytest.raises(DeviceError, match="lost: gone$"):
        opened(monkeypatch, control)
    assert control.closed and not prepared

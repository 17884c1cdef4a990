"""The arc of a weld: when gas flows, when it burns, and that the torch stands for it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from flangeye.motion.arc import BURN, GAS, OFF
from flangeye.plugin.stage import BoundPart
from flangeye_emulators.arc import SimulatedArc, SimulatedArcParams, arc_simulated
from flangeye_plugins.weld.following.steering import ArcSequence
from flangeye_plugins.weld.weld_log import columns
from tests.plugins.weld.cell import planned, run


def test_the_arc_is_struck_once_gas_has_flowed_and_the_torch_stands_until_it_burns() -> None:
    arc = ArcSequence((0.5, 0.2, 0.3))
    assert arc.level(1.0) == OFF and not arc.stands(1.0)
    arc.gas(1.0)
    arc.strike(1.1)
    assert [arc.level(t) for t in (1.0, 1.49, 1.5)] == [GAS, GAS, BURN]
    assert [arc.stands(t) for t in (1.1, 1.69, 1.71)] == [True, True, False]
    arc.strike(1.9)  # it burns already
    assert arc.level(1.9) == BURN and not arc.stands(1.9)
    assert not arc.filled(5.0) and arc.stands(5.2) and not arc.filled(5.29) and arc.filled(5.31)


def test_without_a_power_source_nothing_waits() -> None:
    arc = ArcSequence((0.0, 0.0, 0.0))
    arc.strike(1.0)
    assert not arc.stands(1.0) and arc.filled(9.0)


class Failing(SimulatedArc):
    """An arc that is found to be out once it was asked after so often."""

    def __init__(self, after: int | None) -> None:
        super().__init__()
        self.left = float("inf") if after is None else after

    def burning(self) -> bool | None:
        self.left -= self._burns
        return self._burns and self.left >= 0


def welded(
    monkeypatch: pytest.MonkeyPatch, **given: Any
) -> tuple[Any, dict[str, list[Any]], SimulatedArc]:
    """Weld 5 cm with a simulated power source; return report, cycles and source."""
    source = Failing(given.pop("fails_after", None))
    monkeypatch.setattr("flangeye_emulators.arc.SimulatedArc", lambda: source)
    arc = BoundPart(arc_simulated, SimulatedArcParams.model_validate(given.pop("times", {})))
    report, journal = run(planned("v-straight", end=0.05), arc=arc, **given)
    cycles = [value for what, value in journal if what == "cycles"]
    rows = {name: [v for block in cycles for v in block[name]] for name in columns([])}
    return report, rows, source


def test_the_arc_burns_where_the_bound_holds_and_nowhere_else(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    times = {"gas_before": "400 ms", "ignition": "300 ms", "crater": "600 ms", "gas_after": "1 s"}
    report, rows, source = welded(monkeypatch, times=times)
    assert report.completed, report.reason
    assert report.figures["share_welded"] > 0.99
    time, level = np.array(rows["time"]), np.array(rows["arc"])
    torch, bound = np.array(rows["torch"]), np.array(rows["bound"])
    burns, gas = level == BURN, level >= GAS
    assert bound[burns & (torch < 0.05)].max() <= 1e-3
    assert torch[burns].min() >= 0.0 and torch[burns].max() <= 0.05 + 1e-3
    assert time[burns][0] - time[gas][0] >= 0.4 - 0.02
    still = np.abs(np.diff(torch[burns], prepend=torch[burns][0])) < 2e-5
    struck, filled = time[burns] < time[burns][0] + 0.3, time[burns] > time[burns][-1] - 0.58
    assert still[struck].mean() > 0.9 and still[filled].mean() > 0.9
    assert [what for what in source.history if what[1]] == [("gas", True)] * 2 + [("burn", True)]
    assert source.history[-4:-2] == [("burn", False), ("gas", False)]  # then all is closed


def test_an_arc_that_goes_out_stops_the_weld(monkeypatch: pytest.MonkeyPatch) -> None:
    report, _, source = welded(monkeypatch, fails_after=150, speed="10 mm/s")
    assert not report.completed and not source.burning()
    assert report.reason.startswith("simulated power source: the arc does not burn; ")
    assert "of the seam was welded, from 0 to " in report.reason


def test_an_arc_goes_with_touch_only() -> None:
    arc = BoundPart(arc_simulated, SimulatedArcParams())
    with pytest.raises(ValidationError, match="'arc' goes with mode: tactile only"):
        run(planned("v-straight", end=0.05), arc=arc, mode="vision")

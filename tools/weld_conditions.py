"""Conditions for evaluating a weld: errors of the simulated world and their sizes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from flangeye_emulators.weld_world.groove import GrooveSection, square_butt
from flangeye_emulators.weld_world.truth import (
    ArmTruth,
    ClockTruth,
    FingerTruth,
    HeatTruth,
    ProfilerTruth,
    Tack,
    ToolTruth,
    WeldTruth,
    WorkpieceTruth,
)
from flangeye_plugins.weld.settings import Following


class Condition(NamedTuple):
    """A simulated world, and the parameters of the weld in it.

    Attributes:
        truth: True values of the world.
        settings: Controller settings that differ from the defaults.
        planned: Shift [m] and turn [rad] of the plan.
        prior: Prior values of the tool that differ from the defaults.
        half_angle: Half angle of groove and plan [rad]; None for the default.
        section: Cross-section of another joint, of which the controller knows the type only.
        look: Profile sensor behind the torch; None without one.
    """

    truth: WeldTruth = WeldTruth()
    settings: Mapping[str, Any] = {}
    planned: tuple[float, float] = (3e-3, 0.01745)
    prior: Mapping[str, Any] = {}
    half_angle: float | None = None
    section: GrooveSection | None = None
    look: ProfilerTruth | None = None

    @property
    def asked(self) -> Following:
        """All settings of the controller."""
        return Following.model_validate(self.settings)


FILLET = GrooveSection(np.pi / 4, 30e-3, -np.pi / 4)
LAP = GrooveSection(np.pi / 4, 5e-3, -np.pi / 4)
CORNER = GrooveSection(np.pi / 4, 6e-3)
BUTT = square_butt(2.2e-3, 1.5e-3)

CONDITIONS: Mapping[str, Condition] = {
    "nothing wrong": Condition(),
    "images 30 % dropped, noise 0.03 mm": Condition(
        WeldTruth(clock=ClockTruth(dropped=0.3), finger=FingerTruth(noise=0.03e-3))
    ),
    "arm lag 200 ms + dead time 100 ms": Condition(
        WeldTruth(arm=ArmTruth(lag=200e-3, dead_time=100e-3))
    ),
    "arm wavy 0.3 mm": Condition(
        WeldTruth(arm=ArmTruth(wave=0.3e-3)), {"arm_sigma": "0.3 mm"}
    ),
    "arm backlash 0.1 mm": Condition(WeldTruth(arm=ArmTruth(backlash=0.1e-3))),
    "finger gain +10 %": Condition(WeldTruth(finger=FingerTruth(gain=0.1))),
    "finger gain -10 %": Condition(WeldTruth(finger=FingerTruth(gain=-0.1))),
    "finger gain +20 %": Condition(WeldTruth(finger=FingerTruth(gain=0.2))),
    "finger gain -20 %": Condition(WeldTruth(finger=FingerTruth(gain=-0.2))),
    "finger gain drifts 10 % in 60 s": Condition(WeldTruth(finger=FingerTruth(drift=0.1))),
    "tag's rest off 0.2 mm": Condition(WeldTruth(finger=FingerTruth(rest=(0.0, 0.2e-3, 0.0)))),
    "finger play 0.3 mm": Condition(WeldTruth(finger=FingerTruth(play=0.3e-3))),
    "finger hysteresis 10 %": Condition(WeldTruth(finger=FingerTruth(hysteresis=0.1))),
    "torch 0.5 mm aside": Condition(
        WeldTruth(tool=ToolTruth(torch=(0.0, 0.5e-3))), prior={"torch_sigma": 0.3e-3}
    ),
    "tool yaw 1 deg": Condition(
        WeldTruth(tool=ToolTruth(yaw=np.radians(1.0))), prior={"torch_sigma": 0.35e-3}
    ),
    "heat: seam moves 2 mm": Condition(
        WeldTruth(heat=HeatTruth(shift=2e-3)), {"distortion": "0.3 mm", "max_error": "2 mm"}
    ),
    "heat: seam moves 2 mm, with a profiler behind": Condition(
        WeldTruth(heat=HeatTruth(shift=2e-3)), {"distortion": "0.3 mm", "max_error": "2 mm"},
        look=ProfilerTruth(),
    ),
    "heat: 1 mm around the torch": Condition(
        WeldTruth(heat=HeatTruth(local=1e-3)), {"distortion": "0.5 mm", "max_error": "2.5 mm"}
    ),
    "heat: 1 mm around the torch, with a profiler behind": Condition(
        WeldTruth(heat=HeatTruth(local=1e-3)), {"distortion": "0.5 mm", "max_error": "3.5 mm"},
        look=ProfilerTruth(),
    ),
    "torch 0.2 mm aside": Condition(WeldTruth(tool=ToolTruth(torch=(0.0, 0.2e-3)))),
    "torch 0.2 mm aside, with a profiler behind": Condition(
        WeldTruth(tool=ToolTruth(torch=(0.0, 0.2e-3))), look=ProfilerTruth()
    ),
    "seam wavy 1 mm per 10 mm": Condition(
        WeldTruth(workpiece=WorkpieceTruth(wave=1e-3)), {"max_error": "1.5 mm"}
    ),
    "20 mm/s": Condition(WeldTruth(), {"speed": "20 mm/s"}),
    "20 mm/s, latency 100 ms, lag 100 ms, dead time 60 ms": Condition(
        WeldTruth(arm=ArmTruth(lag=100e-3, dead_time=60e-3), clock=ClockTruth(latency=100e-3)),
        {"speed": "20 mm/s"},
    ),
    "plan 10 mm, 5 deg wrong, reach 20 mm": Condition(
        WeldTruth(), {"reach": "20 mm"}, (10e-3, 0.0873)
    ),
    "tack weld 1 mm, spatter 0.05 mm": Condition(
        WeldTruth(workpiece=WorkpieceTruth(tacks=(Tack(start=60e-3),), spatter=0.05e-3))
    ),
    "tip noise 0.1 mm": Condition(WeldTruth(finger=FingerTruth(noise=0.1e-3))),
    "groove half angle 60 deg, known": Condition(
        WeldTruth(finger=FingerTruth(friction=0.0)), half_angle=1.0472
    ),
    "groove half angle 60 deg, planned 40 deg": Condition(
        WeldTruth(workpiece=WorkpieceTruth(half_angle=np.radians(20.0)), finger=FingerTruth(friction=0.0))
    ),
    "finger half as stiff axially": Condition(
        WeldTruth(finger=FingerTruth(axial=0.5, friction=0.0))
    ),
    "tag hidden 0.6 s": Condition(WeldTruth(clock=ClockTruth(hidden=(12.0, 12.6)))),
    "T-fillet, upright tool": Condition(WeldTruth(), {"joint": "fillet"}, section=FILLET),
    "T-fillet, pressed on the right, upright tool": Condition(
        WeldTruth(), {"joint": "fillet", "side": "right"}, section=GrooveSection(np.pi / 4, 30e-3, np.pi / 4)
    ),
    "T-fillet, tool leans 40 deg away, 10 deg forwards": Condition(
        WeldTruth(), {"joint": "fillet", "work_angle": "40 deg", "travel_angle": "10 deg"}, section=FILLET
    ),
    "T-fillet, plates at 91 deg, tool leans 1 deg more than set": Condition(
        WeldTruth(workpiece=WorkpieceTruth(half_angle=np.radians(0.5), lean=np.radians(0.5)), tool=ToolTruth(work=np.radians(1.0))),
        {"joint": "fillet", "work_angle": "30 deg"}, section=FILLET,
    ),
    "lap joint, plate of 5 mm, upright tool": Condition(WeldTruth(), {"joint": "lap"}, section=LAP),
    "lap joint, plate of 5 mm, tool leans 20 deg away": Condition(
        WeldTruth(), {"joint": "lap", "work_angle": "20 deg"}, section=LAP
    ),
    "butt joint, square edges, root gap 2.2 mm": Condition(
        WeldTruth(), {"joint": "butt", "root_gap": "2.2 mm", "deflection": "1.5 mm"}, section=BUTT
    ),
    "butt joint, square edges, root gap 1 mm": Condition(
        WeldTruth(), {"joint": "butt", "root_gap": "1 mm"}, section=BUTT
    ),
    "butt joint, square edges, no root gap": Condition(WeldTruth(), {"joint": "butt"}, section=BUTT),
    "corner joint, open, tool leans 10 deg forwards": Condition(
        WeldTruth(), {"joint": "corner", "travel_angle": "10 deg", "deflection": "1.8 mm"}, section=CORNER
    ),
    "weave 3 mm at 0.8 Hz": Condition(WeldTruth(), {"weave_width": "3 mm", "weave_frequency": 0.8}),
    "weave 2 mm at 1 Hz, arm lag 100 ms + dead time 60 ms": Condition(
        WeldTruth(arm=ArmTruth(lag=100e-3, dead_time=60e-3)),
        {"weave_width": "2 mm", "weave_frequency": 1.0, "max_error": "1.2 mm"},
    ),
    "weave 3 mm at 3 Hz": Condition(WeldTruth(), {"weave_width": "3 mm", "weave_frequency": 3.0}),
    "three passes, 2 mm to the left, 2 mm to the right, weave 3 mm": Condition(WeldTruth(), {
        "weave_frequency": 0.8,
        "passes": [{"across": "2 mm"}, {"across": "-2 mm"}, {"up": "5 mm", "weave_width": "3 mm"}],
    }),
    "two passes, arm lag 200 ms + dead time 100 ms": Condition(
        WeldTruth(arm=ArmTruth(lag=200e-3, dead_time=100e-3)), {"passes": [{"across": "2 mm"}]}
    ),
    "torch led 1 mm to the left": Condition(WeldTruth(), {"offset_across": "1 mm"}),
}  # fmt: skip
"""By name, as the table shows them."""

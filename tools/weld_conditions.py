"""The conditions under which a weld is judged: what is wrong in the world, and by how much."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from flangeye_emulators.weld_world.groove import GrooveSection, square_butt
from flangeye_emulators.weld_world.settings import LookTruth, WorldParams


class Condition(NamedTuple):
    """A simulated world, and the parameters of the weld in it.

    Attributes:
        world: What is true, by section.
        settings: Settings of the controller, beside its defaults.
        planned: Shift [m] and turn [rad] of the plan.
        belief: What the files say of the tool, beside its defaults.
        half_angle: Half angle of the groove [rad], as planned too, where it is not the usual one.
        section: Cross-section of another joint; the controller knows its kind alone.
        look: A look behind the torch, if there is one.
    """

    world: Mapping[str, Mapping[str, Any]] = {}
    settings: Mapping[str, Any] = {}
    planned: tuple[float, float] = (3e-3, 0.01745)
    belief: Mapping[str, Any] = {}
    half_angle: float | None = None
    section: GrooveSection | None = None
    look: LookTruth | None = None

    @property
    def truth(self) -> WorldParams:
        """The world's parameters."""
        return WorldParams.model_validate(self.world)


FILLET = GrooveSection(np.pi / 4, 30e-3, -np.pi / 4)
LAP = GrooveSection(np.pi / 4, 5e-3, -np.pi / 4)
CORNER = GrooveSection(np.pi / 4, 6e-3)
BUTT = square_butt(2.2e-3, 1.5e-3)

CONDITIONS: Mapping[str, Condition] = {
    "nothing wrong": Condition(),
    "images 30 % dropped, noise 0.03 mm": Condition(
        {"clock": {"dropped": 0.3}, "finger": {"noise": "0.03 mm"}}
    ),
    "arm lag 200 ms + dead time 100 ms": Condition(
        {"arm": {"lag": "200 ms", "dead_time": "100 ms"}}
    ),
    "arm wavy 0.3 mm": Condition(
        {"arm": {"wave": "0.3 mm"}}, {"arm_sigma": "0.3 mm"}
    ),
    "arm backlash 0.1 mm": Condition({"arm": {"backlash": "0.1 mm"}}),
    "finger gain +10 %": Condition({"finger": {"gain": 0.1}}),
    "finger gain -10 %": Condition({"finger": {"gain": -0.1}}),
    "finger gain +20 %": Condition({"finger": {"gain": 0.2}}),
    "finger gain -20 %": Condition({"finger": {"gain": -0.2}}),
    "finger gain drifts 10 % in 60 s": Condition({"finger": {"drift": 0.1}}),
    "tag's rest off 0.2 mm": Condition({"finger": {"rest": ["0 mm", "0.2 mm", "0 mm"]}}),
    "finger play 0.3 mm": Condition({"finger": {"play": "0.3 mm"}}),
    "finger hysteresis 10 %": Condition({"finger": {"hysteresis": 0.1}}),
    "torch 0.5 mm aside": Condition(
        {"tool": {"torch": ["0 mm", "0.5 mm"]}}, belief={"torch_sigma": 0.3e-3}
    ),
    "tool yaw 1 deg": Condition(
        {"tool": {"yaw": "1 deg"}}, belief={"torch_sigma": 0.35e-3}
    ),
    "heat: seam moves 2 mm": Condition(
        {"heat": {"shift": "2 mm"}}, {"distortion": "0.3 mm", "max_error": "2 mm"}
    ),
    "heat: seam moves 2 mm, with a look behind": Condition(
        {"heat": {"shift": "2 mm"}}, {"distortion": "0.3 mm", "max_error": "2 mm"},
        look=LookTruth(),
    ),
    "heat: 1 mm around the torch": Condition(
        {"heat": {"local": "1 mm"}}, {"distortion": "0.5 mm", "max_error": "2.5 mm"}
    ),
    "heat: 1 mm around the torch, with a look behind": Condition(
        {"heat": {"local": "1 mm"}}, {"distortion": "0.5 mm", "max_error": "3.5 mm"},
        look=LookTruth(),
    ),
    "torch 0.2 mm aside": Condition({"tool": {"torch": ["0 mm", "0.2 mm"]}}),
    "torch 0.2 mm aside, with a look behind": Condition(
        {"tool": {"torch": ["0 mm", "0.2 mm"]}}, look=LookTruth()
    ),
    "seam wavy 1 mm per 10 mm": Condition(
        {"workpiece": {"wave": "1 mm"}}, {"max_error": "1.5 mm"}
    ),
    "20 mm/s": Condition({}, {"speed": "20 mm/s"}),
    "20 mm/s, latency 100 ms, lag 100 ms, dead time 60 ms": Condition(
        {"arm": {"lag": "100 ms", "dead_time": "60 ms"}, "clock": {"latency": "100 ms"}},
        {"speed": "20 mm/s"},
    ),
    "plan 10 mm, 5 deg wrong, reach 20 mm": Condition(
        {}, {"reach": "20 mm", "astray": "30 mm", "inset": "20 mm"}, (10e-3, 0.0873)
    ),
    "tack weld 1 mm, spatter 0.05 mm": Condition(
        {"workpiece": {"tacks": [{"start": "60 mm"}], "spatter": "0.05 mm"}}
    ),
    "tip noise 0.1 mm": Condition({"finger": {"noise": "0.1 mm"}}),
    "groove half angle 60 deg, known": Condition(
        {"finger": {"friction": 0.0}}, half_angle=1.0472
    ),
    "groove half angle 60 deg, planned 40 deg": Condition(
        {"workpiece": {"half_angle": "20 deg"}, "finger": {"friction": 0.0}}
    ),
    "finger half as stiff axially": Condition(
        {"finger": {"axial": 0.5, "friction": 0.0}}
    ),
    "tag hidden 0.6 s": Condition({"clock": {"hidden": ["12 s", "12.6 s"]}}),
    "T-fillet, upright tool": Condition({}, {"joint": "fillet"}, section=FILLET),
    "T-fillet, pressed on the right, upright tool": Condition(
        {}, {"joint": "fillet", "side": "right"}, section=GrooveSection(np.pi / 4, 30e-3, np.pi / 4)
    ),
    "T-fillet, tool leans 40 deg away, 10 deg forwards": Condition(
        {}, {"joint": "fillet", "work_angle": "40 deg", "travel_angle": "10 deg"}, section=FILLET
    ),
    "T-fillet, plates at 91 deg, tool leans 1 deg more than set": Condition(
        {"workpiece": {"half_angle": "0.5 deg", "lean": "0.5 deg"}, "tool": {"work": "1 deg"}},
        {"joint": "fillet", "work_angle": "30 deg"}, section=FILLET,
    ),
    "lap joint, plate of 5 mm, upright tool": Condition({}, {"joint": "lap"}, section=LAP),
    "lap joint, plate of 5 mm, tool leans 20 deg away": Condition(
        {}, {"joint": "lap", "work_angle": "20 deg"}, section=LAP
    ),
    "butt joint, square edges, root gap 2.2 mm": Condition(
        {}, {"joint": "butt", "root_gap": "2.2 mm", "deflection": "1.5 mm"}, section=BUTT
    ),
    "butt joint, square edges, root gap 1 mm": Condition(
        {}, {"joint": "butt", "root_gap": "1 mm"}, section=BUTT
    ),
    "butt joint, square edges, no root gap": Condition({}, {"joint": "butt"}, section=BUTT),
    "corner joint, open, tool leans 10 deg forwards": Condition(
        {}, {"joint": "corner", "travel_angle": "10 deg", "deflection": "1.8 mm"}, section=CORNER
    ),
    "weave 3 mm at 0.8 Hz": Condition({}, {"weave_width": "3 mm", "weave_frequency": 0.8}),
    "weave 2 mm at 1 Hz, arm lag 100 ms + dead time 60 ms": Condition(
        {"arm": {"lag": "100 ms", "dead_time": "60 ms"}},
        {"weave_width": "2 mm", "weave_frequency": 1.0, "max_error": "1.2 mm"},
    ),
    "weave 3 mm at 3 Hz": Condition({}, {"weave_width": "3 mm", "weave_frequency": 3.0}),
    "three passes, 2 mm to the left, 2 mm to the right, weave 3 mm": Condition({}, {
        "passes": [{"across": "2 mm"}, {"across": "-2 mm", "along": "10 mm"},
                   {"up": "5 mm", "weave_width": "3 mm", "weave_frequency": 0.8}],
    }),
    "two passes, arm lag 200 ms + dead time 100 ms": Condition(
        {"arm": {"lag": "200 ms", "dead_time": "100 ms"}}, {"passes": [{"across": "2 mm"}]}
    ),
    "torch led 1 mm to the left": Condition({}, {"offset_across": "1 mm"}),
}  # fmt: skip
"""By name, as the table shows them."""

"""The seam on which conditions are compared: an S in a plate, planned wrong, and a finger."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from flangeye.models.finger import Finger
from flangeye.motion.seam_following import Controller
from flangeye.types import Floats
from flangeye_emulators.weld_world.groove import GrooveSection, Tip
from flangeye_emulators.weld_world.truth import WeldTruth
from flangeye_emulators.weld_world.world import Nominal, WeldWorld
from flangeye_plugins.weld.checks import check_tool
from flangeye_plugins.weld.following.bound import check_bound
from flangeye_plugins.weld.following.follower import Follower
from flangeye_plugins.weld.following.model_prior import ModelPrior, model_prior_of
from flangeye_plugins.weld.following.task import WeldTask
from flangeye_plugins.weld.frame import LeaningTool, body_from
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.resuming import controller_of
from flangeye_plugins.weld.settings import Following
from tools.weld_conditions import Condition
from tools.weld_trial import Start, Trial, run_trial

DISTANCE = 40e-3
SECTION = GrooveSection(np.deg2rad(40.0), 10e-3)
FINGER = {
    "model": "bench", "tag": {"side": "12 mm"},
    "camera": {"width": 320, "height": 240, "focal": [400, 400], "centre": [159.5, 119.5]},
    "tip": ["0 mm", "0 mm", "180 mm"], "torch": f"{DISTANCE * 1e3} mm", "radius": "1.5 mm",
    "source": "bench",
}  # fmt: skip
ABOVE = 12e-3
"""Height of the tip above the planned start [m]."""


def curved(length: float = 0.15) -> Floats:
    """Return (N, 3) points of an S of 150 mm and 12 mm amplitude."""
    x = np.linspace(0.0, length, 400)
    return np.column_stack([x, 0.012 * np.sin(2 * np.pi * x / 0.15), 0 * x])


def misplanned(points: Floats, seed: int, shift: float, turn: float) -> Floats:
    """Return the points shifted to a random side [m] and turned to one about their middle [rad]."""
    rng = np.random.default_rng(seed)
    way, angle = rng.uniform(0, 2 * np.pi), turn * rng.choice([-1, 1])
    c, s = np.cos(angle), np.sin(angle)
    middle = points.mean(axis=0)
    turned = (points - middle) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + middle
    return np.asarray(turned + shift * np.array([np.cos(way), np.sin(way), 0.0]))


def try_condition(
    condition: Condition,
    seed: int,
    length: float = 0.15,
    period: float = 8e-3,
    watch: Callable[[Controller], None] = lambda _: None,
) -> Trial:
    """Weld the bench's seam under a condition; ``watch`` sees the controller before it begins.

    Raises:
        StageError: It is refused beforehand.
    """
    true = curved(length)
    plan = Path(misplanned(true, seed, *condition.planned))
    body, prior, nominal = set_up(condition, true)
    settings = condition.asked
    check_tool(body, prior, settings)
    check_bound(plan, prior, settings)
    controller = controller_of(WeldTask(plan, prior, settings), "tactile")
    watch(controller)
    start = start_at(plan, prior, settings, period)
    longest = 120.0 * (1 + len(settings.passes))
    start = replace(start, longest=longest, look=condition.look)
    return run_trial(controller, nominal, condition.truth, start, seed)


def could_be_welded(condition: Condition, seed: int, length: float, period: float) -> bool:
    """Return whether a controller with perfect knowledge could weld within ``max_error``.

    The same steering gets the true seam, and tool, arm path and heat as in their files. The
    remaining errors are the arm's delay, backlash and repeatability.
    """
    _, prior, nominal = set_up(condition, curved(length))
    settings = condition.asked
    plan = WeldWorld(nominal, condition.truth, [seed, 0]).groove.root
    arm = replace(condition.truth.arm, wave=0.0, scale=0.0, sag=0.0)
    controller = Follower(WeldTask(plan, prior, settings, touch=False))
    controller.arm.dead_time, controller.arm.lag = arm.dead_time, arm.lag
    start = start_at(plan, prior, settings, period)
    trial = run_trial(controller, replace(nominal, seam=plan), WeldTruth(arm), start, seed)
    s, off = trial.column("torch_s"), np.abs(trial.column("torch"))
    beside = (s > 0.0) & (s < trial.length)
    return trial.done and bool((off[beside] <= settings.max_error).mean() >= 0.99)


def set_up(condition: Condition, true: Floats) -> tuple[LeaningTool, ModelPrior, Nominal]:
    """Return the tool, the controller's model, and the nominal world of a seam (N, 3)."""
    settings, section = condition.asked, condition.section
    # At the planned lean the torch is as high as the tip.
    up = -DISTANCE * np.tan(settings.travel_angle) / np.cos(settings.work_angle)
    torch = np.array([-DISTANCE, 0.0, float(up)])
    body = body_from(torch, settings.sign * settings.work_angle, settings.travel_angle)
    half_angle = None
    if section is None:
        half_angle = condition.half_angle or SECTION.half_angle
        section = GrooveSection(half_angle, SECTION.depth)
    prior = model_prior_of(Finger.model_validate(FINGER), body, half_angle, settings)
    behind = None if condition.look is None else condition.look.behind
    nominal = Nominal(
        Path(true), section, Tip(), body.level_R_tool.T @ body.torch, body.level_R_tool
    )
    return body, replace(prior, behind=behind, **condition.prior), nominal


def start_at(plan: Path, prior: ModelPrior, settings: Following, period: float) -> Start:
    """Return where a weld begins: above the plan's start."""
    first = plan.at(settings.set_down)
    x, y = (first.point + prior.set_down(settings) * first.normal).tolist()
    angle = float(np.arctan2(first.tangent[1], first.tangent[0]))
    return Start((x, y, first.height + ABOVE), angle, period)

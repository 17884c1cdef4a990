"""The seam on which conditions are compared: an S in a plate, planned wrong, and a finger."""

from __future__ import annotations

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.weld_world.conditions import Condition
from flangeye_emulators.weld_world.groove import Section, Tip
from flangeye_emulators.weld_world.trial import Start, Trial, run_trial
from flangeye_emulators.weld_world.world import Nominal
from flangeye_plugins.weld.belief import Belief
from flangeye_plugins.weld.checks import check_belief
from flangeye_plugins.weld.follower import Follower
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following

DISTANCE = 40e-3
SECTION = Section(np.deg2rad(40.0), 10e-3)
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
    condition: Condition, seed: int, length: float = 0.15, period: float = 8e-3
) -> Trial:
    """Weld the bench's seam under a condition.

    Raises:
        StageError: It is refused beforehand.
    """
    true = curved(length)
    plan = Path(misplanned(true, seed, *condition.planned))
    settings = Following.model_validate(condition.settings)
    section = SECTION
    if condition.half_angle is not None:
        section = Section(condition.half_angle, SECTION.depth)
    belief = Belief(DISTANCE, half_angle=section.half_angle, **condition.belief)
    check_belief(belief, settings)
    controller = Follower(plan, belief, settings)
    first = plan.at(settings.inset)
    x, y = first.point.tolist()
    angle = float(np.arctan2(first.tangent[1], first.tangent[0]))
    start = Start((x, y, first.height + ABOVE), angle, period)
    return run_trial(
        controller, Nominal(true, section, Tip(), DISTANCE), condition.truth, start, seed
    )

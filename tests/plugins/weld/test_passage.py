"""The arm's way along a seam, for arms of several makers and seven joints."""

import numpy as np
import pytest

from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.plugin.stage import BoundPart
from flangeye.workflow.recipe.header import LimitsSection
from flangeye_emulators.finger.sensor import (
    SimulatedFingerParams,
    sensor_simulated_finger,
)
from flangeye_plugins.weld.following.task import WeldStart
from flangeye_plugins.weld.frame import Tool, WorkSurface
from flangeye_plugins.weld.reachability import JUMP, ROOM, SeamReach, Task
from flangeye_plugins.weld.settings import WeldTactileParams
from tests.plugins.weld.cell import BOX, FINGER, planned

SENSOR = BoundPart(sensor_simulated_finger, SimulatedFingerParams())


def task_of(name, angle: float = 0.0):
    model = load_model("robots", name)
    seam = planned("v-curved", shift=(-0.1, 0.0, 0.0))
    surface = WorkSurface(seam.points_in_base, seam.openings_in_base)
    limits = LimitsSection.model_validate({"box": BOX}).for_robot(model)
    settings = WeldTactileParams(sensor=SENSOR)
    start = WeldStart(settings.set_down, angle=angle)
    return Task(model, limits, FINGER, Tool(FINGER, surface), surface.path, settings, start)


@pytest.mark.parametrize("name", ["ur10e", "ur5e", "franka-panda", "aubo-i5"])
@pytest.mark.parametrize("angle", [0.0, -np.pi / 2])
def test_every_chain_of_postures_is_one_smooth_way(name: str, angle: float) -> None:
    task = task_of(name, angle)
    arm, chains = Arm(task.model), SeamReach(task)._chains
    assert chains
    for chain in chains:
        assert np.abs(np.diff(chain, axis=0)).max() <= JUMP
        assert (chain >= task.limits.lower + ROOM).all()
        assert (chain <= task.limits.upper - ROOM).all()
        heights = [task.tool.lowest(pose) for pose in arm.flange(chain)]
        assert heights[0] == pytest.approx(task.params.clearance + 0.05, abs=2e-3)
        assert min(heights) == pytest.approx(0.0, abs=1e-3)  # on the seam itself
    # The last posture has the tip beyond the seam's end, where the torch comes to it.
    tip = arm.flange(chains[0][-1]) @ [*FINGER.tip, 1.0]
    end = task.plan.at(task.plan.length + FINGER.torch)
    beyond = task.tool.base_T_flange(np.array([*end.point, end.height]), 0.0, task.plan.length)
    assert np.linalg.norm(tip[:3] - beyond.apply(np.array(FINGER.tip))) < 15e-3


def test_the_way_to_the_start_begins_where_the_arm_stands_by_whole_turns() -> None:
    task = task_of("ur10e")
    passage = SeamReach(task)
    above = passage._chains[0][0]
    wound = above + np.array([0, 0, 0, 0, 0, 2 * np.pi])
    if not (wound <= task.limits.upper - ROOM).all():
        wound = above - np.array([0, 0, 0, 0, 0, 2 * np.pi])
    route = passage.to_start(wound)
    np.testing.assert_allclose(route.legs[0].joints, wound, atol=1e-9)
    assert all(leg.speed <= task.params.approach_joint_speed + 1e-9 for leg in route.legs)

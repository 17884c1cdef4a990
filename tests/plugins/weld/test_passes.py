"""The passes after the root's: back above the work, along what was found, and how well known."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.motion.seam_following import STILL, Command, ToolPose
from flangeye.types import Floats
from flangeye_plugins.weld.following.model_prior import ModelPrior, SweepFit
from flangeye_plugins.weld.following.task import ResumePoint, WeldStart, WeldTask
from flangeye_plugins.weld.passes import MultiPassController, RootPass
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following
from tests.plugins.weld.bench import circle, pose, straight

DISTANCE, LENGTH, RADIUS = 40e-3, 0.1, 0.08
SIGMA = 0.1e-3


class Root:
    """A root pass that found the plan, so much to its left, with its tool at a height [m]."""

    def __init__(self, plan: Path, aside: float = 0.0) -> None:
        def frame(s: float) -> tuple[Floats, Floats]:
            place = plan.at(s)
            return place.point + aside * place.normal, place.normal

        self.seam: Any = SimpleNamespace(refined=SimpleNamespace(frame=frame, noise=0.0))
        self.mode, self.side, self.phase, self.reason = "tactile", 1.0, "following", ""
        self.tip, self.torch, self.wanted, self.aim = DISTANCE, 0.0, 2e-3, 0.0
        self.sigma, self.bound, self.band = SIGMA, 0.0, 0.0
        self.welding = SimpleNamespace(arc_from=0.0)
        self.sensing = SimpleNamespace(learned=SweepFit(dead_time=0.08, lag=0.05))
        self.ends = False

    def step(self, pose: Any, touches: Any) -> Command:
        self.phase = "done" if self.ends else "following"
        return STILL

    @property
    def arc_from(self) -> Any:
        return self.welding.arc_from

    def kept(self) -> Any:
        return ResumePoint(np.zeros((1, 5)), self.torch, self.sensing.learned)


def passes(
    *asked: dict[str, Any], points: Any = None, aside: float = 0.0, before: Any = None,
    start: Any = None, **given: Any,
) -> Any:  # fmt: skip
    settings = Following.model_validate({"passes": list(asked), **given})
    plan = Path(straight(LENGTH) if points is None else points)
    root: Any = Root(plan, aside)
    root.task = WeldTask(plan, ModelPrior(DISTANCE), settings, before=before, given=start)
    return MultiPassController(root)


def rooted(found: Any, height: float = -1e-3) -> Any:
    """Let the root pass go to its end, with the tool's end point at a height [m]."""
    for s in np.arange(0.0, LENGTH + 1e-4, 1e-3).tolist():
        found.root.torch = s
        found.step(pose(s + DISTANCE, z=height), [])
    found.root.ends = True
    found.step(pose(LENGTH + DISTANCE, z=height), [])
    return found


def driven(found: Any, start: Any, until: str, longest: float = 90.0) -> list[tuple[Any, Any, str]]:
    """Let an arm that is never late carry out what is commanded, until a phase has ended."""
    found._response.dead_time = found._response.lag = 0.0
    rows, here, seen = [], start, False
    while here.time < longest:
        command = found.step(here, [])
        rows.append((here, command, found.phase))
        seen = seen or found.phase == until
        if found.phase in ("done", "stopped") or (seen and found.phase != until):
            return rows
        here = ToolPose(
            here.time + 8e-3, here.position + 8e-3 * command.velocity,
            here.angle + 8e-3 * command.turn,
        )  # fmt: skip
    raise AssertionError(found.phase)


def test_the_height_of_the_root_pass_is_kept_every_half_millimetre() -> None:
    plan = Path(straight(LENGTH))
    root: Any = Root(plan)
    traced = RootPass(root, plan, np.zeros((0, 3)))
    for s in np.arange(0.0, 10e-3, 0.1e-3).tolist():
        root.torch, root.sigma = s, SIGMA + s
        traced.note(2 * s)
    along, height, sigma = np.array(traced.rows).T
    assert np.diff(along) == pytest.approx(0.5e-3, abs=0.11e-3)
    assert along[0] == 0.0 and len(along) in range(16, 21)
    assert height == pytest.approx(2 * along) and sigma == pytest.approx(SIGMA + along)
    later = RootPass(root, plan, np.array(traced.rows))
    assert later.rows == traced.rows and later.sigma(4e-3) == pytest.approx(SIGMA + 4e-3)


@pytest.mark.parametrize("points", [straight(LENGTH), circle(RADIUS, LENGTH / RADIUS)])
def test_a_pass_goes_aside_of_what_was_found_and_higher_than_the_tool_was(points: Any) -> None:
    found = rooted(passes({"across": "2 mm", "up": "4 mm"}, points=points,
                          aside=0.5e-3))  # fmt: skip
    path, plan = found._path, Path(points)
    assert found.phase == "returning" and found.number == 1
    for end, s in ((0.0, 0.0), (path.length, LENGTH)):
        there, place = path.at(end), plan.at(s)
        assert there.point == pytest.approx(place.point + 2.5e-3 * place.normal, abs=0.3e-3)
        assert (there.point - place.point) @ place.normal == pytest.approx(2.5e-3, abs=2e-5)
        assert there.height == pytest.approx(-1e-3 + 4e-3)
    assert found.aim == 2e-3 and found.bound == found.sigma == found.wanted == 0.0
    assert found.torch == found.band == 0.0 and found.tip == DISTANCE


def test_between_passes_the_tool_is_lifted_crosses_and_comes_down_where_the_pass_begins() -> None:
    found = rooted(passes({"across": "2 mm", "up": "3 mm"}))
    start = pose(LENGTH + DISTANCE, 1e-3, -1e-3, 0.3)
    rows = driven(found, start, "returning")
    higher, speed = 2e-3 + 15e-3, found._settings.return_speed
    heights = np.array([row[0].position[2] for row in rows])
    places = np.array([row[0].position for row in rows])
    assert heights.max() == pytest.approx(higher, abs=0.2e-3)
    crossing = np.linalg.norm(places[:, :2] - start.position[:2], axis=1) > 1e-4
    away = np.linalg.norm(places[:, :2] - [DISTANCE, 2e-3], axis=1) > 1e-3
    assert heights[crossing & away].min() > higher - 5e-3 - 0.5e-3
    last = rows[-1][0]
    assert last.position == pytest.approx([DISTANCE, 2e-3, 2e-3], abs=0.15e-3)
    assert abs(last.angle) < math.radians(0.2)
    fastest = [np.linalg.norm(row[1].velocity[:2]) for row in rows[:-1]]
    assert max(fastest) == pytest.approx(speed)
    assert max(abs(row[1].velocity[2]) for row in rows[:-1]) == pytest.approx(speed)
    assert max(abs(row[1].turn) for row in rows[:-1]) <= found._settings.turn_rate


@pytest.mark.parametrize("points", [straight(LENGTH), circle(RADIUS, LENGTH / RADIUS)])
def test_the_torch_goes_along_its_pass_and_the_passes_after_it_follow(points: Any) -> None:
    found = rooted(
        passes({"across": "1 mm"}, {"across": "-2 mm"}, points=points),
        height=0.0,
    )
    for number in (1, 2):
        begins = found._path.at(0.0)
        heading = math.atan2(begins.tangent[1], begins.tangent[0])
        x, y = (begins.point + DISTANCE * begins.tangent).tolist()
        path = found._path
        rows = driven(found, pose(x, y, begins.height, heading), "passing")
        torches = [
            row[0].position[:2] - DISTANCE * row[0].direction for row in rows if row[2] == "passing"
        ]
        along = 0.0
        for torch in torches[:: len(torches) // 10]:
            along = path.foot(torch, along)
            assert np.linalg.norm(torch - path.at(along).point) < 0.15e-3
        speed = np.linalg.norm(np.diff(np.array(torches), axis=0), axis=1) / 8e-3
        assert np.median(speed) == pytest.approx(5e-3, rel=0.01)
        assert found.number == min(number + 1, 2)
    assert found.phase == "done"


def passing(found: Any, torch: float = 0.03) -> Any:
    found.phase, found.torch = "passing", torch
    return found


def test_a_torch_that_is_off_and_a_tool_that_is_askew_are_brought_back() -> None:
    found = passing(rooted(passes({"up": "3 mm"}), height=0.0))
    turn = 2.0 * -0.02  # towards the path's heading, at two a second
    command = found._weld(
        pose(0.03 + DISTANCE * math.cos(0.02), DISTANCE * math.sin(0.02), 3e-3, 0.02)
    )
    assert command.turn == pytest.approx(turn)
    assert command.velocity[1] == pytest.approx(DISTANCE * turn * math.cos(0.02))
    passing(found)
    command = found._weld(pose(0.03 + DISTANCE, 0.2e-3, 2e-3))
    assert command.velocity == pytest.approx([5e-3, -2 * 0.2e-3, 3.0 * 1e-3])
    assert command.turn == pytest.approx(0.0, abs=1e-9)
    passing(found)
    assert found._weld(pose(0.0304 + DISTANCE, 0.0, 3e-3)) and found.torch == pytest.approx(0.0304)
    assert found.tip == pytest.approx(0.0304 + DISTANCE)
    found._weld(pose(0.05 + DISTANCE, 0.0, 3e-3))  # a tenth of a second's way at most
    assert found.torch == pytest.approx(0.0309)


def test_a_pass_is_known_as_the_root_was_and_by_what_arm_and_heat_do_since() -> None:
    asked: dict[str, Any] = {"arm_sigma": "0.04 mm", "distortion": "0.07 mm", "max_error": "1 mm"}
    found = passing(rooted(passes({"weave_width": "2 mm"}, **asked)))
    late = (math.pi * 2e-3 * 10e-3) ** 2 / 2
    sigma = math.sqrt(SIGMA**2 + (2 * 0.04e-3) ** 2 + (0.07e-3) ** 2 + late)
    found._estimate(-0.2e-3)
    assert found.sigma == pytest.approx(sigma)
    assert found.band == pytest.approx(0.2e-3 + 2 * sigma)
    assert found.bound == pytest.approx(0.2e-3 + found._sigmas * sigma)
    assert found.phase == "passing"
    found._estimate(1e-3 - 0.999 * found._sigmas * sigma)
    assert found.phase == "stopped" and found.reason == (
        "in pass 2 the torch is known to 1.00 mm only, max_error is 1 mm"
    )
    found._traced._sigma = np.linspace(0.0, 1e-3, len(found._traced._along))
    found.torch = 0.05
    found._estimate(0.0)  # the seam as it was known where the torch is now
    assert found.sigma**2 - sigma**2 + SIGMA**2 == pytest.approx((0.5e-3) ** 2, rel=0.02)


def test_a_later_pass_is_gone_on_with_where_it_was() -> None:
    first = passing(rooted(passes({}, {"across": "1 mm"})), 0.03)
    kept = first.kept()
    assert kept.number == 1 and kept.torch == pytest.approx(0.03)
    assert kept.traced == pytest.approx(np.array(first._traced.rows))
    again = passes({}, {"across": "1 mm"}, before=kept, start=WeldStart(0.06, 25e-3))
    assert again.number == 1 and again.phase == "returning"
    assert again.torch == again._start == pytest.approx(25e-3)
    assert again.root.sensing.learned == kept.learned and again.arc_from == 25e-3
    assert again._response.dead_time == 0.08
    assert again.root.seam.refined.noise == kept.learned.noise
    begun = passes({})
    begun.root.torch = 0.02
    begun.step(pose(0.06), [])
    assert begun.kept().number == 0 and begun.kept().torch == 0.02
    assert len(begun.kept().traced) == 1


def test_a_torch_on_its_swing_goes_on_with_it_and_one_beside_it_is_brought_back() -> None:
    found = rooted(passes({"up": "3 mm", "weave_width": "4 mm"}, weave_frequency=0.5), 0.0)
    found._response.dead_time = found._response.lag = 0.0
    turn, half = math.pi, 2e-3
    for off in (0.0, 0.3e-3, -0.3e-3):
        passing(found)._began = 5.0
        aside, rate = half * math.sin(turn * 0.3), half * turn * math.cos(turn * 0.3)
        there = pose(0.03 + DISTANCE, aside + off, 3e-3, time=5.3)
        assert found._weld(there).velocity[1] == pytest.approx(rate - 2 * off)
        assert found.band == pytest.approx(abs(off) + 2 * found.sigma)

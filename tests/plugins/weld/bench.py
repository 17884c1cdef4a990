"""The controller against the simulated groove, without images and without an arm."""

from dataclasses import dataclass

import numpy as np

from flangeye.motion.seam_following import ToolPose, Touch, turned
from flangeye_emulators.weld_world.groove import Groove, GrooveSection, Tip, TipContact
from flangeye_plugins.weld.following.follower import Follower
from flangeye_plugins.weld.following.model_prior import ModelPrior
from flangeye_plugins.weld.following.task import WeldTask
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following

DISTANCE = 40e-3
SECTION = GrooveSection(np.pi / 6, 8e-3)
PERIOD = 16e-3
FRAME = 1 / 30
COLUMNS = ("time", "torch_s", "torch", "tip_s", "tip", "robot", "turn", "advance")


def straight(length=0.12):
    x = np.linspace(0, length, 200)
    return np.column_stack([x, 0 * x, 0 * x])


def curved(length=0.12):
    x = np.linspace(0, length, 400)
    return np.column_stack([x, 0.012 * np.sin(2 * np.pi * x / 0.15), 0 * x])


def misplaced(points, shift=(0.0, 0.0, 0.0), turn=0.0, tilt=0.0):
    """The points shifted [m], turned about the vertical and tilted [rad] about their middle."""
    c, s = np.cos(turn), np.sin(turn)
    from_middle = points - points.mean(axis=0)
    out = from_middle @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    out[:, 2] += tilt * from_middle[:, 0]
    return out + points.mean(axis=0) + shift


def planning_error(points, seed, shift=3e-3, turn=np.pi / 180):
    """3 mm in a random direction of the plane, 1 degree to a random side."""
    rng = np.random.default_rng(seed)
    way = rng.uniform(0, 2 * np.pi)
    return misplaced(
        points, (shift * np.cos(way), shift * np.sin(way), 0.0), rng.choice([-1, 1]) * turn
    )


@dataclass
class Weld:
    """What happened: one row a cycle, lengths [m], angles [rad], times [s]."""

    controller: object
    time: np.ndarray
    torch_s: np.ndarray
    torch: np.ndarray
    tip_s: np.ndarray
    tip: np.ndarray
    robot: np.ndarray
    turn: np.ndarray
    advance: np.ndarray
    phase: list

    def deviation(self, start=0.0, end=np.inf):
        """The torch's distance from the true seam, signed, where it is between two arc lengths."""
        return self.torch[(self.torch_s > start) & (self.torch_s < min(end, self.length))]

    length = 0.12


def make(mode, plan, settings):
    return Follower(WeldTask(Path(plan), ModelPrior(DISTANCE), settings, mode == "tactile"))


def weld(true, plan, mode="tactile", settings=None, **world):
    settings = settings or Following()
    return World(true, plan, make(mode, plan, settings), settings, **world).run()


class World:
    def __init__(
        self, true, plan, controller, settings, *, gaps=(), seed=0, latency=0.03, noise=10e-6,
        angle=0.0, above=12e-3, hidden=None, longest=80.0, period=PERIOD, start=None,
    ):  # fmt: skip
        self.root = Path(true)
        self.contact = TipContact(Groove(self.root, SECTION, gaps), Tip())
        self.controller = controller
        start = Path(plan).at(settings.set_down if start is None else start)
        self.position = np.array([*start.point, start.height + above])
        self.angle = np.arctan2(start.tangent[1], start.tangent[0]) + angle
        self.rng = np.random.default_rng(seed)
        self.latency, self.noise, self.hidden, self.longest = latency, noise, hidden, longest
        self.period = period
        self.under_way, self.next_image, self.torch_s = [], 1.0, -DISTANCE

    def run(self):
        rows, phases, time = [], [], 1.0
        while time < self.longest:
            tip = self.contact.settle(self.position)
            self.expose(time, tip)
            pose = ToolPose(time, self.position.copy(), self.angle)
            command = self.controller.step(pose, self.arrived(time))
            rows.append(self.row(time, tip, command))
            phases.append(self.controller.phase)
            if self.controller.phase in ("done", "stopped"):
                break
            self.position = self.position + command.velocity * self.period
            self.angle += command.turn * self.period
            time += self.period
        columns = dict(zip(COLUMNS, np.array(rows).T, strict=True))
        done = Weld(self.controller, phase=phases, **columns)
        done.length = self.root.length
        return done

    def expose(self, time, tip):
        if time < self.next_image:
            return
        self.next_image += FRAME
        if self.hidden and self.hidden[0] <= time < self.hidden[1]:
            return
        moved = turned(tip - self.position, -self.angle)
        noise = self.rng.normal(0, [self.noise, self.noise, 6 * self.noise])
        self.under_way.append((time + self.latency, Touch(time, moved + noise)))

    def arrived(self, time):
        ready = self.under_way and self.under_way[0][0] <= time
        return [self.under_way.pop(0)[1]] if ready else []

    def row(self, time, tip, command):
        direction = np.array([np.cos(self.angle), np.sin(self.angle)])
        torch = self.position[:2] - DISTANCE * direction
        self.torch_s = self.root.foot(torch, self.torch_s)
        at_tip = self.root.foot(tip[:2], self.contact._s)
        return (
            time, self.torch_s, self.off(torch, self.torch_s), at_tip, self.off(tip[:2], at_tip),
            self.off(self.position[:2], at_tip), command.turn, getattr(self.controller, "tip", 0.0),
        )  # fmt: skip

    def off(self, point, s):
        place = self.root.at(s)
        return (point - place.point) @ place.normal

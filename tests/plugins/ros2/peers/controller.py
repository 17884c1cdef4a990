# mypy: ignore-errors
"""An arm behind a joint_trajectory_controller, as ros2_control has one; a simulation of both.

It takes joint trajectories as that controller does: those that are not of its joints, run backwards,
end while moving or began so long ago that they are over are rejected, a new one replaces the one
before from where the arm is, cubics lead from point to point. It is late by a stated latency. The
joint states are shuffled, hold a gripper's joint too, and tell angles with the joints' zero errors,
whole or split in two messages; another node's speeds come right after each of them;
where the arm really is goes out on /truth, which no driver listens to. It may run a program of its
own, from place to place, as in production.
"""

import json
import os
import random
import sys
import threading
import time
from collections import deque
from contextlib import suppress
from itertools import pairwise

import numpy as np
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye_emulators.controllers.arm import joint_zeros
from tests.plugins.ros2.peers.node import LATCHED, SENSOR, rclpy, say, serve
from tests.plugins.ros2.urdf import names_of, urdf_of

CYCLE = 0.004
REMEMBERED = 2500


class Controller:
    def __init__(self, node, options):
        self.node, self.options = node, options
        model = load_model("robots", options["robot"])
        self.names = names_of(model, options["prefix"])
        self.joints = self.command = np.radians(options["joints"])
        self.speeds = np.zeros(len(self.joints))
        self.arm = Arm(model)
        self.zeros = joint_zeros(model, options["seed"])
        self.trajectory, self.queue = [], deque()
        self.silent_until, self.rejects, self.jump, self.stamped = 0.0, False, 0.0, True
        self.now = time.monotonic()
        self.clock = 100.0 if options["sim_time"] else time.time()
        self.history, self.taken = deque(maxlen=REMEMBERED), 0
        self.program, self.next_move = deque(), 0.0
        self.lock = threading.Lock()
        space = options["namespace"]
        quality = SENSOR if options["best_effort"] else 10
        self.states = node.create_publisher(JointState, f"{space}/joint_states", quality)
        self.truth = node.create_publisher(JointState, "/truth", 10)
        self.about = node.create_publisher(String, f"{space}/robot_description", LATCHED)
        self.about.publish(String(data=urdf_of(model, options["prefix"], options["ends"])))
        self.ticks = node.create_publisher(Clock, "/clock", 10) if options["sim_time"] else None
        if options["controller"]:
            topic = f"{space}/{options['controller']}/joint_trajectory"
            node.create_subscription(JointTrajectory, topic, self.arrives, 10)

    def arrives(self, message):
        with self.lock:
            self.queue.append((time.monotonic() + self.options["latency"], message))

    def obey(self, words):
        with self.lock:
            if "silent" in words:
                self.silent_until = time.monotonic() + words["silent"]
            if "jump" in words:
                self.jump = words["jump"]
            if "nan" in words:
                self.joints = self.joints * np.nan
            if "hand" in words:  # a person moves the arm there, in so many seconds
                goal = np.array(words["hand"])
                self.trajectory = self.cubics([(goal, np.zeros_like(goal), words["seconds"])])
            if "program" in words:  # over and over, two seconds of motion and so many at rest
                self.program, self.stands = deque(map(np.array, words["program"])), words["stands"]
            self.rejects = words.get("rejects", self.rejects)
            self.stamped = words.get("stamped", self.stamped)
            if "truth" in words:
                twist = self.arm.jacobian(self.joints) @ self.speeds
                say(time=self.now, speed=float(np.linalg.norm(twist[3:])))
            if "history" in words:
                say(history=list(self.history), taken=self.taken, joints=self.joints.tolist())

    def accept(self, message):
        """As the controller's own validate_trajectory_msg."""
        if self.rejects or set(message.joint_names) != set(self.names) or not message.points:
            return
        order = [message.joint_names.index(name) for name in self.names]
        points = []
        for point in message.points:
            after = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
            if points and after <= points[-1][2]:
                return
            points.append(
                (np.array(point.positions)[order], np.array(point.velocities)[order], after)
            )
        if points[-1][1].any():
            return
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        late = self.clock - stamp if stamp else 0.0
        if points[-1][2] < late:
            return
        self.taken += 1
        self.trajectory = self.cubics(points, late)

    def cubics(self, points, late=0.0):
        """Segments, and when they began; before the first point, from where the arm is measured."""
        start = [(self.joints, self.speeds, late), *(p for p in points if p[2] > late)]
        if any(p[2] <= late for p in points):
            start[0] = max((p for p in points if p[2] <= late), key=lambda p: p[2])
        now = time.monotonic()
        return [(now, late, a, b) for a, b in pairwise(start)]

    def step(self):
        now, before = time.monotonic(), self.joints
        self.clock += (now - self.now) if self.options["sim_time"] else time.time() - self.clock
        self.now = now
        if self.program and now > self.next_move:
            goal, self.next_move = self.program[0], now + 2.0 + self.stands
            self.trajectory = self.cubics([(goal, np.zeros_like(goal), 2.0)])
            self.program.rotate(-1)
        while self.queue and self.queue[0][0] <= now:
            self.accept(self.queue.popleft()[1])
        last = self.command
        self.command, _ = self.at(now)
        hurry = float(np.abs(self.command - last).max()) / CYCLE
        follow = CYCLE / max(self.options["lag"], CYCLE)
        self.joints = self.joints + follow * (self.command - self.joints)
        if np.abs(self.command - self.joints).max() < 1e-6:
            self.joints = self.command
        self.speeds = (self.joints - before) / CYCLE
        self.history.append((now, float(np.abs(self.speeds).max()), hurry))

    def at(self, now):
        for taken, late, (p0, v0, t0), (p1, v1, t1) in self.trajectory:
            time_in = late + (now - taken)
            if time_in < t1:
                span = t1 - t0
                s = np.clip((time_in - t0) / span, 0.0, 1.0)
                a, b = p1 - p0 - v0 * span, (v1 - v0) * span
                c2, c3 = 3 * a - b, b - 2 * a
                place = p0 + v0 * span * s + c2 * s**2 + c3 * s**3
                return place, (v0 * span + 2 * c2 * s + 3 * c3 * s**2) / span
        place = self.trajectory[-1][3][0] if self.trajectory else self.command
        return place, np.zeros_like(self.speeds)

    def tell(self, count):
        if time.monotonic() < self.silent_until:
            return
        stamp = (self.clock + self.jump) * self.stamped
        if self.ticks:
            tick = Clock()
            tick.clock.sec, tick.clock.nanosec = int(stamp), int(stamp % 1 * 1e9)
            self.ticks.publish(tick)
        order = list(range(len(self.names)))
        random.Random(1).shuffle(order)
        message = JointState()
        message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), int(stamp % 1 * 1e9)
        names = ["gripper_finger", *(self.names[i] for i in order)]
        angles = [0.01, *(float(self.joints[i]) for i in order)]
        for some in (slice(3), slice(3, None)) if self.options["split"] else (slice(None),):
            message.name, message.position = names[some], angles[some]
            self.states.publish(message)
        other = JointState(header=message.header, name=["rail"], velocity=[0.0])
        self.states.publish(other)
        real = JointState(header=message.header, position=(self.joints + self.zeros).tolist())
        self.truth.publish(real)

    def run(self):
        count, due = 0, time.monotonic()
        while True:
            with self.lock:
                self.step()
                if count % 2 == 0:
                    self.tell(count // 2)
            count, due = count + 1, due + CYCLE
            time.sleep(max(0.0, due - time.monotonic()))


def main():
    options = json.loads(sys.argv[1])
    with suppress(OSError):  # as a real controller: on a machine that is busy with tests, too
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    rclpy.init()
    node = rclpy.create_node("controller_manager")
    controller = Controller(node, options)
    threading.Thread(target=controller.run, daemon=True).start()
    serve(node, controller.obey)


if __name__ == "__main__":
    main()

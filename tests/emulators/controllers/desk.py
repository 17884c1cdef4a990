"""A controller in simulated time."""

from __future__ import annotations

import numpy as np

from flangeye.models.loading import load_model
from flangeye_emulators.controllers.poses import pose_matrix, twist_between
from flangeye_emulators.controllers.ur.controller import Runtime, URController
from flangeye_emulators.controllers.ur.script import ControlScript

READY, DONE = ControlScript.ready, ControlScript.done

HOME = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])


def away(vector, *offset):
    """Return a vector moved by an offset."""
    return vector + np.array(offset, dtype=float)


class Desk:
    """A controller that runs the control script, driven through its registers as a client does."""

    def __init__(self, model="ur5e", joints=HOME, offset=0, zeros=None):
        zeros = np.zeros(6) if zeros is None else zeros
        self.box = URController(load_model("robots", model), np.array(joints), zeros)
        self.arm = self.box.arm
        self.offset = offset
        self.box.load(ControlScript(self.box, offset).cycle, "rtde_control")
        self.trace = []
        self.run(1)

    def run(self, cycles):
        for _ in range(cycles):
            self.box.step()
            self.trace.append((self.arm.stance, self.arm.speeds, self.arm.twist, self.arm.felt))

    def seconds(self, seconds):
        self.run(round(seconds / self.arm.cycle))

    def write(self, code, numbers=(), integers=()):
        for i, value in enumerate(numbers):
            self.box.registers.input_double[self.offset + i] = float(value)
        for i, value in enumerate(integers):
            self.box.registers.input_int[self.offset + 1 + i] = int(value)
        self.box.set_input_int(self.offset, code)

    def answer(self):
        return self.box.registers.output_int[self.offset]

    def order(self, code, numbers=(), integers=(), patience=20.0):
        """Give a command and wait until it is done; return whether it was."""
        self.write(code, numbers, integers or [0])
        for _ in range(round(patience / self.arm.cycle)):
            self.run(1)
            if self.answer() == DONE or self.box.runtime is not Runtime.PLAYING:
                break
        done = self.answer() == DONE and self.box.runtime is Runtime.PLAYING
        self.write(0)
        self.run(1)
        assert not done or self.answer() == READY
        return done

    def stream(self, code, numbers=(), integers=(), seconds=0.002):
        self.write(code, numbers, integers)
        self.seconds(seconds)

    def given(self, count=6):
        first = self.offset
        return np.array(self.box.registers.output_double[first : first + count])

    def progress(self):
        """The progress of a background operation, or None."""
        word = self.box.registers.output_int[self.offset + 2]
        return word & 0x7FFF if word & 0x8000 else None

    def pose(self):
        return self.box.tcp_pose()

    def misses(self, target):
        """How far the tool is from a pose, in translation and rotation together."""
        return np.abs(twist_between(self.arm.stance.base_T_tcp, pose_matrix(target))).max()

    def log(self):
        return [what for _, what in self.box.log]

    def positions(self):
        return np.array([stance.base_T_tcp[:3, 3] for stance, *_ in self.trace])

    def joints(self):
        return np.array([stance.joints for stance, *_ in self.trace])

"""The whole controller as a process: ports, clock, control channel."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import selectors
import signal
import sys
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from flangeye.loopback import LoopbackOptions
from flangeye_plugins.loopback import control
from flangeye_plugins.loopback.clock import Clock
from flangeye_plugins.loopback.contact import Surface
from flangeye_plugins.loopback.faults import Schedule, parse_fault
from flangeye_plugins.loopback.network import Network
from flangeye_plugins.loopback.start import joint_zeros, starting_joints
from flangeye_plugins.loopback.ur import dashboard, rtde, scriptport
from flangeye_plugins.loopback.ur.controller import URController
from flangeye_plugins.loopback.ur.faults import Mischief


def serve(options: LoopbackOptions) -> None:
    """Run a controller until the process is told to end.

    Raises:
        StageError: A port is taken, or an option is wrong.
    """
    # The select selector waits to the microsecond; epoll's timeout is in milliseconds.
    with asyncio.Runner(loop_factory=_precise_loop) as runner:
        runner.run(Server(options).run())


def _precise_loop() -> asyncio.AbstractEventLoop:
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


def _take_precedence() -> None:
    """Make the cycle punctual: run before others, and keep the collector's rounds short.

    A robot's controller has a processor of its own. This one takes a quarter of a core; without
    the right to come first (root has it) it is as punctual as the machine is idle.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    gc.collect()
    gc.freeze()


class Server:
    """One controller and all its ports."""

    def __init__(self, options: LoopbackOptions) -> None:
        """Switch the controller on; nothing listens yet."""
        self._options = options
        zeros = joint_zeros(options.robot, options.seed)
        self._home = starting_joints(options.robot, options.joints)
        self._box = URController(options.robot, self._home, zeros)
        if options.floor is not None:
            self._box.arm.surfaces.append(Surface.floor(options.floor))
        self._network = Network(options.host)
        self._rtde = rtde.RtdePort(self._network, self._box)
        self._network.offer(
            scriptport.PORT, lambda: scriptport.ScriptSession(self._network, self._box)
        )
        self._network.offer(
            dashboard.PORT, lambda: dashboard.DashboardSession(self._network, self._box)
        )
        # The control channel has a wire of its own, to which nothing happens.
        self._behind = Network(options.host)
        self._behind.offer(
            control.PORT, lambda: control.ControlSession(self._behind, self._actions)
        )
        self._mischief = Mischief(self._box, self._network)
        self._schedule = Schedule(self._mischief.kinds)
        self._clock = Clock(self._box.box.cycle, self._step)
        self._cycle = 0
        self._actions: dict[str, control.Action] = {
            "truth": self._tell_truth,
            "state": self._tell_state,
            "log": self._tell_log,
            "figures": self._tell_figures,
            "fault": self._cause,
            "clear": self._clear,
            "reset": self._reset,
            "surfaces": self._set_surfaces,
            "put": self._put,
            "unlock-after": self._set_unlock,
        }

    async def run(self) -> None:
        """Listen and step until a signal comes."""
        ended = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, ended.set)
        for text in self._options.faults:
            self._add_fault(text)
        await self._network.listen()
        await self._behind.listen()
        _take_precedence()
        self._clock.start()
        self._say(self._greeting())
        await ended.wait()
        self._network.kill()
        self._behind.kill()
        self._say(self._farewell())

    def _step(self) -> None:
        self._cycle += 1
        self._schedule.step(self._box.time, not self._box.arm.standing)
        self._box.step()
        self._rtde.publish(self._cycle)

    def _say(self, text: str) -> None:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()

    def _greeting(self) -> str:
        return (
            f"{self._options.robot.model} on {self._options.host}: RTDE {rtde.PORT}, "
            f"script {scriptport.PORT}, dashboard {dashboard.PORT}, "
            f"control {control.PORT}; Ctrl-C ends it"
        )

    def _farewell(self) -> str:
        figures = self._clock.figures()
        return (
            f"{figures['ticks']} cycles, late by {1e3 * figures.get('late_median', 0):.2f} ms "
            f"(median), {1e3 * figures.get('late_p99', 0):.2f} ms (99 %), "
            f"{1e3 * figures.get('late_max', 0):.2f} ms (worst)"
        )

    # The control channel

    def _tell_truth(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        del request
        arm = self._box.arm
        return {
            "base_T_flange": arm.true_flange().tolist(),
            "joints": (arm.stance.joints + arm.zeros).tolist(),
            "speed": float(np.abs(arm.speeds).max()),
            "time": self._box.time,
        }

    def _tell_state(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        del request
        box = self._box
        return {
            "time": box.time,
            "robot_mode": box.robot_mode.name,
            "safety": box.safety.name,
            "runtime": box.runtime.name,
            "remote_control": box.remote_control,
            "joints": box.arm.stance.joints.tolist(),
            "speeds": box.arm.speeds.tolist(),
            "twist": box.arm.twist.tolist(),
            "force": box.arm.felt.tolist(),
            "slider": box.arm.slider,
            "connections": len(self._network.connections),
        }

    def _tell_log(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        del request
        return {"lines": list(self._box.log)}

    def _tell_figures(self, request: Mapping[str, Any]) -> Mapping[str, Any]:
        del request
        return {**self._clock.figures(), "cpu": time.process_time()}

    def _add_fault(self, text: str) -> None:
        fault = parse_fault(text, self._mischief.kinds)
        self._schedule.add(fault, self._box.time)

    def _cause(self, request: Mapping[str, Any]) -> None:
        self._add_fault(str(request["fault"]))
        self._schedule.step(self._box.time, not self._box.arm.standing)

    def _clear(self, request: Mapping[str, Any]) -> None:
        del request
        self._schedule.clear()
        self._mischief.clear()

    def _reset(self, request: Mapping[str, Any]) -> None:
        self._clear(request)
        self._box.reset(self._home)

    def _set_surfaces(self, request: Mapping[str, Any]) -> None:
        self._box.arm.surfaces = [Surface(**surface) for surface in request["surfaces"]]

    def _put(self, request: Mapping[str, Any]) -> None:
        self._box.arm.put(starting_joints(self._options.robot, request["joints"]))

    def _set_unlock(self, request: Mapping[str, Any]) -> None:
        self._box.unlock_after = float(request["seconds"])

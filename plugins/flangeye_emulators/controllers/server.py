"""A controller process: ports, clock and control channel, for arms of any maker.

Requests and answers on the control channel are one JSON object per line: ``{"do": "state"}`` is
answered by ``{"ok": true, ...}`` or ``{"ok": false, "error": "..."}``. No real robot has this
channel. Tests and the simulated scanner use it to read the true state and to inject faults.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import json
import os
import selectors
import signal
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np

from flangeye.errors import FlangeyeError
from flangeye.files.remote import is_this_machine
from flangeye.models.graph import EmulatorOptions
from flangeye_emulators.controllers.arm import ControlUnit, SpringSurface, starting_joints
from flangeye_emulators.controllers.client import CONTROL_PORT
from flangeye_emulators.controllers.network import (
    FaultInjector,
    LineConnection,
    Network,
    Schedule,
    parse_fault,
)


def run_server(server: Server, publish: Callable[[int], None] = lambda cycle: None) -> None:
    """Run a controller until the process is told to stop.

    Args:
        server: The controller and its ports.
        publish: Called after every cycle with the cycle's number.

    Raises:
        StageError: A port is taken, or an option is wrong.
    """
    # The select selector waits to the microsecond; epoll's timeout is in milliseconds.
    with asyncio.Runner(loop_factory=_precise_loop) as runner:
        runner.run(server.run(publish))


def _precise_loop() -> asyncio.AbstractEventLoop:
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


def _end_with_input(ended: asyncio.Event) -> None:
    """Set ``ended`` when standard input closes, which happens when the parent process ends."""
    if not os.read(sys.stdin.fileno(), 4096):
        ended.set()


def _take_realtime_priority() -> None:
    """Raise the process's priority and tune the garbage collector, for punctual cycles.

    A real controller has its own processor; this one takes a quarter of a core. Raising the
    priority needs root; without it the timing depends on the machine's load.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    gc.collect()
    gc.freeze()


class Server:
    """One controller and all its ports."""

    def __init__(
        self,
        options: EmulatorOptions,
        box: ControlUnit,
        network: Network,
        fault_injector: FaultInjector,
        ports: Mapping[str, int],
    ) -> None:
        """Connect a powered-on controller to its ports; nothing listens yet."""
        self._options, self._box, self._network = options, box, network
        self._fault_injector, self._ports = fault_injector, ports
        self._home = starting_joints(options.robot, options.joints)
        if options.floor is not None:
            box.arm.surfaces.append(SpringSurface.floor(options.floor))
        self._publish: Callable[[int], None] = lambda cycle: None
        # The control channel has a wire of its own, to which nothing happens. Whoever reaches it
        # moves the arm and causes faults: it does not leave this machine.
        self._behind = Network(options.host if is_this_machine(options.host) else "127.0.0.1")
        self._behind.offer(CONTROL_PORT, lambda: ControlSession(self._behind, self._actions))
        self._schedule = Schedule(self._fault_injector.kinds)
        self._clock = ControllerClock(box.cycle, self._step)
        self._cycle = 0
        self._actions: dict[str, Action] = {
            "truth": self._tell_truth,
            "state": self._tell_state,
            "log": lambda _: {"lines": list(self._box.log)},
            "figures": lambda _: {**self._clock.figures(), "cpu": time.process_time()},
            "fault": self._cause,
            "clear": self._clear,
            "reset": self._reset,
            "surfaces": self._set_surfaces,
            "put": self._put,
            "unlock-after": self._set_unlock,
        }

    async def run(self, publish: Callable[[int], None]) -> None:
        """Listen and step until a signal arrives; ``publish`` is called after every cycle."""
        self._publish = publish
        ended = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, ended.set)
        if self._options.with_input:
            asyncio.get_running_loop().add_reader(sys.stdin, _end_with_input, ended)
        for text in self._options.faults:
            self._add_fault(text)
        await self._network.listen()
        await self._behind.listen()
        _take_realtime_priority()
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
        self._publish(self._cycle)

    def _say(self, text: str) -> None:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()

    def _greeting(self) -> str:
        ports = ", ".join(f"{name} {port}" for name, port in self._ports.items())
        return (
            f"{self._options.robot.model} on {self._options.host}: {ports}, "
            f"control {CONTROL_PORT}{self._where_control_is()}; Ctrl-C ends it"
        )

    def _where_control_is(self) -> str:
        if self._behind.host == self._options.host:
            return ""
        return (
            f" on {self._behind.host} alone (from elsewhere: ssh -L {CONTROL_PORT}:"
            f"{self._behind.host}:{CONTROL_PORT} HOST)"
        )

    def _farewell(self) -> str:
        figures = self._clock.figures()
        return (
            f"{figures['ticks']} cycles, late by {1e3 * figures.get('late_median', 0):.2f} ms "
            f"(median), {1e3 * figures.get('late_p99', 0):.2f} ms (99 %), "
            f"{1e3 * figures.get('late_max', 0):.2f} ms (worst)"
        )

    # The control channel

    def _tell_truth(self, _: Mapping[str, Any]) -> Mapping[str, Any]:
        arm = self._box.arm
        return {
            "base_T_flange": arm.true_flange().tolist(),
            "joints": (arm.stance.joints + arm.zeros).tolist(),
            "speed": float(np.abs(arm.speeds).max()),
            "time": self._box.time,
        }

    def _tell_state(self, _: Mapping[str, Any]) -> Mapping[str, Any]:
        box = self._box
        return {
            "time": box.time,
            **box.modes(),
            "joints": box.arm.stance.joints.tolist(),
            "speeds": box.arm.speeds.tolist(),
            "twist": box.arm.twist.tolist(),
            "force": box.arm.felt.tolist(),
            "connections": len(self._network.connections),
        }

    def _add_fault(self, text: str) -> None:
        fault = parse_fault(text, self._fault_injector.kinds)
        self._schedule.add(fault, self._box.time)

    def _cause(self, request: Mapping[str, Any]) -> None:
        self._add_fault(str(request["fault"]))
        self._schedule.step(self._box.time, not self._box.arm.standing)

    def _clear(self, _: Mapping[str, Any]) -> None:
        self._schedule.clear()
        self._fault_injector.clear()

    def _reset(self, request: Mapping[str, Any]) -> None:
        self._clear(request)
        self._box.reset(self._home)

    def _set_surfaces(self, request: Mapping[str, Any]) -> None:
        self._box.arm.surfaces = [SpringSurface(**surface) for surface in request["surfaces"]]

    def _put(self, request: Mapping[str, Any]) -> None:
        self._box.arm.put(starting_joints(self._options.robot, request["joints"]))

    def _set_unlock(self, request: Mapping[str, Any]) -> None:
        self._box.unlock_after = float(request["seconds"])


class ControllerClock:
    """Calls a function once per cycle.

    Attributes:
        ticks: Number of steps.
        made_up: Number of late steps, made right after another to catch up.
        gaps: Number of restarts after a delay that was too long to catch up.
    """

    # Lateness is kept for so many cycles: two minutes at 500 Hz.
    kept: ClassVar[int] = 60_000

    def __init__(self, cycle: float, step: Callable[[], None]) -> None:
        self._cycle, self._step = cycle, step
        self.ticks = self.made_up = self.gaps = 0
        self._lateness = np.zeros(self.kept, dtype=np.float32)
        self._due = 0.0

    def start(self) -> None:
        """Begin now."""
        loop = asyncio.get_running_loop()
        self._due = loop.time() + self._cycle
        loop.call_at(self._due, self._tick)

    def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        self._advance(loop.time())
        while (now := loop.time()) >= self._due:
            self.made_up += 1
            self._advance(now)
        loop.call_at(self._due, self._tick)

    def _advance(self, now: float) -> None:
        late = now - self._due
        self._lateness[self.ticks % self.kept] = late
        # Cycles missed for less than this [s] are made up for at once; after a longer gap (the
        # process was stopped) the clock starts again from now, and the gap is counted
        if late > 0.05:
            self.gaps += 1
            self._due = now
        self.ticks += 1
        self._due += self._cycle
        self._step()

    def figures(self) -> dict[str, float]:
        """Return statistics of the steps' timing [s]."""
        late = self._lateness[: min(self.ticks, self.kept)]
        if not len(late):
            return {"ticks": 0}
        median, high = np.percentile(late, [50, 99])
        return {
            "ticks": self.ticks,
            "made_up": self.made_up,
            "gaps": self.gaps,
            "late_median": float(median),
            "late_p99": float(high),
            "late_max": float(late.max()),
        }


Action = Callable[[Mapping[str, Any]], Mapping[str, Any] | None]


class ControlSession(LineConnection):
    """One client of the control channel."""

    def __init__(self, network: Network, actions: Mapping[str, Action]) -> None:
        super().__init__(network)
        self._actions = actions

    def line(self, text: str) -> None:
        """Answer one request."""
        self.say(json.dumps(self._answer(text)))

    def _answer(self, text: str) -> dict[str, Any]:
        try:
            request = json.loads(text)
            name = request["do"]
            action = self._actions.get(name)
            if action is None:
                return _refusal(f"cannot do '{name}'; can do {', '.join(self._actions)}")
            return {"ok": True, **(action(request) or {})}
        except FlangeyeError as error:
            return _refusal(str(error))
        except (ValueError, KeyError, TypeError) as error:
            return _refusal(f"not a request: {type(error).__name__}: {error}")


def _refusal(why: str) -> dict[str, Any]:
    return {"ok": False, "error": why}

"""A program in cycles: a main thread and others; only one at a time may move the arm."""

from __future__ import annotations

from collections.abc import Callable, Generator

from flangeye_emulators.controllers.arm import BRAKES, SimulatedArm
from flangeye_emulators.controllers.motion import ControllerMotion, stop

Thread = Generator[None, None, None]
"""Runs until its next yield in every cycle; ``yield`` is URScript's ``sync()``."""

MAIN = "main"


class ProgramError(Exception):
    """A URScript runtime error; the program stops."""


class Program:
    """Threads that are run cycle by cycle.

    Attributes:
        arm: What they move.
        critical: Whether only the main thread runs now.
    """

    def __init__(self, arm: SimulatedArm) -> None:
        self.arm = arm
        self.critical = False
        self._main = self.main()
        self._threads: dict[str, Thread] = {}
        self._running = MAIN
        self._driver: str | None = None

    def main(self) -> Thread:
        """Return the main thread; the program ends with it."""
        raise NotImplementedError

    def cycle(self) -> bool:
        """Run every thread to its next yield; return whether the program continues.

        Raises:
            ProgramError: A thread did what a program must not do.
        """
        self._driver = None
        if not self._advance(MAIN, self._main):
            return False
        if not self.critical:
            for name, thread in list(self._threads.items()):
                if self._threads.get(name) is thread and not self._advance(name, thread):
                    self._threads.pop(name, None)
        return True

    def _advance(self, name: str, thread: Thread) -> bool:
        self._running = name
        try:
            next(thread)
        except StopIteration:
            return False
        return True

    def start(self, name: str, thread: Thread) -> None:
        """Start a thread; one of that name that still runs is killed."""
        self._threads[name] = thread

    def kill(self, name: str) -> bool:
        """Kill a thread; return whether it ran. An arm it was moving brakes."""
        return self._threads.pop(name, None) is not None

    def runs(self, name: str) -> bool:
        """Return whether a thread of this name runs."""
        return name in self._threads

    def drive(self, motion: ControllerMotion) -> None:
        """Let a motion move the arm in this cycle.

        Raises:
            ProgramError: Another thread has moved the arm in this cycle.
        """
        if self._driver not in (None, self._running):
            raise ProgramError("another thread is already controlling the robot")
        self._driver = self._running
        self.arm.drive(motion)

    def complete(self, plan: Callable[[], ControllerMotion]) -> Thread:
        """Bring the arm to rest, then go through the motion that ``plan`` makes there."""
        if not self.arm.standing:
            yield from self.stop_joints(BRAKES)
        yield from self.follow(plan())

    def follow(self, motion: ControllerMotion) -> Thread:
        """Run a motion from the arm's present place and speed."""
        while not motion.done:
            self.drive(motion)
            yield

    def stop_joints(self, deceleration: float) -> Thread:
        """Come to rest in joint angles [rad/s^2]: URScript's ``stopj``."""
        yield from self.follow(stop(self.arm.speeds, deceleration, in_space=False))

    def stop_in_space(self, deceleration: float) -> Thread:
        """Come to rest straight on [m/s^2]: URScript's ``stopl``."""
        yield from self.follow(stop(self.arm.twist, deceleration, in_space=True))

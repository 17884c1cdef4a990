"""A controller in a process of its own."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys

from flangeye_emulators.controllers.client import EmulatorControl

addresses = itertools.count(1)


def free_address():
    """An address of this machine that no other test, worker or test run uses now."""
    count = next(addresses)
    return f"127.{64 + os.getpid() % 128}.{os.getpid() // 128 % 256}.{count % 254 + 1}"


class Process:
    """A controller in a process of its own, started as a person would."""

    def __init__(self, *arguments, model="ur5e"):
        self.host = free_address()
        command = [sys.executable, "-m", "flangeye.cli", "emulator", model, "--host", self.host]
        self._command = [*command, *arguments]
        self.start()

    def start(self):
        self.process = subprocess.Popen(self._command, stdout=subprocess.PIPE, text=True)
        self.greeting = self.process.stdout.readline()
        assert self.greeting, "the controller did not start"
        self.control = EmulatorControl(self.host)
        self.control.unlock_after(0.0)

    def send(self, number):
        os.kill(self.process.pid, number)

    def end(self, number=signal.SIGTERM):
        self.control.close()
        self.send(signal.SIGCONT)
        self.send(number)
        words, _ = self.process.communicate(timeout=10)
        return words

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.end(signal.SIGKILL)

"""A live cell on loopback: a controller, a recipe for it, and the run as a person starts it."""

import json
import subprocess
import sys
import time

from flangeye.errors import StageError
from flangeye.workflow.log.read import read_run
from tests.emulators.controllers.process import Process

START = {"ur5e": "180 -90 90 -90 -90 0 deg", "aubo-i5": "0 0 90 0 90 0 deg"}
DRIVERS = {"ur5e": "ur_rtde", "aubo-i5": "aubo"}

RECIPE = """
title: A cell on loopback
robot:
  model: {model}
  driver: {{{driver}: {{host: {host}}}}}
  limits:
    box: {{centre: [450 mm, 0 mm, 500 mm], size: [1000 mm, 1400 mm, 900 mm]}}
    speed: {speed}
    acceleration: 2 m/s^2
    joint_speed: 100 deg/s
scanner:
  model: phoxi-m
  driver: {{emulator: {{host: {host}, robot: {model}, resolution: 0.2, {scanner}}}}}
steps:
  - acquire.live:
      view: {{guess: {{position: [620 mm, 0 mm, 980 mm]}}}}
      poses: {{next_best: {{count: {count}}}}}
      verification: 0
  - segment.flange
  - fit.rim
  - solve.robust
  - verify.holdout: {{max_rms: 2 mm}}
"""


class Cell:
    """A controller on loopback and a recipe that drives it."""

    faults = (
        "protective-stop", "emergency-stop", "drop", "die", "freeze", "garbage", "latency=300 ms",
        "singularity", "joint-limit", "latency=20 ms", "program-stop", "remote-control-off",
    )  # fmt: skip
    """What may befall its controller; a controller of AUBO knows the first seven."""

    def __init__(self, folder, *arguments, model="ur5e"):
        self.folder, self._model = folder, model
        words = ("--joints", START[model], "--seed", "1")
        self.controller = Process(*words, *arguments, model=model)
        self.control = self.controller.control

    def recipe(self, count=5, scanner="seed: 1", speed="1 m/s"):
        path = self.folder / "cell.yaml"
        host = self.controller.host
        path.write_text(
            RECIPE.format(
                host=host, count=count, scanner=scanner, speed=speed, model=self._model,
                driver=DRIVERS[self._model],
            )
        )  # fmt: skip
        return path

    def start(self, *words, command="run", **terminal):
        """Start a command, ``flangeye run`` unless told otherwise, in the background."""
        return subprocess.Popen(
            [sys.executable, "-m", "flangeye.cli", command, *map(str, words)], cwd=self.folder,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            **{"stdin": subprocess.DEVNULL, **terminal},
        )  # fmt: skip

    def run(self, *words, command="run", patience=150):
        """Return exit code, output and errors of a command, ``flangeye run`` unless told otherwise."""
        process = self.start(*words, command=command)
        out, err = process.communicate(timeout=patience)
        return process.returncode, out, err

    def wait_until(self, condition, patience=60):
        deadline = time.monotonic() + patience
        while not condition():
            assert time.monotonic() < deadline, "it did not come so far"
            time.sleep(0.02)

    def moving(self):
        return self.control.truth().speed > 0.05

    def standing(self):
        return self.control.truth().speed < 1e-4

    def log(self, run="run"):
        return read_run(self.folder / run / "run.mcap")

    def finished(self, run="run"):
        """Return the captures that have gone through so far; none while there is no log yet."""
        try:
            return self.log(run).finished
        except StageError:
            return []

    def captures(self, run="run"):
        """Return the ids of the captures in a run's log, in order."""
        return list(self.log(run).poses)

    def result(self, run):
        return json.loads((self.folder / run / "result.json").read_text())

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.controller.__exit__()

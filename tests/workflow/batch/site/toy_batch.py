"""Stages that take their time, or go wrong in every way; found by workers as any plugin is."""

import os
import signal
import time
from pathlib import Path
from typing import Literal

from pydantic import Field

from flangeye import CalibrationRefused, Params, RecipePath, StageError, hookimpl, stage
from flangeye.types import ArchivePath, Captures, HandEye, Observations, Seed
from flangeye.units import Duration, param
from tests import toy


class WorkParams(Params):
    what: Literal["work", "refuse", "fail", "raise", "exit", "die", "die once"] = "work"
    wait: Duration = param("0 s", description="Time that passes without work.")
    burn: Duration = param("0 s", description="Time of the processor that is used.")
    once: str = Field("", description="File left behind by 'die once'.")
    reads: RecipePath | None = Field(None, description="A file that decides the result.")


@stage("solve.work")
def solve(observations: Observations, params: WorkParams) -> HandEye:
    """Solve after some work, or end in some other way."""
    calibration = toy.solve.function(observations, toy.SolveParams(cost=toy.toy_cost.bind()))
    time.sleep(params.wait)
    until = time.process_time() + params.burn
    while time.process_time() < until:
        pass
    _end(params.what, Path(params.once))
    return calibration


def _end(what: str, once: Path) -> None:
    if what == "refuse":
        raise CalibrationRefused("solve.work: refused")
    if what == "fail":
        raise StageError("solve.work: failed")
    if what == "raise":
        raise RuntimeError("no idea")
    if what == "exit":
        raise SystemExit(3)
    if what == "die" or (what == "die once" and not once.exists()):
        if what == "die once":
            once.touch()
        os.kill(os.getpid(), signal.SIGKILL)


@stage("acquire.toy_archive")
def acquire(archive: ArchivePath, seed: Seed) -> Captures:
    """Make captures by the number that an archive holds."""
    if archive.path is None or not archive.path.is_file():
        raise StageError(f"{archive.path}: no such archive")
    return toy.acquire.function(int(archive.path.read_text()), toy.AcquireParams())


@hookimpl
def flangeye_stages():
    return (solve, acquire)

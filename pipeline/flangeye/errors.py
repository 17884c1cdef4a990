"""Exceptions that end a run early, each with its exit code.

A message says where, what is wrong, what is allowed and what to do; the command line prints it
without a traceback.
"""

from collections.abc import Mapping
from typing import Any


class FlangeyeError(Exception):
    """An error that one line explains to the user.

    Attributes:
        exit_code: The process's exit code.
        wrong: What is wrong, and how it is known.
        advice: The one next step; empty where ``wrong`` says all.
    """

    exit_code = 2

    def __init__(self, wrong: str = "", advice: str = "") -> None:
        super().__init__(wrong)
        self.wrong, self.advice = wrong, advice

    def __str__(self) -> str:
        return "; ".join(filter(None, (self.wrong, self.advice)))


class RecipeError(FlangeyeError):
    """A recipe is wrong; one ``file:line: path: message`` a line, every mistake at once."""


class StageError(FlangeyeError):
    """A step cannot work with the input it was given."""


class NothingSeen(StageError):
    """No capture shows the target."""


class CalibrationRefused(FlangeyeError):
    """Valid input gives no reliable calibration."""

    exit_code = 1


class RunStopped(FlangeyeError):
    """The person stopped the run (Ctrl-C)."""

    exit_code = 130


class NothingMoved(FlangeyeError):
    """Motion was not allowed, so the message is the plan of motion; this is no failure.

    Attributes:
        plan: The plan as data for JSON; None if the stage gives only text.
    """

    exit_code = 0

    def __init__(self, message: str, plan: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.plan = plan

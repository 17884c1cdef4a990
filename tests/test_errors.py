"""Errors: what is wrong, and the next step."""

from __future__ import annotations

import ast
import pickle
from pathlib import Path

import pytest

import flangeye
from flangeye.errors import CalibrationRefused, StageError

ROOT = Path(flangeye.__file__).parents[2]
REFUSING = [
    *(ROOT / "pipeline/flangeye/estimation").rglob("*.py"),
    *(ROOT / "plugins/flangeye_plugins").rglob("*.py"),
]


def test_an_error_is_what_is_wrong_and_what_to_do() -> None:
    error = CalibrationRefused("all poses are alike", "move the arm")
    assert (error.wrong, error.advice) == ("all poses are alike", "move the arm")
    assert str(error) == "all poses are alike; move the arm"
    assert str(StageError("no such file")) == "no such file"


def test_the_advice_survives_another_process() -> None:
    error = pickle.loads(pickle.dumps(CalibrationRefused("all poses are alike", "move the arm")))
    assert str(error) == "all poses are alike; move the arm"


@pytest.mark.parametrize("path", REFUSING, ids=lambda path: path.name)
def test_every_refusal_has_its_advice(path: Path) -> None:
    """Where no motion is asked for, its call has the advice as an argument of its own."""
    calls = [
        call.lineno
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(call, ast.Call)
        and isinstance(call.func, ast.Name)
        and call.func.id == "CalibrationRefused"
        and len(call.args) < 2
        and not isinstance(call.args[0], ast.Starred)
    ]
    assert not calls

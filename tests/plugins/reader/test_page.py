"""The page of readers: one section each, and each section's line is taken by a recipe."""

import re
from pathlib import Path
from typing import Any

import pytest

from flangeye.plugin.registry import load_registry
from flangeye.workflow.recipe.load import parse_recipe

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "readers.md"
SECTIONS = re.findall(r"^## (\w+)\n.*?```yaml\n(.*?)```", PAGE.read_text("utf-8"), re.M | re.S)


def test_every_reader_has_a_section() -> None:
    readers = {name.partition(".")[2] for name in load_registry().parts if name[:7] == "reader."}
    assert {name for name, _ in SECTIONS} == readers


@pytest.mark.parametrize(("name", "line"), SECTIONS)
def test_its_line_is_taken_by_a_recipe(name: Any, line: Any) -> None:
    text = f"title: T\nsteps:\n  - acquire.centres:\n      {line}  - solve.svd\n"
    reader = parse_recipe(text, "page", load_registry()).steps[0].params.reader
    assert reader.part.name == f"reader.{name}"

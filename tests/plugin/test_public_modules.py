"""What is written for vendors imports public modules only."""

import re
import tomllib
from pathlib import Path

import pytest

from flangeye.plugin.scaffold import TEMPLATES

ROOT = Path(__file__).parents[2]
CONTRACT = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"][
    "contracts"
][-1]
PUBLIC = {edge.removeprefix("** -> ") for edge in CONTRACT["ignore_imports"] if "** ->" in edge}
EXAMPLES = sorted([*(ROOT / "tests" / "vendor_example").rglob("*.py"), *TEMPLATES.rglob("*.j2")])


def imported(file):
    """Return the engine's modules that a source or template names in import statements."""
    return re.findall(r"^\s*(?:from|import) (flangeye(?:\.\w+)*)", file.read_text(), re.MULTILINE)


def test_there_are_examples_that_import_the_engine() -> None:
    assert sum(bool(imported(file)) for file in EXAMPLES) > 10


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.name)
def test_an_example_imports_public_modules_only(file: Path) -> None:
    internal = [
        module
        for module in imported(file)
        if any(f"{module}.".startswith(f"{room}.") for room in CONTRACT["forbidden_modules"])
        and module not in PUBLIC
    ]
    assert internal == []

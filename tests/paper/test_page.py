"""The page of the paper's studies shows the tables and pictures that lie beside it."""

import re
from pathlib import Path
from typing import Any

import pytest

from flangeye_paper.__main__ import refreshed

FOLDER = Path(__file__).parents[2] / "recipes" / "paper"
README = FOLDER / "README.md"


def test_the_tables_are_those_of_the_csv_files() -> None:
    page = README.read_text("utf-8")
    assert refreshed(page, FOLDER) == page
    for table in sorted(FOLDER.glob("*_summary.csv")):
        assert f"<!-- begin {table.name}" in page


@pytest.mark.parametrize("target", re.findall(r"\]\(([^)#:]+)\)", README.read_text("utf-8")))
def test_links_lead_somewhere(target: Any) -> None:
    assert (FOLDER / target).exists()


def test_every_recipe_is_run_by_the_script() -> None:
    script = (FOLDER / "reproduce.sh").read_text("utf-8")
    for study in ("fig9", "fig11", "table1", "table2", "heldout"):
        for recipe in FOLDER.glob(f"{study}_*.yaml"):
            rest = recipe.stem.partition("_")[2]
            assert recipe.name in script or (f"{study}_$" in script and rest in script)


def test_it_is_small_enough_to_keep() -> None:
    kept = [path for ending in ("csv", "png", "md") for path in FOLDER.glob(f"*.{ending}")]
    assert sum(path.stat().st_size for path in kept) < 1_000_000

"""The tables of ``recipes/paper/README.md`` come from the CSV files beside it."""

from __future__ import annotations

import re
from pathlib import Path

from flangeye_paper.tables import read_csv

_BLOCK = re.compile(
    r"<!-- begin (?P<file>[\w.-]+\.csv)(?P<options>[^>]*) -->\n.*?<!-- end -->", re.DOTALL
)


def refreshed(text: str, folder: Path) -> str:
    """Return a page with the table between ``<!-- begin X.csv -->`` and ``<!-- end -->`` renewed.

    ``<!-- begin X.csv: a | b -->`` shows the columns a and b only.
    """

    def table(match: re.Match[str]) -> str:
        wanted = [c.strip() for c in match["options"].lstrip(": ").split("|") if c.strip()]
        rows = read_csv(folder / match["file"])
        head = f"<!-- begin {match['file']}{match['options']} -->"
        return f"{head}\n{markdown(rows, wanted or list(rows[0]))}\n<!-- end -->"

    return _BLOCK.sub(table, text)


def markdown(rows: list[dict[str, str]], columns: list[str]) -> str:
    """Return rows as a Markdown table."""
    lines = [columns, ["---"] * len(columns), *([row[c] for c in columns] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)

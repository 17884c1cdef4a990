"""``python -m flangeye_paper``: from the tables of batches to CSV files and pictures."""

import re
from pathlib import Path
from typing import Annotated

import typer

from flangeye import FlangeyeError
from flangeye_paper import fig9, fig10, fig11, fig13, heldout, table1, table2
from flangeye_paper.tables import read_csv

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__)
for study in (fig9, fig10, table1, table2, fig11, fig13, heldout):
    name = study.__name__.rpartition(".")[2]
    app.command(name, help=study.__doc__)(getattr(study, name))


@app.command("page")
def _page(readme: Annotated[Path, typer.Argument(help="The page to renew.")]) -> None:
    """Put the tables of the CSV files into the page beside them."""
    readme.write_text(refreshed(readme.read_text("utf-8"), readme.parent), "utf-8")


def main() -> None:
    """Run a command; an expected error is printed as one line, with exit code 2."""
    try:
        app()
    except FlangeyeError as error:
        typer.echo(f"error: {error}", err=True)
        raise SystemExit(error.exit_code) from None


if __name__ == "__main__":
    main()


def refreshed(text: str, folder: Path) -> str:
    """Return a page with the table between ``<!-- begin X.csv -->`` and ``<!-- end -->`` renewed.

    ``<!-- begin X.csv: a | b -->`` shows the columns a and b only.
    """

    def table(match: re.Match[str]) -> str:
        wanted = [c.strip() for c in match["options"].lstrip(": ").split("|") if c.strip()]
        rows = read_csv(folder / match["file"])
        head = f"<!-- begin {match['file']}{match['options']} -->"
        return f"{head}\n{markdown(rows, wanted or list(rows[0]))}\n<!-- end -->"

    return re.sub(
        r"<!-- begin (?P<file>[\w.-]+\.csv)(?P<options>[^>]*) -->\n.*?<!-- end -->",
        table,
        text,
        flags=re.DOTALL,
    )


def markdown(rows: list[dict[str, str]], columns: list[str]) -> str:
    """Return rows as a Markdown table."""
    lines = [columns, ["---"] * len(columns), *([row[c] for c in columns] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)

"""What the documents say is what the project does."""

import re
from pathlib import Path

import pytest

from tests import gallery

ROOT = Path(__file__).parents[1]
QUOTE = re.compile(r"<!-- begin (\S+) -->\n(.*?)<!-- end -->", re.S)


def quoted(path):
    """Return how a document must quote a file."""
    language = {".py": "python", ".toml": "toml", ".yaml": "yaml"}[Path(path).suffix]
    return f"```{language}\n{(ROOT / path).read_text()}```\n"


@pytest.mark.parametrize("document", ["plugins/README.md"])
def test_quoted_files_are_the_files(document):
    quotes = QUOTE.findall((ROOT / document).read_text())
    assert quotes
    for path, text in quotes:
        assert text == quoted(path), f"{document} quotes an old {path}"


@pytest.mark.parametrize("document", sorted(ROOT.glob("*.md")) + sorted(ROOT.glob("*/README.md")))
def test_links_lead_somewhere(document):
    for target in re.findall(r"\]\(([^)#]+)\)", document.read_text()):
        if "://" not in target:
            assert (document.parent / target).exists(), f"{document.name} links to {target}"


def test_the_gallery_shows_the_recipes():
    for path in (gallery.README, gallery.FRONT):
        page = path.read_text()
        assert gallery.renewed(page) == page, "python -m tests.gallery renews it"
    assert page.count("](") > 15

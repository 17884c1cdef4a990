"""What the documents say is what the project does."""

import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye.maths.kinematics import Arm
from flangeye.models.model import read_model
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import Plugin
from tests.conftest import Call
from tools import gallery

ROOT = Path(__file__).parents[1]
QUOTE = re.compile(r"<!-- begin (\S+) -->\n(.*?)<!-- end -->", re.S)


def quoted(path):
    """Return how a document must quote a file."""
    language = {".py": "python", ".toml": "toml", ".yaml": "yaml"}[Path(path).suffix]
    return f"```{language}\n{(ROOT / path).read_text()}```\n"


@pytest.mark.parametrize("document", ["plugins/README.md"])
def test_quoted_files_are_the_files(document: str) -> None:
    quotes = QUOTE.findall((ROOT / document).read_text())
    assert quotes
    for path, text in quotes:
        assert text == quoted(path), f"{document} quotes an old {path}"


@pytest.mark.parametrize("document", sorted(ROOT.glob("*.md")) + sorted(ROOT.glob("*/README.md")))
def test_links_lead_somewhere(document: Any) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", document.read_text()):
        if "://" not in target:
            assert (document.parent / target).exists(), f"{document.name} links to {target}"


def test_the_gallery_shows_the_recipes() -> None:
    for path in (gallery.README, gallery.TABLES):
        page = path.read_text()
        assert gallery.renewed(page) == page, "python -m tools.gallery renews it"
    assert page.count("| `") > 15


PAGES = sorted((ROOT / "docs").rglob("*.md"))
BLOCK = re.compile(r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```", re.S | re.M)


def blocks(page):
    return [(m[1], m[2], m[3]) for m in BLOCK.finditer(page.read_text(encoding="utf-8"))]


def _named(page):
    return page.relative_to(ROOT / "docs").as_posix()


def _runnable():
    """Pages with commands; those that simulate scans take long."""
    for page in PAGES:
        commands = [text for language, _, text in blocks(page) if language == "sh"]
        if commands:
            slow = pytest.mark.slow if "_simulated" in "".join(commands) else ()
            yield pytest.param(page, marks=slow, id=_named(page))


@pytest.mark.parametrize("page", list(_runnable()))
def test_commands_of_a_page_run(
    page: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Call
) -> None:
    """Files with a title are written, then every command is run, in the order of the page."""
    shared = ROOT.parent / "shared"
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    Path("data").symlink_to(ROOT / "data")
    if shared.exists():
        (tmp_path / "shared").symlink_to(shared)
    for language, title, text in blocks(page):
        if title:
            Path(title).write_text(text, encoding="utf-8")
        for line in text.replace("\\\n", " ").splitlines() if language == "sh" else ():
            words = shlex.split(line, comments=True)
            if words[:1] == ["flangeye"] and (shared.exists() or "../shared" not in line):
                code, _, err = command(*words[1:])
                assert code in (0, 1), f"{line}\n{err}"


WALKS = ROOT / "docs" / "how-to" / "add-a-plugin.md"


@pytest.mark.parametrize(
    ("title", "text"), [(t, x) for language, t, x in blocks(WALKS) if language == "python"]
)
def test_a_walk_is_short_and_its_plugin_is_accepted(title: Any, text: Any) -> None:
    assert len(text.splitlines()) <= 40
    given: dict[str, object] = {}
    exec(compile(text, title, "exec"), given)
    assert [name for name in given if isinstance(given[name], Plugin)]


def test_the_rail_of_the_walk_is_an_arm(tmp_path: Path) -> None:
    ((title, text),) = [(t, x) for language, t, x in blocks(WALKS) if language == "yaml"]
    (tmp_path / title).write_text(text)
    robot = read_model(tmp_path / title, RobotModel)
    arm = Arm(robot)
    there = arm.flange(np.array([1.5, 0, -1, 1, 0, 0, 0]))
    here = arm.flange(np.array([0.5, 0, -1, 1, 0, 0, 0]))
    assert np.linalg.norm(there[:3, 3] - here[:3, 3]) == pytest.approx(1.0)
    assert np.allclose(there[:3, :3], here[:3, :3])


def test_the_navigation_has_at_most_forty_pages_and_each_is_there() -> None:
    text = (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2].partition("\ntheme:")[0]
    pages = re.findall(r"[\w/.-]+\.md", text)
    assert len(pages) == len(set(pages)) <= 40
    made = {"reference/cli.md", "reference/stages.md", "reference/result.md"}  # by tools.reference
    written = {str(p.relative_to(ROOT / "docs")) for p in (ROOT / "docs").glob("**/*.md")}
    assert set(pages) == written | made

"""What the documents say is what the project does."""

import importlib.util
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.main

from flangeye.cli import commands
from flangeye.maths.kinematics import Arm
from flangeye.models.model import read_model
from flangeye.models.robots import RobotModel
from flangeye.plugin.registry import load_registry
from flangeye.plugin.stage import Plugin
from flangeye.workflow.recipe.find import recipe_names
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


PROMPT = re.compile(r"^ *\$ ((?:.*\\\n)*.*)", re.M)
"""A line typed at a prompt, with its continuation lines."""

MENTION = re.compile(r"`(flangeye [^`<\[…]*)`")
"""A command in a sentence, without placeholders; its arguments may be missing."""

DOCUMENTS = sorted(ROOT.glob("*.md")) + sorted(
    path for room in ("data", "docs", "plugins", "recipes") for path in (ROOT / room).rglob("*.md")
)


def _parsed(words):
    """Return name and parameters of a command as the command line understands it."""
    command, context = typer.main.get_command(commands()), None
    name, rest = "flangeye", list(words)
    while True:
        context = command.make_context(name, rest, parent=context)
        if not hasattr(command, "resolve_command"):
            return name, context.params
        name, command, rest = command.resolve_command(
            context, [*context._protected_args, *context.args]
        )


def _prompts(document):
    typed = PROMPT.findall(document.read_text(encoding="utf-8"))
    return [shlex.split(line.replace("\\\n", " "), comments=True) for line in typed]


@pytest.mark.parametrize(
    "document", [pytest.param(d, id=str(d.relative_to(ROOT))) for d in DOCUMENTS if _prompts(d)]
)
def test_commands_at_a_prompt_are_understood(document: Any) -> None:
    """Also those that need a robot, a network or an archive: command, options, names."""
    for words in _prompts(document):
        if words[:2] == ["python", "-m"]:
            assert importlib.util.find_spec(words[2]), words
        if words[0] != "flangeye":
            continue
        name, params = _parsed(words[1:])
        recipe = params.get("recipe") if name in ("run", "batch") else None
        if recipe and Path(recipe).suffix != ".yaml":
            assert recipe in recipe_names(), words
        if params.get("at"):
            assert params["at"] in load_registry().stages, words


@pytest.mark.parametrize(
    "document",
    [
        pytest.param(d, id=str(d.relative_to(ROOT)))
        for d in DOCUMENTS
        if MENTION.search(d.read_text(encoding="utf-8"))
    ],
)
def test_commands_in_a_sentence_exist(document: Any) -> None:
    for line in MENTION.findall(document.read_text(encoding="utf-8")):
        words = shlex.split(line.partition(" < ")[0])
        try:
            _parsed(words[1:])
        except Exception as error:
            # An option may be named without its value, a command without its arguments
            known = type(error).__name__ in ("MissingParameter", "NoArgsIsHelpError", "Exit")
            assert known or "requires an argument" in str(error), f"{line}: {error}"


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

"""`python -m tools.count` on a tree whose figures are known."""

import ast
from collections import Counter
from pathlib import Path

import pytest

from tools.count import CORE_BOUND, count, main, room_of, table

SEGMENT = '''
"""Docstring of
two lines."""

from typing import ClassVar, TYPE_CHECKING

if TYPE_CHECKING:
    from flangeye_plugins.shared import only_for_types

import flangeye_plugins.segment.low

# A comment counts as a comment.
NEAR, FAR = 1, 2  # so does this
T = TypeVar("T")
lower = 3
text = """
# a string's line counts as code
"""


class Limits(Params):
    """Docstring."""

    kind: ClassVar[str] = "x"
    near: float = 1.0
    far: float = 2.0


class Wider(Limits):
    most: int = 3


class NoOption(Base):
    near: float = 1.0


@stage("segment.flange")
def segment(
    params: Limits,
) -> None:
    """Docstring."""

    # why
    return None
'''


@pytest.fixture
def tree(tmp_path):
    def write(name, text):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    write("plugins/flangeye_plugins/segment/__init__.py", "")
    write("plugins/flangeye_plugins/segment/flange.py", SEGMENT)
    write(
        "plugins/flangeye_plugins/segment/low.py",
        "def f():\n    from .lower import LOW\n    return LOW\n",
    )
    write("plugins/flangeye_plugins/segment/lower.py", "LOW: int = 1\n")
    write("plugins/flangeye_plugins/shared.py", "def only_for_types():\n    return 1\n")
    write("plugins/flangeye_emulators/world/year.py", "from flangeye_plugins import shared\n")
    write(
        "pipeline/flangeye/files/a.py",
        "from flangeye.files.b import x\nfrom flangeye.files import c\n",
    )
    write("pipeline/flangeye/files/b.py", "from flangeye.files import c\n")
    write("pipeline/flangeye/files/c.py", "")
    return tmp_path


def test_code_comments_options_constants_and_functions_are_counted(tree):
    room = count(tree)["flangeye_plugins.segment"]
    assert (room.code, room.comments) == (23 + 3 + 1, 3)
    assert room.options == 3, (
        "two of Limits and one of Wider; a ClassVar and another class's are none"
    )
    assert room.constants == 3
    assert room.modules == 4
    assert room.longest == (4, "flangeye_plugins.segment.flange.segment")


def test_a_small_module_with_one_importer_is_named_unless_it_is_a_plugin(tree):
    rooms = count(tree)
    assert rooms["flangeye_plugins.segment"].single == [
        "flangeye_plugins.segment.low",
        "flangeye_plugins.segment.lower",
    ]
    assert rooms["flangeye.files"].single == ["flangeye.files.b"], "c has two importers"
    assert rooms["flangeye_plugins.shared"].single == ["flangeye_plugins.shared"]


def test_floors_are_the_longest_chain_of_imports(tree):
    rooms = count(tree)
    assert rooms["flangeye.files"].floors == 3
    assert rooms["flangeye_plugins.segment"].floors == 3


def test_a_ring_of_imports_ends(tmp_path):
    for name, other in ("ab", "ba"):
        path = tmp_path / "pipeline/flangeye/workflow/log" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"from flangeye.workflow.log import {other}\n")
    assert count(tmp_path)["flangeye.workflow.log"].floors == 2


@pytest.mark.parametrize(
    ("module", "room"),
    [
        ("flangeye.workflow.log.read", "flangeye.workflow.log"),
        ("flangeye_plugins.weld.following.follower", "flangeye_plugins.weld"),
        ("flangeye_paper.fig9", "flangeye_paper"),
    ],
)
def test_rooms(module, room):
    assert room_of(module) == room


def test_the_core_is_counted_without_emulators(tree, capsys):
    assert main([str(tree)]) == 0
    said = capsys.readouterr().out
    assert f"code without emulators and studies: 32 (bound {CORE_BOUND})" in said
    assert "code: 33 (bound 42000)" in said
    assert table(count(tree)) + "\n" == said


def test_a_name_of_a_class_has_one_meaning() -> None:
    """A class is defined once, and no other module calls an alias or a constant the same."""
    root = Path(__file__).parents[1]
    classes: list[str] = []
    others: set[str] = set()
    for path in (p for top in ("pipeline", "plugins") for p in (root / top).rglob("*.py")):
        tree = ast.parse(path.read_text())
        classes += [node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
        for node in tree.body:
            if isinstance(node, ast.Assign):
                others |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    assert [name for name, times in Counter(classes).items() if times > 1] == []
    assert sorted(others & {*classes}) == []

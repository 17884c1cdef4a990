"""Size of the code, room by room: ``python -m tools.count``.

A room is a package directly below ``flangeye``, its ``workflow``, ``flangeye_plugins`` or
``flangeye_emulators``, or another distribution as a whole. Its floors are those of the tallest
package in it. Everything is read from the syntax tree; nothing is imported.
"""

import argparse
import ast
import io
import sys
import tokenize
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path

ROOTS = ("pipeline", "plugins")
SPLIT = ("flangeye", "flangeye.workflow", "flangeye_plugins", "flangeye_emulators")
BOUNDS = {"code": 42_000, "options": 450, "constants": 500, "modules": 450}
CORE_BOUND = 34_000  # code lines without emulators and studies
APART = ("flangeye_emulators", "flangeye_paper")
SMALL = 40  # code lines below which a module with one importer counts as split off for nothing
LAYOUT = (
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
)


@dataclass
class Module:
    """Measurements of one file; `imports` are names of modules or of objects in them."""

    name: str
    code: int
    comments: int
    constants: list[str]
    classes: list[tuple[str, list[str], int]]
    longest: tuple[int, str]
    imports: set[str]
    is_plugin: bool


@dataclass
class Room:
    code: int = 0
    comments: int = 0
    options: int = 0
    constants: int = 0
    modules: int = 0
    longest: tuple[int, str] = (0, "")
    single: list[str] = field(default_factory=list)
    floors: int = 0


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.count", description=__doc__)
    parser.add_argument(
        "--single", action="store_true", help="list small modules with one importer"
    )
    parser.add_argument("folder", nargs="?", type=Path, default=Path.cwd())
    args = parser.parse_args(argv)
    rooms = count(args.folder)
    print(table(rooms))
    if args.single:
        print(*(name for room in rooms.values() for name in room.single), sep="\n")
    return 0


def count(folder):
    """Counts of each room below ``folder/pipeline`` and ``folder/plugins``."""
    modules = {m.name: m for root in ROOTS for m in _modules(folder / root)}
    edges = {name: _imported(module, modules) for name, module in modules.items()}
    importers = Counter(target for targets in edges.values() for target in targets)
    options = _options(modules)
    rooms: defaultdict[str, Room] = defaultdict(Room)
    for name, module in sorted(modules.items()):
        room = rooms[room_of(name)]
        room.code += module.code
        room.comments += module.comments
        room.options += options[name]
        room.constants += len(module.constants)
        room.modules += 1
        room.longest = max(room.longest, module.longest)
        if importers[name] == 1 and module.code < SMALL and not module.is_plugin:
            room.single.append(name)
    for name in {n.rpartition(".")[0] for n in modules if "." in n} | set(rooms):
        room = rooms[room_of(name)]
        room.floors = max(room.floors, _floors(name, modules, edges))
    return dict(rooms)


def room_of(name):
    parts = name.split(".")
    depth = 1
    while depth < len(parts) and ".".join(parts[:depth]) in SPLIT:
        depth += 1
    return ".".join(parts[:depth])


def table(rooms):
    """Text of the rooms and, below them, the totals beside their bounds."""
    head = (
        "room",
        "code",
        "options",
        "constants",
        "modules",
        "longest",
        "single",
        "comments",
        "floors",
    )
    rows = [head] + [
        (name, room.code, room.options, room.constants, room.modules, room.longest[0],
         len(room.single), f"{room.comments / max(1, room.code + room.comments):.1%}", room.floors)
        for name, room in sorted(rooms.items())
    ]  # fmt: skip
    widths = [max(len(str(row[i])) for row in rows) for i in range(len(head))]
    lines = [
        f"{row[0]:<{widths[0]}}  "
        + "  ".join(f"{c!s:>{w}}" for c, w in zip(row[1:], widths[1:], strict=True))
        for row in rows
    ]
    core = sum(room.code for name, room in rooms.items() if name.split(".")[0] not in APART)
    totals = {key: sum(getattr(room, key) for room in rooms.values()) for key in BOUNDS}
    longest = max(room.longest for room in rooms.values())
    lines += ["", f"code without emulators and studies: {core} (bound {CORE_BOUND})"]
    lines += [f"{key}: {value} (bound {BOUNDS[key]})" for key, value in totals.items()]
    lines += [f"longest function: {longest[0]} lines, {longest[1]}"]
    single = sum(len(room.single) for room in rooms.values())
    lines += [f"modules with one importer and under {SMALL} lines: {single} (bound 0)"]
    lines += [f"most floors in a room: {max(room.floors for room in rooms.values())} (bound 6)"]
    return "\n".join(lines)


def _modules(root):
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        is_package = parts[-1] == "__init__"
        yield _read(path, ".".join(parts[:-1] if is_package else parts), is_package)


def _read(path, name, is_package):
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    lines = _code_lines(text, tree)
    lengths = [(_length(f, lines), f"{name}.{f.name}") for f in functions]
    return Module(
        name,
        len(lines),
        _comments(text),
        [target for node in tree.body for target in _constants(node)],
        [_class(n) for n in ast.walk(tree) if isinstance(n, ast.ClassDef)],
        max(lengths, default=(0, "")),
        _imports(tree, name, is_package),
        is_package or any(_declares(n) for n in ast.walk(tree)),
    )


def _code_lines(text, tree):
    """Return the numbers of the lines with code, without blanks, comments and docstrings."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in LAYOUT and token.type != tokenize.COMMENT:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str):
            lines.difference_update(range(node.lineno, (node.end_lineno or 0) + 1))
    return lines


def _comments(text):
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return sum(t.type == tokenize.COMMENT and not t.string.startswith("# noqa") for t in tokens)


def _length(function, lines):
    return sum(function.lineno <= line <= function.end_lineno for line in lines)


def _constants(node):
    """Names in capitals that a statement of a module assigns; type variables are none."""
    if isinstance(node, ast.Assign):
        targets = node.targets
    elif isinstance(node, ast.AnnAssign):
        targets = [node.target]
    else:
        return []
    if isinstance(node.value, ast.Call) and ast.unparse(node.value.func) == "TypeVar":
        return []
    names = [n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)]
    return [name for name in names if name.isupper()]


def _class(node):
    """A class's name, the names of its bases, and how many fields it declares."""
    bases = [b.attr if isinstance(b, ast.Attribute) else getattr(b, "id", "") for b in node.bases]
    fields = [n for n in node.body if isinstance(n, ast.AnnAssign) and not _is_class_variable(n)]
    return node.name, bases, len(fields)


def _is_class_variable(node):
    return "ClassVar" in ast.unparse(node.annotation) or node.target.id.startswith("_")


def _options(modules):
    """Number of options each module declares: fields of classes that descend from ``Params``."""
    known = {"Params"}
    while True:
        found = {
            name for m in modules.values() for name, bases, _ in m.classes if known & set(bases)
        } | known
        if found == known:
            break
        known = found
    return {
        module.name: sum(n for name, bases, n in module.classes if known & set(bases))
        for module in modules.values()
    }


def _declares(node):
    """Whether a definition is a plugin's: its decorator is called with the name ``kind.name``."""
    decorators = getattr(node, "decorator_list", [])
    return any(
        isinstance(d, ast.Call) and d.args and isinstance(d.args[0], ast.Constant)
        and isinstance(d.args[0].value, str)
        for d in decorators
    )  # fmt: skip


def _imports(tree, name, is_package):
    """Names imported at run time, wherever in the file; those for types alone do not count."""
    typing_only = {
        child
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for child in ast.walk(node)
    }
    found: set[str] = set()
    for node in ast.walk(tree):
        if node in typing_only:
            continue
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            source = _source(node, name, is_package)
            found.update(f"{source}.{alias.name}" for alias in node.names)
    return found


def _source(node, name, is_package):
    if not node.level:
        return node.module
    parts = name.split(".")
    above = parts[: len(parts) - node.level + is_package]
    return ".".join([*above, *([node.module] if node.module else [])])


def _imported(module, modules):
    """Modules of the tree that one imports: `a.b` itself, or the `a` whose `b` it asks for."""
    targets = set()
    for name in module.imports:
        target = name if name in modules else name.rpartition(".")[0]
        if target in modules and target != module.name:
            targets.add(target)
    return targets


def _floors(room, modules, edges):
    """Longest chain of imports among the modules and packages directly in a package."""
    inside = {m for m in modules if m.startswith(room + ".")}
    part = {m: m.removeprefix(room + ".").split(".")[0] for m in inside}
    below: dict[str, set[str]] = {p: set() for p in part.values()}
    for module in inside:
        below[part[module]] |= {part[t] for t in edges[module] if t in inside} - {part[module]}
    return max((_height(p, below, ()) for p in below), default=1)


def _height(part, below, path):
    """Floors from `part` down; a ring of imports counts each of its members once."""
    return 1 + max(
        (_height(p, below, (*path, part)) for p in below[part] if p not in path and p != part),
        default=0,
    )


if __name__ == "__main__":
    sys.exit(main())

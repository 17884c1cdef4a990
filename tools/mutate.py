"""Change the source in small ways and see which changes no fast test notices.

python -m tools.mutate [SAMPLE] [--seed N] [--room NAME …] [--only FILE:LINE]: a sample over the
rooms below, each change under the fast tests of its room, in a copy of the repository. A change that
fails no test is a survivor: its place and what was changed are printed, and the share that was killed.
"""

from __future__ import annotations

import argparse
import ast
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
ROOMS = {
    "motion": ("pipeline/flangeye/motion", "tests/motion"),
    "estimator": ("pipeline/flangeye/handeye", "tests/handeye"),
    "fit": ("plugins/flangeye_plugins/fit", "tests/plugins/fit"),
    "segment": ("plugins/flangeye_plugins/segment", "tests/plugins/segment"),
    "verify": ("plugins/flangeye_plugins/verify", "tests/plugins/verify"),
    "weld": ("plugins/flangeye_plugins/weld", "tests/plugins/weld"),
    "run": ("pipeline/flangeye/run", "tests/run"),
}
"""Source, and the tests that have to notice."""

COMPARED = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
            ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is}  # fmt: skip
COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
SLOWER = 5.0
"""A change is noticed, too, by tests that take so many times as long."""


class Mutation(NamedTuple):
    """One change: of which room, file, line and node of its syntax tree, in words, and how."""

    room: str
    file: Path
    line: int
    node: int
    words: str
    change: Callable[[Any], Any]

    def text(self) -> str:
        """Return the changed source."""
        tree = ast.parse((ROOT / self.file).read_text("utf-8"))
        self.change(list(ast.walk(tree))[self.node])
        return ast.unparse(tree)


def mutations(room: str) -> Iterator[Mutation]:
    """Yield every change of a room's source."""
    for file in sorted((ROOT / ROOMS[room][0]).rglob("*.py")):
        for number, node in enumerate(ast.walk(ast.parse(file.read_text("utf-8")))):
            line = getattr(node, "lineno", 0)
            for words, change in _changes(node):
                yield Mutation(room, file.relative_to(ROOT), line, number, words, change)


def _changes(node: Any) -> Iterator[tuple[str, Callable[[Any], Any]]]:
    if isinstance(node, ast.Compare) and type(node.ops[0]) in COMPARED:
        to = COMPARED[type(node.ops[0])]
        yield (f"{ast.unparse(node)}: {to.__name__}", lambda n: n.ops.__setitem__(0, to()))
    elif isinstance(node, ast.BinOp) and type(node.op) in COMPUTED:
        computed = COMPUTED[type(node.op)]
        yield f"{ast.unparse(node)}: {computed.__name__}", lambda n: setattr(n, "op", computed())
    elif isinstance(node, ast.BoolOp):
        other = ast.Or if isinstance(node.op, ast.And) else ast.And
        yield f"{ast.unparse(node)}: {other.__name__}", lambda n: setattr(n, "op", other())
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        number: Any = node.value
        more = number + 1 if isinstance(number, int) else number * 2 + 1e-3
        yield f"{number} -> {more}", lambda n: setattr(n, "value", more)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield f"{ast.unparse(node)}: without not", lambda n: setattr(n, "op", ast.UAdd())


class Copy:
    """A copy of the repository in which one change at a time is tried."""

    def __init__(self, folder: Path) -> None:
        self._root = folder / "copy"
        left_out = shutil.ignore_patterns(".git", ".venv", ".hypothesis", "runs", "site")
        shutil.copytree(ROOT, self._root, symlinks=True, ignore=left_out)

    def killed(self, mutation: Mutation, patience: float) -> bool:
        """Return whether the room's fast tests fail on a change, or do not come to an end."""
        file = self._root / mutation.file
        sound = file.read_text("utf-8")
        file.write_text(mutation.text(), "utf-8")
        tests = ROOMS[mutation.room][1]
        named = (self._root / tests).rglob(f"test_*{mutation.file.stem}*.py")
        try:
            return not self.passes([*map(str, named), tests], patience)
        finally:
            file.write_text(sound, "utf-8")

    def passes(self, tests: list[str], patience: float | None = None) -> bool:
        """Return whether fast tests pass within ``patience`` [s]; those named first run first."""
        path = [str(self._root / folder) for folder in ("pipeline", "plugins")]
        start = (
            f"import sys; sys.path[:0] = {path}; import pytest; sys.exit(pytest.main(sys.argv[1:]))"
        )
        options = ["-q", "-x", "-p", "no:cacheprovider", "-m", "not slow and not realtime"]
        command = [sys.executable, "-c", start, *options, *tests]
        try:
            return not subprocess.run(
                command, cwd=self._root, capture_output=True, timeout=patience
            ).returncode
        except subprocess.TimeoutExpired:
            return False


def main() -> None:
    """Try a sample of each room, and print who survived."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("sample", nargs="?", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--room", nargs="+", choices=ROOMS, default=list(ROOMS))
    parser.add_argument("--only", default="", help="a part of FILE:LINE: those changes alone, all")
    asked = parser.parse_args()
    killed = tried = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        for room in asked.room:
            chosen = _chosen(room, asked.sample // len(asked.room), asked.seed, asked.only)
            if not chosen:
                continue
            patience = _patience(copy, room)
            alive = [m for m in chosen if not copy.killed(m, patience)]
            print(f"{room:10} {len(chosen) - len(alive):3} of {len(chosen):3} killed")
            for mutation in alive:
                print(f"  alive {mutation.file}:{mutation.line}: {mutation.words}", flush=True)
            killed, tried = killed + len(chosen) - len(alive), tried + len(chosen)
    print(f"{killed} of {tried} killed by fast tests ({killed / max(tried, 1):.0%})")


def _patience(copy: Copy, room: str) -> float:
    """Return how long a room's tests may take; they have to pass as they are."""
    began = time.monotonic()
    if not copy.passes([ROOMS[room][1]]):
        raise SystemExit(f"{room}: its tests fail without any change")
    return SLOWER * (time.monotonic() - began)


def _chosen(room: str, count: int, seed: int, only: str) -> list[Mutation]:
    every = [m for m in mutations(room) if only in f"{m.file}:{m.line}:"]
    return every if only else random.Random(f"{room} {seed}").sample(every, min(count, len(every)))


if __name__ == "__main__":
    main()

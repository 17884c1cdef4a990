"""Change the source in small ways and see which changes no fast test notices.

python -m tools.mutate [SAMPLE] [--seed N] [--room NAME]: a sample over the rooms below, each change
under the fast tests of its room, with a copy of the repository for itself. A change that no test
fails is a survivor: its place and what was changed are printed, at the end the share that was killed.
"""

from __future__ import annotations

import argparse
import ast
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import NamedTuple

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
PATIENCE = 300


class Mutation(NamedTuple):
    """One change: of which file and line, to what text, and in words."""

    room: str
    file: Path
    line: int
    words: str
    text: str


def mutations(room: str) -> Iterator[Mutation]:
    """Yield every change of a room's source."""
    for file in sorted((ROOT / ROOMS[room][0]).rglob("*.py")):
        tree = ast.parse(file.read_text("utf-8"))
        for number, node in enumerate(ast.walk(tree)):
            for words, change in _changes(node):
                changed = deepcopy(tree)
                change(next(n for i, n in enumerate(ast.walk(changed)) if i == number))
                line = getattr(node, "lineno", 0)
                yield Mutation(room, file.relative_to(ROOT), line, words, ast.unparse(changed))


def _changes(node: ast.AST) -> Iterator[tuple[str, object]]:
    if isinstance(node, ast.Compare) and type(node.ops[0]) in COMPARED:
        to = COMPARED[type(node.ops[0])]
        yield (f"{ast.unparse(node)}: {to.__name__}", lambda n: n.ops.__setitem__(0, to()))
    elif isinstance(node, ast.BinOp) and type(node.op) in COMPUTED:
        to = COMPUTED[type(node.op)]
        yield f"{ast.unparse(node)}: {to.__name__}", lambda n: setattr(n, "op", to())
    elif isinstance(node, ast.BoolOp):
        to = ast.Or if isinstance(node.op, ast.And) else ast.And
        yield f"{ast.unparse(node)}: {to.__name__}", lambda n: setattr(n, "op", to())
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        more = node.value + 1 if isinstance(node.value, int) else node.value * 2 + 1e-3
        yield f"{node.value} -> {more}", lambda n: setattr(n, "value", more)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield f"{ast.unparse(node)}: without not", lambda n: setattr(n, "op", ast.UAdd())


def killed(mutation: Mutation, copy: Path) -> bool:
    """Return whether the room's fast tests fail on a change."""
    file = copy / mutation.file
    sound = file.read_text("utf-8")
    file.write_text(mutation.text, "utf-8")
    options = ["-q", "-x", "-p", "no:cacheprovider", "-m", "not slow and not realtime"]
    path = [str(copy / folder) for folder in ("pipeline", "plugins")]
    start = f"import sys; sys.path[:0] = {path}; import pytest; sys.exit(pytest.main(sys.argv[1:]))"
    command = [sys.executable, "-c", start, *options, ROOMS[mutation.room][1]]
    try:
        return (
            subprocess.run(command, cwd=copy, capture_output=True, timeout=PATIENCE).returncode != 0
        )
    except subprocess.TimeoutExpired:
        return True
    finally:
        file.write_text(sound, "utf-8")


def main() -> None:
    """Try a sample, and print who survived."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("sample", nargs="?", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--room", choices=ROOMS)
    asked = parser.parse_args()
    rooms = [asked.room] if asked.room else list(ROOMS)
    chance, alive = random.Random(asked.seed), 0
    chosen = [m for room in rooms for m in _sampled(room, asked.sample // len(rooms), chance)]
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        shutil.copytree(
            ROOT, copy, symlinks=True, ignore=shutil.ignore_patterns(".git", ".venv", "runs")
        )
        for mutation in chosen:
            if not killed(mutation, copy):
                alive += 1
                print(f"alive {mutation.file}:{mutation.line}: {mutation.words}", flush=True)
    share = 1 - alive / max(len(chosen), 1)
    print(f"{len(chosen) - alive} of {len(chosen)} killed by fast tests ({share:.0%})")


def _sampled(room: str, count: int, chance: random.Random) -> list[Mutation]:
    every = list(mutations(room))
    return chance.sample(every, min(count, len(every)))


if __name__ == "__main__":
    main()

"""Change the source in small ways and see which changes no fast test notices.

python -m tools.mutate [SAMPLE] [--seed N] [--room NAME …] [--only FILE:LINE]: a sample over the
rooms below, each in a copy of the repository, under those fast tests of its room that run the changed
line (coverage.py says which, once for each file of tests: build/mutation), the fastest first. A
change that fails no test is a survivor: its place and what was changed are printed, and the share
that was killed.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from tools.covering import FAST

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
KEPT = ROOT / "build" / "mutation"
"""Which test runs which line, as found once."""

COMPARED = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
            ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is}  # fmt: skip
COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
SLOWER, STARTS = 4.0, 12.0
"""A change is noticed, too, by tests that take so many times as long, and so much more [CPU s]."""
IDLE = 4.0
"""Or by tests that wait so many times longer than that [wall s a CPU s]."""
MEMORY = 16 << 30
"""Or by tests that take so much of it [bytes]."""


class Mutation(NamedTuple):
    """One change: of which room, file, line, statement's lines and node, in words, and how."""

    room: str
    file: str
    line: int
    lines: range
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
    for path in sorted((ROOT / ROOMS[room][0]).rglob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        lines, file = _statements(tree), str(path.relative_to(ROOT))
        for number, node in enumerate(ast.walk(tree)):
            line = getattr(node, "lineno", 0)
            for words, change in _changes(node):
                yield Mutation(room, file, line, lines[node], number, words, change)


def _statements(tree: ast.Module) -> dict[Any, range]:
    """Return the lines of the statement that each node is part of, without those inside it."""
    lines: dict[Any, range] = {}
    for statement in ast.walk(tree):  # the outer ones come first
        if isinstance(statement, ast.stmt):
            last = statement.end_lineno or statement.lineno
            if isinstance(statement, ast.If | ast.For | ast.While | ast.With):
                last = max(statement.lineno, statement.body[0].lineno - 1)
            span = range(statement.lineno, last + 1)
            lines |= dict.fromkeys(ast.walk(statement), span)
    return lines


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


class Tests:
    """The fast tests of a room: what each takes [CPU s], and which run a line."""

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}
        self._lines: dict[str, dict[int, set[str]]] = {}

    def add(self, gathered: Any) -> None:
        """Add the tests of a file, as ``tools.covering`` found them.

        Lines of a source that has changed since count as lines that are run at import only.
        """
        self._seconds |= gathered["seconds"]
        for file, by_line in gathered["lines"].items():
            same = gathered["sources"][file] == _digest(ROOT / file)
            known = self._lines.setdefault(file, {})
            for line, tests in by_line.items():
                known.setdefault(int(line) if same else 0, set()).update(tests)

    def of(self, file: str, lines: range, budget: float) -> tuple[list[str], float]:
        """Return the tests that run one of the lines, the fastest first, and what they take.

        What runs at import only, or in another process, is given to all tests of its file, or to
        all. No more are taken than a budget allows [CPU s].
        """
        of_file = self._lines.get(file, {})
        run = {test for line in lines for test in of_file.get(line, ())}
        run = run or {test for tests in of_file.values() for test in tests} or set(self._seconds)
        return self._within(run, budget)

    def but(self, tried: list[str], budget: float) -> tuple[list[str], float]:
        """Return the other tests in the same way: what is worked out at import is none's line."""
        return self._within(set(self._seconds) - set(tried), budget)

    def _within(self, tests: set[str], budget: float) -> tuple[list[str], float]:
        chosen, total = list[str](), 0.0
        for test in sorted(tests, key=self._seconds.__getitem__):
            total += self._seconds[test]
            if chosen and total > budget:
                break
            chosen.append(test)
        return chosen, min(total, budget)


class Copy:
    """A copy of the repository in which one change at a time is tried."""

    def __init__(self, folder: Path) -> None:
        self._root = folder / "copy"
        left_out = shutil.ignore_patterns(
            ".git", ".venv", ".hypothesis", "runs", "site", "build", "__pycache__"
        )
        shutil.copytree(ROOT, self._root, symlinks=True, ignore=left_out)

    def tests(self, room: str) -> Tests:
        """Return a room's fast tests; what was found of a file before is taken as it is."""
        found, (source, folder) = Tests(), ROOMS[room]
        KEPT.mkdir(parents=True, exist_ok=True)
        for file in sorted((ROOT / folder).rglob("test_*.py")):
            kept = KEPT / f"{room}-{file.stem}-{_digest(file)}.json"
            if not kept.exists():
                print(f"{room}: looking which lines {file.name} runs", file=sys.stderr)
                words = ["-m", "tools.covering", source, str(kept), str(file.relative_to(ROOT))]
                self._run(words)
                gathered = json.loads(kept.read_text("utf-8"))
                gathered["sources"] = {name: _digest(ROOT / name) for name in gathered["lines"]}
                kept.write_text(json.dumps(gathered), "utf-8")
            found.add(json.loads(kept.read_text("utf-8")))
        return found

    def killed(self, mutation: Mutation, tests: list[str], seconds: float) -> bool:
        """Return whether tests that take so long fail on a change, or do not come to an end."""
        file = self._root / mutation.file
        sound = file.read_text("utf-8")
        file.write_text(mutation.text(), "utf-8")
        try:
            return bool(self._run(["-m", "pytest", "-x", *FAST, *tests], SLOWER * seconds + STARTS))
        finally:
            file.write_text(sound, "utf-8")

    def _run(self, words: list[str], patience: float | None = None) -> int:
        """Run Python on the copy; a run that takes more than ``patience`` [CPU s] has failed."""
        paths = [".", "pipeline", "plugins", "plugins/flangeye_paper"]
        paths = [str(self._root / path) for path in paths]
        path = os.pathsep.join([*paths, os.environ.get("PYTHONPATH", "")])

        def bounded() -> None:
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
            if patience:
                resource.setrlimit(resource.RLIMIT_CPU, (int(patience), int(patience) + 5))

        child = subprocess.Popen(
            [sys.executable, "-B", *words], cwd=self._root, env={**os.environ, "PYTHONPATH": path},
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, preexec_fn=bounded,
            start_new_session=True,
        )  # fmt: skip
        try:
            return child.wait(patience and IDLE * patience)
        except subprocess.TimeoutExpired:
            return 1
        finally:
            with suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()


def main() -> None:
    """Try a sample of each room, and print who survived."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("sample", nargs="?", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--room", nargs="+", choices=ROOMS, default=list(ROOMS))
    parser.add_argument("--only", default="", help="a part of FILE:LINE: those changes alone, all")
    parser.add_argument("--budget", type=float, default=60, help="of tests for a change [CPU s]")
    asked = parser.parse_args()
    killed = tried = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        for room in asked.room:
            chosen = _chosen(room, asked.sample // len(asked.room), asked.seed, asked.only)
            if not chosen:
                continue
            alive = _survivors(copy, chosen, copy.tests(room), asked.budget)
            print(f"{room:10} {len(chosen) - alive:3} of {len(chosen):3} killed", flush=True)
            killed, tried = killed + len(chosen) - alive, tried + len(chosen)
    print(f"{killed} of {tried} killed by fast tests ({killed / max(tried, 1):.0%})")


def _survivors(copy: Copy, chosen: list[Mutation], tests: Tests, budget: float) -> int:
    """Print the changes that no test notices and return how many they are."""
    alive = 0
    named, seconds = tests.of(chosen[0].file, chosen[0].lines, budget)
    if copy.killed(chosen[0]._replace(change=lambda node: None), named, seconds):
        raise SystemExit(f"{chosen[0].room}: its tests fail without any change: {named}")
    for number, mutation in enumerate(chosen):
        print(f"\r{number} of {len(chosen)} ", end="", file=sys.stderr, flush=True)
        named, seconds = tests.of(mutation.file, mutation.lines, budget)
        if copy.killed(mutation, named, seconds):
            continue
        others, more = tests.but(named, budget)
        if not others or not copy.killed(mutation, others, more):
            alive += 1
            print(f"  alive {mutation.file}:{mutation.line}: {mutation.words}", flush=True)
    return alive


def _chosen(room: str, count: int, seed: int, only: str) -> list[Mutation]:
    every = [m for m in mutations(room) if only in f"{m.file}:{m.line}:"]
    return every if only else random.Random(f"{room} {seed}").sample(every, min(count, len(every)))


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


if __name__ == "__main__":
    main()

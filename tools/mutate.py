"""Change the source in small ways and see which changes no fast test notices.

python -m tools.mutate [SAMPLE] [--seed N] [--room NAME …] [--only FILE:LINE] [--tests FILE …]: a
sample over the rooms below, each in a copy of the repository, under those fast tests of its room
(or those named; of a file that has none, those in real time, one at a time) that run the changed
line (coverage.py says which, and is asked anew for a file of tests that has changed, into
build/mutation), the file's own first, then the fastest: in a fork of a process that has them
collected (tools/trying.py). A change of what is computed at import, or of a line that runs in
processes of the tests alone, is tried in a new process as well. What the files named by --tests
leave alive is tried under the room's other files too, in a new process: coverage would make whole
calibrations too slow. A change that fails no test is a survivor: its place and what was changed are
printed, and the share that was killed.
"""

from __future__ import annotations

import argparse
import ast
import base64
import hashlib
import json
import marshal
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from tools.covering import NAMED

ROOT = Path(__file__).parents[1]
ROOMS: dict[str, tuple[str, ...]] = {
    "motion": ("pipeline/flangeye/motion", "tests/motion", "tests/plugins/arc"),
    "arc": ("plugins/flangeye_plugins/arc.py", "tests/plugins/arc"),
    "estimator": (
        "pipeline/flangeye/estimation", "tests/estimation",
        "tests/workflow/doctor/monitor/test_attribution.py",
        "tests/workflow/doctor/monitor/test_drift.py",
        "tests/workflow/doctor/monitor/test_pose_error.py",
    ),
    "fit": ("plugins/flangeye_plugins/fit", "tests/plugins/fit"),
    "segment": ("plugins/flangeye_plugins/segment", "tests/plugins/segment"),
    "verify": ("plugins/flangeye_plugins/verify", "tests/plugins/verify"),
    "log": ("pipeline/flangeye/workflow/log", "tests/workflow/log", "tests/test_hard_cases.py"),
    "monitor": ("pipeline/flangeye/workflow/doctor/monitor", "tests/workflow/doctor/monitor"),
    "export": (
        "plugins/flangeye_plugins/export", "tests/plugins/export", "tests/cli",
        "tests/plugins/refine/test_arm.py",
    ),
    "robot": ("plugins/flangeye_plugins/robot", "tests/plugins/robot", "tests/plugins/ros2"),
    "scanner": (
        "plugins/flangeye_plugins/scanner", "tests/plugins/scanner", "tests/plugins/ros2",
    ),
    "weld": ("plugins/flangeye_plugins/weld", "tests/plugins/weld"),
    "run": (
        "pipeline/flangeye/workflow/run", "tests/workflow/run", "tests/plugins/reader/test_cell.py",
        "tests/cli/test_cell_export.py", "tests/workflow/result/test_answers.py",
    ),
}  # fmt: skip
"""Source, and the folders or files of the tests that have to notice: a room's tests, and those that
stand where what it does is read or used."""
KEPT = ROOT / "build" / "mutation"
"""Which test runs which line, as found once."""

COMPARED = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
            ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is}  # fmt: skip
COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
SLOWER, STARTS, FORKS = 4.0, 8.0, 3.0
"""A change is noticed, too, by tests that take so many times as long, and so much more: in a new
process, and in a fork that has all imported [CPU s]."""
IDLE = 3.0
"""Or by tests that wait so many times longer than that, on a machine that is not crowded [wall s a
CPU s]."""
MEMORY = 16 << 30
"""Or by tests that take so much of it [bytes]."""


class Mutation(NamedTuple):
    """One mutation: room, file, its source when the mutation was made, line, the statement's lines,
    the node, a description, the change, and whether it is of what is computed at import.
    """

    room: str
    file: str
    source: str
    line: int
    lines: range
    node: int
    words: str
    change: Callable[[Any], Any]
    at_import: bool

    def text(self) -> str:
        """Return the changed source."""
        return ast.unparse(self._tree())

    def code(self, root: Path) -> str:
        """Return the changed source compiled, as if it were under ``root``."""
        code = compile(self._tree(), root / self.file, "exec", dont_inherit=True)
        return base64.b64encode(marshal.dumps(code)).decode()

    def _tree(self) -> ast.Module:
        tree = ast.parse(self.source)
        self.change(list(ast.walk(tree))[self.node])
        return tree


def mutations(room: str) -> Iterator[Mutation]:
    """Yield every change of a room's source."""
    for path in _files(ROOT / ROOMS[room][0], "*.py"):
        source, file = path.read_text("utf-8"), str(path.relative_to(ROOT))
        tree = ast.parse(source)
        lines, later, same = _statements(tree), _in_functions(tree), _free_sizes(tree)
        for number, node in enumerate(ast.walk(tree)):
            line = getattr(node, "lineno", 0)
            for words, change in () if node in same else _changes(node):
                yield Mutation(
                    room, file, source, line, lines[node], number, words, change, node not in later
                )


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


def _in_functions(tree: ast.Module) -> set[Any]:
    """Return the nodes that a fork's functions have: those of bodies, not of default values."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    return {node for each in functions for part in each.body for node in ast.walk(part)}


def _free_sizes(tree: ast.Module) -> set[Any]:
    """Return the ones of ``reshape(-1, …)``: numpy takes any negative number alike."""
    shapes = [
        argument
        for call in ast.walk(tree)
        if isinstance(call, ast.Call) and getattr(call.func, "attr", "") == "reshape"
        for argument in call.args
    ]
    return {each.operand for each in shapes if isinstance(each, ast.UnaryOp)}


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
        # One nanosecond or one byte more is nothing that a test could see
        counts = isinstance(number, int) and number < 1000
        more = number + 1 if counts else number * 2 + (0 if isinstance(number, int) else 1e-3)
        yield f"{number} -> {more}", lambda n: setattr(n, "value", more)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield f"{ast.unparse(node)}: without not", lambda n: setattr(n, "op", ast.UAdd())


class Tests:
    """The fast tests of a room: processor time of each [s], and the tests that run a line."""

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

    def of(self, file: str, lines: range, budget: float) -> dict[str, float]:
        """Return the tests that run one of the lines with their times, the file's own first.

        For lines that run at import or in another process only, all tests of the file (or all) are
        returned. The total is limited by a budget of processor time [s].
        """
        own = {test for test in self._seconds if f"/test_{Path(file).stem}.py" in test}
        run = self.running(file, lines)
        if not run:
            of_file = self._lines.get(file, {}).values()
            run = {test for tests in of_file for test in tests} or set(self._seconds)
            run |= own
        return self._within(run, budget, own)

    def running(self, file: str, lines: range) -> set[str]:
        """Return the tests whose own process runs one of the lines."""
        of_file = self._lines.get(file, {})
        return {test for line in lines for test in of_file.get(line, ())}

    def but(self, tried: Collection[str], budget: float) -> dict[str, float]:
        """Return further tests in the same way, for values that are computed at import."""
        return self._within(set(self._seconds) - set(tried), budget)

    def _within(
        self, tests: set[str], budget: float, own: Collection[str] = ()
    ) -> dict[str, float]:
        """Return tests within a budget: those of their own file, then the fastest."""
        chosen = dict[str, float]()
        for test in sorted(tests, key=lambda test: (test not in own, self._seconds[test])):
            if chosen and sum(chosen.values()) + self._seconds[test] > budget:
                break
            chosen[test] = self._seconds[test]
        return chosen


class Copy:
    """A copy of the repository for trying one mutation at a time."""

    def __init__(self, folder: Path) -> None:
        self._root = folder / "copy"
        left_out = shutil.ignore_patterns(
            ".git", ".venv", ".hypothesis", "runs", "site", "build", "__pycache__", ".*_cache"
        )
        shutil.copytree(ROOT, self._root, symlinks=True, ignore=left_out)
        self._trying: subprocess.Popen[str] | None = None

    def tests(self, room: str) -> Tests:
        """Return a room's fast tests; earlier results for a file are reused."""
        found, (source, *places) = Tests(), ROOMS[room]
        KEPT.mkdir(parents=True, exist_ok=True)
        files = [file for place in places for file in _files(ROOT / place, "test_*.py")]
        kept = {
            str(file.relative_to(ROOT)): KEPT / f"{room}-{file.stem}-{_digest(file)}.json"
            for file in files
        }
        if new := [file for file, place in kept.items() if not place.exists()]:
            print(f"{room}: looking which lines {len(new)} files of tests run", file=sys.stderr)
            found_now = self._root / "covering.json"  # in one process, which imports once
            self._run(["-m", "tools.covering", source, str(found_now), *new])
            for file, gathered in json.loads(found_now.read_text("utf-8")).items():
                gathered["sources"] = {name: _digest(ROOT / name) for name in gathered["lines"]}
                kept[file].write_text(json.dumps(gathered), "utf-8")
        for place in kept.values():
            found.add(json.loads(place.read_text("utf-8")))
        return found

    def collect(self, room: str) -> None:
        """Collect the tests of a room in a process, for :meth:`killed_in_fork`."""
        self.close()
        words = ["-m", "tools.trying", *ROOMS[room][1:]]
        self._trying = self._start(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def close(self) -> None:
        """End the process with the collected tests."""
        if self._trying:
            self._trying.communicate()
            self._trying = None

    def killed_in_fork(self, mutation: Mutation, tests: dict[str, float]) -> bool:
        """Return whether a changed function fails tests in a fork of the collecting process."""
        assert self._trying is not None and self._trying.stdin and self._trying.stdout
        bounds = {test: SLOWER * seconds + FORKS for test, seconds in tests.items()}
        asked = {"code": mutation.code(self._root), "tests": bounds, "idle": _idle()}
        print(json.dumps(asked), file=self._trying.stdin, flush=True)
        if not (answer := self._trying.stdout.readline()):
            raise SystemExit("the process that has the tests collected has ended")
        return answer != "0\n"

    def killed(self, mutation: Mutation, tests: dict[str, float]) -> bool:
        """Return whether tests that take so long fail on a change, or do not come to an end."""
        file = self._root / mutation.file
        sound = file.read_text("utf-8")
        file.write_text(mutation.text(), "utf-8")
        patience = SLOWER * sum(tests.values()) + STARTS
        try:
            return bool(self._run(["-m", "pytest", "-x", *NAMED, *tests], patience))
        finally:
            file.write_text(sound, "utf-8")

    def _run(self, words: list[str], patience: float | None = None) -> int:
        """Run Python on the copy; a run that takes more than ``patience`` [CPU s] has failed."""
        child = self._start(words, patience, stdout=subprocess.DEVNULL)
        try:
            return child.wait(patience and _idle() * patience)
        except subprocess.TimeoutExpired:
            return 1
        finally:
            with suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()

    def _start(
        self, words: list[str], patience: float | None = None, **more: Any
    ) -> subprocess.Popen[Any]:
        paths = [".", "pipeline", "plugins", "plugins/flangeye_paper"]
        paths = [str(self._root / path) for path in paths]
        path = os.pathsep.join([*paths, os.environ.get("PYTHONPATH", "")])

        def bounded() -> None:
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
            if patience:
                resource.setrlimit(resource.RLIMIT_CPU, (int(patience), int(patience) + 5))

        return subprocess.Popen(
            [sys.executable, "-B", *words], cwd=self._root, env={**os.environ, "PYTHONPATH": path},
            stderr=subprocess.DEVNULL, preexec_fn=bounded, start_new_session=True, **more,
        )  # fmt: skip


def main() -> None:
    """Try a sample of mutations of each room, and print the survivors."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("sample", nargs="?", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--room", nargs="+", choices=ROOMS, default=list(ROOMS))
    parser.add_argument(
        "--only", default="", help="a pattern of FILE:LINE: those changes alone, all"
    )
    parser.add_argument("--tests", nargs="+", default=[], help="those alone, in place of a room's")
    parser.add_argument("--budget", type=float, default=60, help="of tests for a change [CPU s]")
    asked = parser.parse_args()
    killed = tried = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        for room in asked.room:
            others = _others(room, asked.tests)
            ROOMS[room] = (ROOMS[room][0], *(asked.tests or ROOMS[room][1:]))
            chosen = _chosen(room, asked.sample // len(asked.room), asked.seed, asked.only)
            if not chosen:
                continue
            tests = copy.tests(room)
            copy.collect(room)
            alive = _survivors(copy, chosen, tests, others, asked.budget)
            copy.close()
            print(f"{room:10} {len(chosen) - alive:3} of {len(chosen):3} killed", flush=True)
            killed, tried = killed + len(chosen) - alive, tried + len(chosen)
    print(f"{killed} of {tried} killed by fast tests ({killed / max(tried, 1):.0%})")


def _survivors(
    copy: Copy, chosen: list[Mutation], tests: Tests, others: list[str], budget: float
) -> int:
    """Print the changes that no test notices and return how many they are."""
    alive = 0
    unchanged = chosen[0]._replace(change=lambda node: None)
    named = tests.of(unchanged.file, unchanged.lines, budget)
    if copy.killed_in_fork(unchanged, named) or copy.killed(unchanged, named):
        raise SystemExit(f"{chosen[0].room}: its tests fail without any change: {list(named)}")
    for number, mutation in enumerate(chosen):
        print(f"\r{number} of {len(chosen)} ", end="", file=sys.stderr, flush=True)
        named = tests.of(mutation.file, mutation.lines, budget)
        if not (
            copy.killed_in_fork(mutation, named)
            or _killed_anew(copy, mutation, tests, budget)
            # Nobody knows how long each of these takes: a minute [CPU s]
            or (others and copy.killed(mutation, dict.fromkeys(others, 60.0)))
        ):
            alive += 1
            print(f"  alive {mutation.file}:{mutation.line}: {mutation.words}", flush=True)
    return alive


def _killed_anew(copy: Copy, mutation: Mutation, tests: Tests, budget: float) -> bool:
    """Return whether tests fail in a new process on a change that a fork may not have noticed."""
    if not mutation.at_import and tests.running(mutation.file, mutation.lines):
        return False
    named = tests.of(mutation.file, mutation.lines, budget)
    if copy.killed(mutation, named):
        return True
    others = tests.but(named, budget)
    return bool(others) and copy.killed(mutation, others)


def _others(room: str, named: list[str]) -> list[str]:
    """Return the room's files of tests beside those that are named; none where none is named."""
    files = [file for place in ROOMS[room][1:] for file in _files(ROOT / place, "test_*.py")]
    every = [str(file.relative_to(ROOT)) for file in files]
    return [file for file in every if file not in named] if named else []


def _chosen(room: str, count: int, seed: int, only: str) -> list[Mutation]:
    every = [m for m in mutations(room) if re.search(only, f"{m.file}:{m.line}:")]
    return every if only else random.Random(f"{room} {seed}").sample(every, min(count, len(every)))


def _idle() -> float:
    """Return how many times longer than their CPU time tests may take [wall s a CPU s].

    Where more programs than cores are ready, one that waits for a core is not one that hangs.
    """
    return IDLE * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def _files(place: Path, pattern: str) -> list[Path]:
    return sorted(place.rglob(pattern)) if place.is_dir() else [place]


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


if __name__ == "__main__":
    main()

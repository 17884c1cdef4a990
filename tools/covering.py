"""Record which test runs which line: python -m tools.covering SOURCE OUT TESTS…

The fast tests of each file (or, without any, those in real time) run once under coverage.py, each in
its own context. OUT (JSON) gets, for each file of tests, the time that every passing test takes, and
for each file and line of the source the tests that run it.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import coverage
import pytest

NAMED = ("-q", "-p", "no:cacheprovider", "-m", "not slow")
"""Options of pytest for tests that are named; the last one is which of them."""


class Covering:
    """A pytest plugin that tells coverage.py which test runs.

    Attributes:
        seconds: What each test takes [s].
        clock: By which: of this process, or of the wall for tests that wait for other processes.
    """

    def __init__(self, source: Path) -> None:
        sources = [str(source), f"{source}/*"]
        self._coverage = coverage.Coverage(data_file=None, include=sources, config_file=False)
        self.seconds: dict[str, float] = {}
        self.clock = time.process_time
        self._failed: set[str] = set()
        self._coverage.start()  # from the first import on

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Name the context after the test."""
        self._coverage.switch_context(item.nodeid)
        began = self.clock()
        try:
            return (yield)
        finally:
            self.seconds[item.nodeid] = self.clock() - began
            self._coverage.switch_context("")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Exclude tests that do not pass."""
        if not report.passed:
            self._failed.add(report.nodeid)

    def gathered(self, files: Collection[str]) -> dict[str, Any]:
        """Return, for each file of tests, its passing tests' times and the lines that they run."""
        self._coverage.stop()
        data = self._coverage.get_data()
        for test in self._failed:
            self.seconds.pop(test, None)
        found: dict[str, Any] = {file: {"seconds": {}, "lines": {}} for file in files}
        for test, seconds in self.seconds.items():
            found[_file_of(test)]["seconds"][test] = seconds
        for file in data.measured_files():
            source = str(Path(file).relative_to(Path.cwd()))
            for line, tests in data.contexts_by_lineno(file).items():
                for test in tests:  # what ran at import is no test's
                    lines = found[_file_of(test)]["lines"] if test in self.seconds else {}
                    lines.setdefault(source, {}).setdefault(line, []).append(test)
                for of_file in found.values():
                    of_file["lines"].setdefault(source, {})
        return found


def _file_of(test: str) -> str:
    return test.partition("::")[0]


def main() -> Any:
    """Run the tests and write what ran what."""
    source, out, *tests = sys.argv[1:]
    plugin = Covering(Path(source))
    code = pytest.main([*NAMED[:-1], "not slow and not realtime", *tests], plugins=[plugin])
    fast = {_file_of(test) for test in plugin.seconds}
    if others := [file for file in tests if file not in fast]:
        plugin.clock = time.monotonic
        code = max(code, pytest.main([*NAMED, *others], plugins=[plugin]))
    Path(out).write_text(json.dumps(plugin.gathered(tests)), "utf-8")
    return code


if __name__ == "__main__":
    sys.exit(main())

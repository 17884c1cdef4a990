"""Record which test runs which line: python -m tools.covering SOURCE OUT TESTS

The fast tests of a file (or, without any, those in real time) run once under coverage.py, each in
its own context. OUT (JSON) gets the processor time of every passing test, and for each file and
line the tests that run it.
"""

from __future__ import annotations

import json
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import coverage
import pytest

NAMED = ("-q", "-p", "no:cacheprovider", "-m", "not slow")
"""Options of pytest for tests that are named; the last one is which of them."""


class Covering:
    """A pytest plugin that tells coverage.py which test runs."""

    def __init__(self, source: Path) -> None:
        self._coverage = coverage.Coverage(data_file=None, source=[str(source)], config_file=False)
        self.seconds: dict[str, float] = {}
        self._failed: set[str] = set()
        self._coverage.start()  # from the first import on

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Name the context after the test."""
        self._coverage.switch_context(item.nodeid)
        began = time.process_time()
        try:
            return (yield)
        finally:
            self.seconds[item.nodeid] = time.process_time() - began
            self._coverage.switch_context("")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Exclude tests that do not pass."""
        if not report.passed:
            self._failed.add(report.nodeid)

    def lines(self) -> dict[str, dict[int, list[str]]]:
        """Return file -> line -> the passing tests that run it."""
        self._coverage.stop()
        data = self._coverage.get_data()
        for test in self._failed:
            self.seconds.pop(test, None)
        found: dict[str, dict[int, list[str]]] = defaultdict(dict)
        for file in data.measured_files():
            for line, tests in data.contexts_by_lineno(file).items():
                found[str(Path(file).relative_to(Path.cwd()))][line] = [
                    test for test in tests if test in self.seconds
                ]
        return found


def main() -> Any:
    """Run the tests and write what ran what."""
    source, out, tests = sys.argv[1:]
    plugin = Covering(Path(source))
    code = pytest.main([*NAMED[:-1], "not slow and not realtime", tests], plugins=[plugin])
    if code == pytest.ExitCode.NO_TESTS_COLLECTED:
        code = pytest.main([*NAMED, tests], plugins=[plugin])
    lines = plugin.lines()
    Path(out).write_text(json.dumps({"seconds": plugin.seconds, "lines": lines}), "utf-8")
    return code


if __name__ == "__main__":
    sys.exit(main())

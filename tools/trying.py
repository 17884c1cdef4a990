"""Try changed functions in a process that has its tests collected: python -m tools.trying TESTS.

mutate.py asks it. A line of JSON on standard input holds a file's changed code, the tests to run and
how long each may take. It is tried in a fork, whose exit status is the line of the answer. What a module works out while it is imported stays as it was: a change that lives here may be
noticed by a process that imports it.
"""

from __future__ import annotations

import base64
import gc
import json
import marshal
import os
import resource
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from types import CodeType, FunctionType
from typing import Any

import pytest

from tools.covering import NAMED


class Trying:
    """A pytest plugin that, asked again and again, runs some of the tests on a change."""

    def __init__(self) -> None:
        self._asked, self._answers = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
        nowhere = os.open(os.devnull, os.O_RDWR)
        os.dup2(nowhere, 0)
        os.dup2(nowhere, 1)  # what pytest says of each test

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Answer every line."""
        items = {item.nodeid: item for item in session.items}
        for line in self._asked:
            asked = json.loads(line)
            child = os.fork()
            if not child:
                os.setsid()
                _put_in(marshal.loads(base64.b64decode(asked["code"])))
                bounds = {items[name]: seconds for name, seconds in asked["tests"].items()}
                os._exit(_failed(session, bounds, asked["idle"]))
            _, status = os.waitpid(child, 0)
            with suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            print(status, file=self._answers, flush=True)
        return True


def _failed(session: pytest.Session, bounds: dict[pytest.Item, float], idle: float) -> int:
    """Run tests until one fails; return whether one did.

    Each may take so much CPU time, and wait ``idle`` times longer; then the process ends [s].
    """
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    for item, after in zip(bounds, [*list(bounds)[1:], None], strict=True):
        cpu = int(time.process_time() + bounds[item])
        resource.setrlimit(resource.RLIMIT_CPU, (cpu, resource.RLIM_INFINITY))
        signal.alarm(int(idle * bounds[item]))
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
        if session.testsfailed:
            return 1
    return 0


def _put_in(module: CodeType) -> None:
    """Give every function of a module its code."""
    gc.unfreeze()  # tests/conftest.py keeps what was collected from the collector, and from us
    new = {(code.co_qualname, code.co_firstlineno): code for code in _inside(module)}
    for each in gc.get_objects():
        if isinstance(each, FunctionType) and each.__code__.co_filename == module.co_filename:
            old = each.__code__
            each.__code__ = new.get((old.co_qualname, old.co_firstlineno), old)


def _inside(code: CodeType) -> Iterator[CodeType]:
    for each in code.co_consts:
        if isinstance(each, CodeType):
            yield each
            yield from _inside(each)


def main() -> Any:
    """Collect the tests, then answer."""
    return pytest.main([*NAMED, *sys.argv[1:]], plugins=[Trying()])


if __name__ == "__main__":
    sys.exit(main())

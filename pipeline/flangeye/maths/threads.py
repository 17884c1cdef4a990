"""Run linear algebra on one thread: small matrices on many threads take 20 times the CPU time."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, TypeVar, cast

from threadpoolctl import ThreadpoolController

Function = TypeVar("Function", bound=Callable[..., Any])


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


def on_one_thread(function: Function) -> Function:
    """Return a function that calls BLAS on one thread."""

    @wraps(function)
    def limited(*args: Any, **kwargs: Any) -> Any:
        with _controller().limit(limits=1):
            return function(*args, **kwargs)

    return cast(Function, limited)

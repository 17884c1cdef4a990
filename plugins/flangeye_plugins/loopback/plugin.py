"""The controllers on loopback, offered to the engine. Light: nothing is imported until one runs."""

from __future__ import annotations

from collections.abc import Iterable

from flangeye import hookimpl
from flangeye.loopback import Loopback, LoopbackOptions


def _serve_ur(options: LoopbackOptions) -> None:
    from flangeye_plugins.loopback.ur.server import serve

    serve(options)


def _serve_aubo(options: LoopbackOptions) -> None:
    from flangeye_plugins.loopback.aubo.server import serve

    serve(options)


@hookimpl
def flangeye_loopbacks() -> Iterable[Loopback]:
    """Offer controllers of Universal Robots and of AUBO."""
    return (
        Loopback("ur", "Universal Robots", _serve_ur),
        Loopback("aubo", "AUBO", _serve_aubo),
    )

"""The commands of the control script by number: handlers that act at once or return a thread."""

from __future__ import annotations

from collections.abc import Callable

from flangeye_emulators.controllers.ur.commands import moves, queries, streams, touch
from flangeye_emulators.controllers.ur.program import Thread
from flangeye_emulators.controllers.ur.script import ControlScript

Handler = Callable[[ControlScript], Thread | None]

COMMANDS: dict[int, Handler] = {
    **moves.COMMANDS,
    **streams.COMMANDS,
    **touch.COMMANDS,
    **queries.COMMANDS,
}

STREAMED = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, *range(66, 72)})
"""Commands the script takes up again in every cycle."""

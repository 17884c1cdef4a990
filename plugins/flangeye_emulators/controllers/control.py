"""The control channel: one JSON object a line asks, one a line answers.

``{"do": "state"}`` is answered by ``{"ok": true, ...}`` or ``{"ok": false, "error": "..."}``. It is
not part of any robot: it is how tests and the simulated scanner reach behind the controller.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from flangeye.errors import FlangeyeError
from flangeye_emulators.controllers.network import LineConnection, Network

Action = Callable[[Mapping[str, Any]], Mapping[str, Any] | None]


class ControlSession(LineConnection):
    """One client of the control channel."""

    def __init__(self, network: Network, actions: Mapping[str, Action]) -> None:
        super().__init__(network)
        self._actions = actions

    def line(self, text: str) -> None:
        """Answer one request."""
        self.say(json.dumps(self._answer(text)))

    def _answer(self, text: str) -> dict[str, Any]:
        try:
            request = json.loads(text)
            name = request["do"]
            action = self._actions.get(name)
            if action is None:
                return _refusal(f"cannot do '{name}'; can do {', '.join(self._actions)}")
            return {"ok": True, **(action(request) or {})}
        except FlangeyeError as error:
            return _refusal(str(error))
        except (ValueError, KeyError, TypeError) as error:
            return _refusal(f"not a request: {type(error).__name__}: {error}")


def _refusal(why: str) -> dict[str, Any]:
    return {"ok": False, "error": why}
